"""Pairs of triangles of the cloth with mesh colliders, their contact and friction, in the steps of a solver."""

import numpy as np
import warp as wp

from ..kernels.contact import face_pairs as kernels
from ..model.host_values import host_values
from ..terms.contact import PAIRS


class FaceSteps:
    """Finds the pairs of each triangle where a step begins, and sets the rest states of their contact and friction.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        meshes: The :class:`warpcloth.contact.mesh_steps.MeshSteps` of the solver.
        bounded: Whether the method is explicit.
    """

    def __init__(self, model, meshes, bounded):
        self.model, self._meshes, self._bounded, self._pairs, self._bits = model, meshes, bounded, {}, {}
        self._find = model.kernel(kernels.find_face_pairs, model.dtype, not bounded)
        self._pose = model.kernel(kernels.pose_face_pairs, model.dtype)

    def arrays(self, elements):
        """Returns the triangle and the area [m²] of each element, (B·E,), in the order of the model."""
        triangles = wp.array(np.arange(elements.count), dtype=wp.int32, device=self.model.device)
        return triangles, self.model.array(elements.rest.numpy()[:, -1], self.model.dtype)

    def anchors(self, elements):
        """Returns friction anchors without contact, (B, E)."""
        dim = self.model.copies, elements.per_copy
        return wp.zeros(dim, dtype=kernels.anchor_type(self.model.dtype), device=self.model.device)

    def contact(self, elements):
        """Function (elements, arrays, x, v) that launches the rest states of contact with one pair of each triangle.

        Args:
            elements: The elements of the model, in the order of their pairs.
        """
        model, c, which, stencil = self.model, elements.collider, elements.facet, elements.stencil
        if which == 0:
            self._pairs[c] = wp.zeros((elements.count, PAIRS), dtype=kernels.FacePair, device=model.device)
            owned, mesh = kernels.Owned(), model.scene.colliders[c].triangles
            self._bits[c] = [
                wp.array(bits, dtype=wp.int32, device=model.device)
                for bits in (_edges(host_values(stencil)), _edges(mesh) + 8 * _vertices(mesh))
            ]
            owned.cloth, owned.mesh = self._bits[c]  # whose memory the struct does not keep
        pairs, motion, geometry = self._pairs[c], self._meshes.motion, self._meshes.geometry

        def launch(elements, arrays, x, v):
            if which == 0:
                given = [stencil, owned, model.inverse_mass, geometry, *model.free_gravity, x, v, motion]
                model.launch(self._find, elements.count, [*given, c, elements.per_copy], [pairs])
            given = [*arrays, pairs, motion, which, c, elements.per_copy]
            model.launch(self._pose, elements.count, given, [elements.rest])

        return launch

    def friction(self, elements, friction, anchors):
        """Function (elements, arrays, x, v) that launches the friction anchors of a step on one mesh.

        Args:
            elements: The friction elements of the model.
            friction: μ.
            anchors: The array of anchors (B, E).
        """
        model, c = self.model, elements.collider
        pairs, motion, geometry = self._pairs[c], self._meshes.motion, self._meshes.geometry
        anchor = model.kernel(kernels.anchor_face_pairs, model.dtype, elements.term.law, self._bounded)

        def launch(elements, arrays, x, _v):
            given = [*arrays, elements.stencil, geometry, pairs, x, motion, c, elements.per_copy, friction]
            model.launch(anchor, elements.count, given, [anchors, elements.rest])

        return launch


def _vertices(triangles):
    """Returns which of its three vertices no earlier triangle of (E, 3) has, as bits (E,)."""
    first = np.zeros(triangles.size, dtype=bool)
    first[np.unique(triangles, return_index=True)[1]] = True
    return first.reshape(-1, 3) @ [1, 2, 4]


def _edges(triangles):
    """Returns which of the edges 01, 12 and 20 of triangles (E, 3) no earlier triangle has, as bits (E,)."""
    edges = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    first = np.zeros(len(edges), dtype=bool)
    first[np.unique(edges, axis=0, return_index=True)[1]] = True
    return first.reshape(-1, 3) @ [1, 2, 4]
