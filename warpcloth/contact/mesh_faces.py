"""The filter that keeps triangles of the cloth apart from those of meshes among the colliders, in the steps of a solver."""

import numpy as np
import warp as wp

from ..kernels.contact import mesh_faces as kernels
from ..model.elements import incidences_of


class MeshFaces:
    """Moves vertices of triangles that would cross a mesh, which those of the cloth alone may do without touching it.

    Pinned vertices are where pins have them, and triangles of none but these are left out.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        meshes: The :class:`warpcloth.contact.mesh_steps.MeshSteps` of the solver.
        h: Step [s].
    """

    def __init__(self, model, meshes, h):
        self.model, self._meshes, self._h, device = model, meshes, h, model.device
        faces = self._faces_of(model)
        offsets, codes = incidences_of(faces.ravel(), model.count)
        self._count, self._faces = len(faces), kernels.Faces()
        self._kept = {  # whose memory the struct does not keep
            "vertices": wp.array(faces.astype(np.int32), dtype=wp.vec3i, device=device),
            "first": wp.array(offsets.astype(np.int32), dtype=wp.int32, device=device),
            "of_vertex": wp.array((codes // 3).astype(np.int32), dtype=wp.int32, device=device),
        }
        for name, value in self._kept.items():
            setattr(self._faces, name, value)
        self._colliders = [c for c, collider in enumerate(model.scene.colliders) if collider.facets]
        self._planes = wp.zeros(len(faces), dtype=wp.vec4d, device=device)
        self._shares = wp.zeros(len(faces), dtype=wp.vec3d, device=device)
        self._found = wp.zeros(len(self._colliders), dtype=wp.int32, device=device)
        self._round, self._proceed, self._unfinished = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(3))
        self._latest = model.scalars(wp.int32)
        self._moved, self._target = wp.zeros(model.count, dtype=wp.int32, device=device), model.vectors()
        made = kernels.find_planes, kernels.follow_planes, kernels.find_shares, kernels.keep_shares, kernels.end_faces
        self._launch = model.launcher((made, model.dtype))
        self._end_round = model.kernel(kernels.end_round)

    @staticmethod
    def _faces_of(model):
        """The triangles of all copies that have a vertex that is not pinned, or such edges of an edge mesh, (F, 3)."""
        mesh = model.scene.mesh
        faces = model.in_model(mesh.triangles if len(mesh.triangles) else mesh.edges[:, [0, 1, 1]])
        copies = np.arange(model.copies)[:, None, None] * model.per_copy
        faces = (faces + copies).reshape(-1, 3)
        return faces[(model.inverse_mass.numpy()[faces] > 0.0).any(axis=1)]

    def launch_end(self, x_before, x, v, move, notes):
        """Moves vertices on, in x, v and ``move`` (N,), so that no triangle has crossed a mesh since ``x_before`` (N,)."""
        model = self.model
        wp.copy(self._target, x)
        self._launch_rounds(x_before, x)
        given = [x_before, self._target, x, model.per_copy, self._h]
        self._launch(kernels.end_faces, model.count, given, [v, move, self._moved, notes])

    def launch_out(self, x_before, x):
        """Moves vertices in x on as :meth:`launch_end`."""
        self._launch_rounds(x_before, x)
        self._moved.zero_()

    def _launch_rounds(self, x_before, x):
        self._round.zero_()
        self._latest.zero_()
        self._proceed.fill_(1)
        wp.capture_while(self._proceed, self._launch_round, x_before=x_before, x=x)
        wp.capture_if(self._unfinished, self._launch_shortened, x_before=x_before, x=x)

    def _launch_round(self, x_before, x):
        """Moves x to the allowed sides of the planes of the triangles that are met first."""
        model, motion, geometry = self.model, self._meshes.motion, self._meshes.geometry
        for k, c in enumerate(self._colliders):
            found = self._found[k : k + 1]
            given = [self._faces, geometry, x_before, x, motion, self._round, self._moved, c, model.per_copy]
            self._launch(kernels.find_planes, self._count, given, [self._planes, found, self._latest])
            given = [model.mobility, model.inverse_mass, self._faces, motion]
            given += [self._planes, found, self._round, c, model.per_copy]
            self._launch(kernels.follow_planes, model.count, given, [x, self._moved])
        model.launch(self._end_round, 1, [], [self._found, self._round, self._proceed, self._unfinished])

    def _launch_shortened(self, x_before, x):
        for c in self._colliders:
            self._launch_shares(c, x_before, x, self._latest, None)

    def launch_least(self, x, target, share):
        """Lowers the ``share`` (N,) that vertices may go from x to their targets (N,) by meshes that stand."""
        for c in self._colliders:
            if not self.model.colliders.moves[c]:
                self._launch_shares(c, x, target, None, share)

    def _launch_shares(self, c, x, end, latest, least):
        model, motion = self.model, self._meshes.motion
        given = [self._faces, self._meshes.geometry, x, end, motion, latest, c, model.per_copy]
        self._launch(kernels.find_shares, self._count, given, [self._shares])
        given = [model.mobility, model.inverse_mass, self._faces, x, motion, self._shares]
        self._launch(kernels.keep_shares, model.count, [*given, c, model.per_copy], [least, end, self._moved])
