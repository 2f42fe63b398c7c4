"""The triangle meshes among the colliders of a scene on a device."""

from typing import NamedTuple

import numpy as np
import warp as wp

from ..kernels.contact import mesh_geometry as kernels

# Rounding of bounds in float32, relative to the largest coordinate.
_ROUNDING = 1e-6


class DeviceMeshes(NamedTuple):
    """The meshes of the colliders of a scene, which all copies share.

    Attributes:
        geometry: The struct :func:`warpcloth.kernels.contact.mesh_geometry.meshes`.
        trees: A `wp.Bvh` of each collider at its start, or None if it is not a mesh.
        deform: Indices of the colliders that deform.
    """

    geometry: object
    trees: list
    deform: list

    def own(self, model):
        """Returns a copy that has its own trees of the meshes that deform."""
        trees = list(self.trees)
        for c in self.deform:
            trees[c] = wp.Bvh(wp.clone(trees[c].lowers), wp.clone(trees[c].uppers))
        geometry = kernels.meshes(model.dtype)()  # copy.copy of a struct would share its memory
        geometry.assign(self.geometry)
        geometry.bvh = _ids(trees, model.device)
        return self._replace(geometry=geometry, trees=trees)

    @property
    def arrays(self):
        found = [self.geometry.points, self.geometry.triangles]
        return found + [array for tree in self.trees if tree is not None for array in (tree.lowers, tree.uppers)]


def meshes_on(model, colliders):
    """Returns the meshes among colliders on the device of a model, or None if there are none."""
    meshes = [collider if collider.facets else None for collider in colliders]
    if not any(meshes):
        return None
    found = kernels.meshes(model.dtype)()
    frames = [np.empty((0, 0, 3)) if mesh is None else mesh.frames for mesh in meshes]
    triangles = [np.empty((0, 3), np.int32) if mesh is None else mesh.triangles for mesh in meshes]
    margins = [_ROUNDING * np.abs(points).max(initial=0.0) for points in frames]
    trees = [_tree(model, *each) if len(each[0]) else None for each in zip(frames, triangles, margins, strict=True)]

    def numbers(values, dtype=wp.int32):
        return wp.array(np.array(values), dtype=dtype, device=model.device)

    found.points = model.array(np.concatenate([each.reshape(-1, 3) for each in frames]), model.vec3)
    found.triangles = wp.array(np.concatenate(triangles), dtype=wp.vec3i, device=model.device)
    found.bvh = _ids(trees, model.device)
    found.first_triangle = numbers(np.cumsum([0, *map(len, triangles)])[:-1])
    found.first_point = numbers(np.cumsum([0, *(each.shape[0] * each.shape[1] for each in frames)])[:-1])
    found.size, found.frames = numbers([each.shape[1] for each in frames]), numbers([len(each) for each in frames])
    found.margin = numbers(margins, wp.float32)
    return DeviceMeshes(found, trees, [c for c, each in enumerate(frames) if len(each) > 1])


def _ids(trees, device):
    return wp.array([0 if tree is None else tree.id for tree in trees], dtype=wp.uint64, device=device)


def _tree(model, frames, triangles, margin):
    corners = frames[0][triangles]
    low, high = corners.min(axis=1) - margin, corners.max(axis=1) + margin
    return wp.Bvh(*(wp.array(bound, dtype=wp.vec3, device=model.device) for bound in (low, high)))
