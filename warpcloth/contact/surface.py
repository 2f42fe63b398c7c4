"""The surface on which contact is found: the cloth, and mesh colliders as obstacles."""

import numpy as np
import warp as wp

from ..core.filled import filled
from ..kernels.contact import obstacles as kernels
from ..kernels.coulomb import law_of
from ..kernels.pairs import Layout
from ..mesh.mesh import Mesh
from ..scene.mesh_collider import first_extended
from ..terms.needs import listed


class ContactSurface:
    """The vertices, edges and triangles of the cloth, and behind them those of the mesh colliders, of all copies.

    Vertices of a mesh that coincide at all frames are one. Elements of the cloth with a vertex that cannot move do not meet
    meshes.

    Attributes:
        obstacles: The number m of vertices of meshes in a copy.
        count: The number of vertices of all copies, N + B·m.
        items: Vertices of the triangles, then of the edges, of all copies, each with 2·copy + kind, (items, 4) int32.
        triangles, edges: The numbers of both, over all copies.
        groups: The group of each item, (items,), and ``vertex_groups`` that of each vertex of a copy, (n + m,).
        edge_lengths: Lengths of the edges of the cloth at rest [m].
        rest: Rest positions of the vertices of a copy (n + m, 3) [m].
        colliders: The index of the collider of each obstacle of a copy, (m,).
        width: The largest area of an edge of the cloth over its length [m].
        moves_of_step: Moves of obstacles in the step, (B·m,) [m].
    """

    def __init__(self, model, meets_itself=True):
        self.model, self.meets_itself = model, meets_itself
        scene, mesh, n = model.scene, model.scene.mesh, model.per_copy
        found = [(c, *_welded(each.centred())) for c, each in enumerate(scene.colliders) if each.is_mesh]
        self.colliders = np.concatenate([np.full(len(vertices), c) for c, vertices, _, _ in found] or [np.empty(0, np.int64)])
        self._vertices = np.concatenate([vertices for _, vertices, _, _ in found] or [np.empty(0, np.int64)])
        self.obstacles, self.moves = len(self.colliders), any(scene.colliders[c].moves for c, _, _, _ in found)
        self.count = model.count + model.copies * self.obstacles
        self.layout = filled(Layout, cloth=model.count, per_copy=n, obstacles=self.obstacles)
        firsts = np.cumsum([0, *(len(vertices) for _, vertices, _, _ in found)])
        self._of_meshes = [
            (Mesh(points, triangles), first) for (_, _, points, triangles), first in zip(found, firsts, strict=False)
        ]
        self.rest = np.concatenate([model.rest_points, *(each.points for each, _ in self._of_meshes)])
        self.edge_lengths = mesh.edge_lengths
        self._find_elements()
        self._find, self.width, self.moves_of_step = None, 0.0, None
        if self.obstacles:
            self._prepare_positions(found)
            self.moves_of_step = wp.zeros(self.count - model.count, dtype=wp.vec3d, device=model.device)
            of_edges, (a, b) = self.areas()[1], model.in_model(mesh.edges).T
            self.width = float(((of_edges[a] + of_edges[b]) / mesh.edge_lengths).max())

    def _find_elements(self):
        model, mesh, n = self.model, self.model.scene.mesh, self.model.per_copy
        held = (model.coordinate_mobility().reshape(-1, 3)[:n] == 0.0).all(axis=1)
        of_cloth = np.where(held, int(kernels.HELD), int(kernels.CLOTH))
        self.vertex_groups = np.concatenate([of_cloth, np.full(self.obstacles, int(kernels.OBSTACLE))])
        kinds, counts, groups = [], [], self.vertex_groups
        for kind, name in enumerate(("triangles", "edges")):
            local = [model.in_model(getattr(mesh, name)), *(getattr(each, name) + n + first for each, first in self._of_meshes)]
            local = np.concatenate([each.reshape(-1, 3 - kind) for each in local]).astype(np.int64)
            if kind:
                local = local[:, [0, 1, 1]]
            copy = np.repeat(np.arange(model.copies), len(local))[:, None]
            vertices = np.tile(local, (model.copies, 1))
            behind = model.count + copy * self.obstacles + vertices - n
            vertices = np.where(vertices < n, vertices + copy * n, behind)
            kinds.append(np.column_stack([vertices, 2 * copy + kind, np.tile(groups[local].max(axis=1), model.copies)]))
            counts.append(len(vertices))
        items = np.concatenate(kinds).astype(np.int32)
        (self.triangles, self.edges), self.items, self.groups = counts, items[:, :4], items[:, 4]

    def _prepare_positions(self, found):
        model, device = self.model, self.model.device
        frames = [model.scene.colliders[c].frames for c in range(len(model.scene.colliders)) if c in self.colliders]
        present = {c: np.ptp(each, axis=1).any(axis=1) for (c, *_), each in zip(found, frames, strict=True)}
        counts = [len(present.get(c, ())) for c in range(len(model.scene.colliders))]
        values = {
            "collider": self.colliders,
            "vertex": self._vertices,
            "first_frame": np.cumsum([0, *counts])[:-1],
            "present": np.concatenate([present[c] for c in sorted(present)]),
        }
        arrays = {name: wp.array(each, dtype=wp.int32, device=device) for name, each in values.items()}
        self.of_obstacles = filled(kernels.Obstacles, **arrays)
        self._find = model.kernel(kernels.find_obstacles, model.dtype)

    def friction(self):
        """The law of friction, and μ of cloth with cloth, then that of each obstacle of a copy, (1 + m,); or None.

        Raises:
            ValueError: There are several laws.
        """
        scene = self.model.scene
        given = [scene.self_contact.friction if self.meets_itself else 0.0]
        given += [scene.colliders[c].friction for c in self.colliders]
        laws = {law_of(each) for each in given if each}
        if len(laws) > 1:
            names = listed([each.name for each in laws])
            raise ValueError(f"cloth and mesh colliders have the laws of friction {names}; they must have the same")
        return (*laws, np.array(given, dtype=np.float64)) if laws else None

    def areas(self):
        """Rest areas of vertices, and of each edge at them, (n + m,) [m²], those of the cloth in the order of the model.

        The area of a vertex of a mesh is at most the mean of those of the cloth.
        """
        mesh, n = self.model.scene.mesh, self.model.per_copy
        of_cloth = np.empty(n)
        of_cloth[self.model.in_model(np.arange(n))] = self.model.scene.touching_areas
        degrees = np.bincount(self.model.in_model(mesh.edges).ravel(), minlength=n)
        vertices, edges = [of_cloth], [of_cloth / np.maximum(degrees, 1)]
        for each, _ in self._of_meshes:
            own = each.vertex_areas
            vertices.append(np.minimum(own, of_cloth.mean()))
            edges.append(own / np.maximum(np.bincount(each.edges.ravel(), minlength=len(own)), 1))
        return np.concatenate(vertices), np.concatenate(edges)

    def rings(self):
        """Returns the vertices that share a triangle with each vertex of a copy, (n + m + 1,) offsets and (…,) vertices."""
        own = self.items[: self.triangles // self.model.copies, :3].astype(np.int64)  # of the first copy
        own[own >= self.model.count] -= self.model.count - self.model.per_copy
        count = np.int64(len(self.rest))
        keys = np.sort(np.concatenate([own[:, i] * count + own[:, (i + k) % 3] for i in range(3) for k in (1, 2)]))
        one, other = np.divmod(keys[np.flatnonzero(np.diff(keys, prepend=-1))], count)
        return np.searchsorted(one, np.arange(count + 1)), other

    def pieces(self, piece):
        """The pieces of a copy with its obstacles, (n + m,): those of the cloth, −1 without an element, then each collider."""
        _, of_collider = np.unique(self.colliders, return_inverse=True)
        return np.concatenate([piece, piece.max(initial=-1) + 1 + of_collider])

    def of_model(self, values):
        n, copies = self.model.per_copy, (self.model.copies, *[1] * (values.ndim - 1))
        return np.concatenate([np.tile(values[:n], copies), np.tile(values[n:], copies)])

    def vectors(self):
        return wp.zeros(self.count, dtype=self.model.vec3, device=self.model.device)

    def behind(self, whole):
        return whole[self.model.count :]

    def launch_positions(self, colliders, ahead, placed):
        """Sets obstacles at the start of a step, ``ahead`` half steps later, and at its end, (B·m,) [m]; and finds moves."""
        model = self.model
        given = [self.layout, self.of_obstacles, model.colliders.meshes.geometry, colliders.poses, colliders.steps]
        given += [2 * colliders.steps_per_frame, ahead]
        model.launch(self._find, self.count - model.count, given, [*placed, self.moves_of_step])


def _welded(collider):
    """Returns the vertices of a mesh collider, their positions (m, 3) and triangles (T, 3)."""
    welded = collider.welded
    _, first, triangles = np.unique(welded, return_index=True, return_inverse=True)
    vertices = collider.triangles.ravel()[first]
    return vertices, first_extended(collider.frames)[vertices], triangles.reshape(-1, 3)
