"""Triangles of the cloth through which corners or edges of meshes pass, found at the end of each frame.

The filter keeps only vertices of the cloth out of meshes, unless ``Contact(elements="triangles")`` keeps triangles out too.
"""

from copy import copy

import numpy as np
import warp as wp

from ..base.turns import in_turn
from ..core.capture import Segment
from ..kernels.contact import mesh_piercing as kernels
from ..kernels.contact.mesh_queries import bound_triangles
from ..kernels.step import count_step
from ..kernels.vectors import types


class Piercings:
    """Notes the first triangle of each copy that each mesh has pierced, see :mod:`warpcloth.kernels.contact.mesh_piercing`.

    Triangles of pinned vertices, or vertices with locked axes, are left out: these may be inside a mesh.

    Args:
        model: The :class:`warpcloth.model.model.Model` of a scene with meshes among its colliders.
        x: The positions that the steps change, (B·n,) vectors [m].
    """

    @in_turn
    def __init__(self, model, x):
        self.model, self._x, device = model, x, model.device
        self._meshes = model.colliders.meshes.own(model)
        triangles, copies = model.scene.mesh.triangles, np.arange(model.copies)[:, None, None]
        self._triangles, beside = len(triangles), _beside(triangles)
        faces = model.in_model(triangles)[None] + model.per_copy * copies
        kept = _free(model, faces).ravel()
        index = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)  # of a triangle among those that are kept
        beside = np.where(beside < 0, -1, beside + self._triangles * copies)
        numbers = np.tile(np.arange(self._triangles), model.copies)[kept]
        self._count, self._faces = len(numbers), kernels.ClothTriangles()
        self._faces.vertices = wp.array(faces.reshape(-1, 3)[kept].astype(np.int32), dtype=wp.vec3i, device=device)
        self._faces.beside = wp.array(index[beside].reshape(-1, 3)[kept].astype(np.int32), dtype=wp.vec3i, device=device)
        self._faces.numbers = wp.array(numbers, dtype=wp.int64, device=device)
        self._found, self._clear = wp.zeros(self._count, dtype=wp.int32, device=device), {}
        for c, collider in enumerate(model.scene.colliders):
            if collider.facets:
                clear = self._clear[c] = kernels.clear_triangles(model.dtype)()
                clear.corners = wp.zeros(self._count, dtype=types(model.dtype)[1], device=device)
                clear.when = wp.full(self._count, -1, dtype=wp.int32, device=device)
                clear.cut = wp.zeros(self._count, dtype=wp.int32, device=device)
        self._notes = wp.zeros((model.copies, len(model.scene.colliders)), dtype=wp.int64, device=device)
        self._frame, self._last = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))
        self._kept = [
            self._notes,
            *(array for clear in self._clear.values() for array in (clear.corners, clear.when, clear.cut)),
        ]
        made = kernels.find_pierced, kernels.drop_cuts, bound_triangles
        self._launch, self._some = model.launcher((made, model.dtype)), wp.zeros(1, dtype=wp.int32, device=device)
        self._add, self._note = model.kernel(count_step), kernels.note_pierced
        self._segment = Segment(device, self._launch_frame)

    @in_turn
    def starts_at(self, frame):
        """Returns a function that launches the search at the end of a frame, to be called for each one after ``frame``."""
        self._frame.fill_(frame)
        self._last.fill_(frame - 1)
        if frame == 0:
            self._launch_all()
        return self._segment

    def _launch_frame(self):
        for array in (self._frame, self._last):
            self.model.launch(self._add, 1, [], [array])
        self._launch_all()

    def _launch_all(self):
        model, declared = self.model, self.model.colliders
        for c, clear in self._clear.items():
            geometry, tree, collider = self._meshes.geometry, self._meshes.trees[c], model.scene.colliders[c]
            if c in self._meshes.deform:
                self._launch(bound_triangles, len(tree.lowers), [geometry, c, self._last, 2], [tree.lowers, tree.uppers])
                tree.refit()
            self._some.zero_()
            given = [self._faces, geometry, declared.keyframes, declared.firsts, self._x, self._frame]
            given += [c, declared.distance, collider.deforms.max(initial=0.0)]
            self._launch(kernels.find_pierced, self._count, given, [clear, self._some, self._found])
            wp.capture_while(self._some, self._launch_drop)
            given = [self._faces, self._frame, self._found, c, model.per_copy, self._triangles]
            model.launch(self._note, self._count, given, [self._notes])

    def _launch_drop(self):
        self._some.zero_()
        self._launch(kernels.drop_cuts, self._count, [self._faces, self._x], [self._found, self._some])

    # As a part of a state: all that later frames depend on.

    def copy(self):
        """Returns an equal object with arrays of its own for these values."""
        other = copy(self)
        other._kept = [wp.clone(array) for array in self._kept]
        return other

    def assign(self, other):
        """Copies the values of another object of the same model."""
        for mine, array in zip(self._kept, other._kept, strict=True):
            wp.copy(mine, array)

    def to_host(self):
        """Returns copies of the arrays, by name."""
        return {str(k): np.array(array.numpy()) for k, array in enumerate(self._kept)}

    def from_host(self, values):
        """Sets everything to what :meth:`to_host` returned."""
        for k, array in enumerate(self._kept):
            array.assign(values[str(k)])

    @in_turn
    def _read(self):
        return self._notes.numpy()

    def first(self):
        """Returns the first triangle of each copy that each mesh has pierced: (copy, collider, frame, triangle)."""
        return [
            (*of, *divmod(int(kernels.FIRST) - int(note), self._triangles)) for of, note in np.ndenumerate(self._read()) if note
        ]


def piercings_of(model, x):
    """Returns the :class:`Piercings` of a run, or None if its scene has no meshes or keeps triangles out of them."""
    declared = model.colliders
    if declared is None or declared.meshes is None or model.scene.contact.elements == "triangles":
        return None
    return Piercings(model, x) if _free(model, model.in_model(model.scene.mesh.triangles)[None]).any() else None


def _free(model, faces):
    """Returns which triangles, with their vertices (…, 3), have no vertex that is pinned, or has locked axes."""
    return (model.coordinate_mobility().reshape(-1, 3) > 0.0).all(axis=1)[faces].all(axis=-1)


def _beside(triangles):
    """Returns the triangle on the other side of each side of triangles (T, 3), or −1 if there is not just one, (T, 3)."""
    sides = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    _, edge, counts = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True)
    edge = edge.ravel()
    owners = np.arange(len(sides)) // 3
    sums = np.bincount(edge, owners).astype(np.int64)
    return np.where(counts[edge] == 2, sums[edge] - owners, -1).reshape(-1, 3)
