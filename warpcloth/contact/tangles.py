"""Triangles that intersect or touch at the start of a run, and the pairs that contact therefore ignores at first."""

import numpy as np
import warp as wp

from ..kernels.contact import tangles as kernels


class Tangles:
    """Pairs of triangles that intersect or touch at the start, and the contact pairs that are ignored for them.

    A contact pair affects certain pairs of triangles. When a vertex passes through a triangle, each triangle of the vertex
    starts or stops to intersect that triangle. When two edges pass through one another, this holds for each triangle of one
    with each of the other. The filter ignores a contact pair only if all these pairs of triangles are tangled, so that no new
    intersections arise. Forces ignore it if one of them is tangled. Two triangles become free when they do not intersect and
    are at least ``least`` apart at the end of a step. They then stay free, for the filter has all their pairs.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        state: The :class:`warpcloth.core.state.State` of the solver, to which it adds the flags of free pairs.
        edges: Edges (E, 2) that intersect triangles, vertices of the model.
        triangles: These triangles (E, 3).
        near: Contact pairs that are too near, two lists of (m, 4): vertex–triangle pairs, and edge–edge pairs.
        least: Distance [m] from which two triangles are free.

    Attributes:
        pairs: The tangled pairs of triangles, (K, 2) indices in the mesh.
        copies: The copy of each pair, (K,).
    """

    def __init__(self, model, state, edges, triangles, near, least):
        self.model, self.least = model, float(least)
        self._mesh = _Incidence(np.asarray(model.in_model(model.scene.mesh.triangles), dtype=np.int64), model)
        found = (
            self._mesh.of_crossings(edges, triangles),
            *(self._mesh.of_near(*each) for each in zip(near, (1, 2), strict=True)),
        )
        self._keys = np.unique(np.concatenate(found))
        count = self._mesh.count
        one, other = np.divmod(self._keys, count)
        self.pairs, self.copies = np.stack([one, other], axis=1) % self._mesh.per_copy, one // self._mesh.per_copy
        of_vertices, stencils, whole, firsts, tangles = self._mesh.left_out(self._keys)
        device = model.device
        self._left = kernels.LeftOut()
        self._left.of_vertices = of_vertices
        self._left.stencils = wp.array(stencils, dtype=wp.vec4i, device=device)
        self._left.whole = wp.array(whole, dtype=wp.int32, device=device)
        self._left.first = wp.array(firsts, dtype=wp.int32, device=device)
        self._left.tangles = wp.array(tangles, dtype=wp.int32, device=device)
        corners = np.concatenate([self._mesh.triangles[one], self._mesh.triangles[other]], axis=1)
        self._corners = wp.array(corners, dtype=wp.int32, device=device)
        self._left.free = state.add("triangles that came free", wp.zeros(len(self._keys), dtype=wp.int32, device=device))
        self._free = model.kernel(kernels.find_free, model.dtype)

    def __len__(self):
        return len(self._keys)

    @property
    def free(self):
        """Whether each pair is free, (K,) 0 or 1."""
        return self._left.free.numpy()

    def left(self):
        """The number of pairs of triangles that are not free, (B,)."""
        return np.bincount(self.copies[self.free == 0], minlength=self.model.copies)

    def start_again(self):
        """Makes all pairs tangled again."""
        self._left.free.zero_()

    def launch_leave_out(self, stencils, counts, gap):
        """Launches gap = infinity [m] for ignored pairs, so that they have no contact."""
        self.model.launch(kernels.leave_out, len(stencils), [stencils, counts, self._left], [gap])

    def launch_open(self, stencils, counts, open):
        """Launches open = 1 for the pairs that the filter ignores."""
        self.model.launch(kernels.find_open, len(stencils), [stencils, counts, self._left], [open])

    def launch_free(self, x):
        """Launches the update of the free pairs at x (N,)."""
        self.model.launch(self._free, len(self._keys), [self._corners, x, self.least], [self._left.free])


class _Incidence:
    """Incidence of the triangles and edges of all copies, with indices that count through the copies."""

    def __init__(self, triangles, model):
        self.per_copy, n = len(triangles), model.per_copy
        shift = np.arange(model.copies)[:, None, None]
        self.triangles = (triangles[None] + shift * n).reshape(-1, 3)
        self.count, self.vertices = len(self.triangles), n * model.copies
        sides = np.sort(self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        self._edge_keys, edges = np.unique(sides[:, 0] * self.vertices + sides[:, 1], return_inverse=True)
        self.edges = edges.reshape(-1, 3)  # of each triangle
        self.ends = np.stack(np.divmod(self._edge_keys, self.vertices), axis=1)
        self._of_vertex = _table(self.triangles, self.vertices)
        self._of_edge = _table(self.edges, len(self._edge_keys))

    def edge(self, ends):
        """Indices (m,) of the edges with the ends (m, 2)."""
        ends = np.sort(np.asarray(ends, dtype=np.int64).reshape(-1, 2), axis=1)
        return np.searchsorted(self._edge_keys, ends[:, 0] * self.vertices + ends[:, 1])

    def triangle(self, corners):
        """Indices (m,) of the triangles with the vertices (m, 3)."""
        corners = np.sort(np.asarray(corners, dtype=np.int64).reshape(-1, 3), axis=1)
        around = self._of_edge[self.edge(corners[:, :2])]
        has = (self.triangles[around] == corners[:, None, 2:]).any(axis=2) & (around >= 0)
        return around[np.arange(len(corners)), has.argmax(axis=1)]

    def key(self, one, other):
        """A unique number for each pair of triangles; −1 if one is missing, or both are the same."""
        keys = np.minimum(one, other) * self.count + np.maximum(one, other)
        return np.where((one >= 0) & (other >= 0) & (one != other), keys, -1)

    def of_crossings(self, edges, triangles):
        """Keys of the pairs of triangles that intersect if edges (m, 2) intersect triangles (m, 3)."""
        keys = self.key(self._of_edge[self.edge(edges)], self.triangle(triangles)[:, None])
        return keys[keys >= 0]

    def of_near(self, stencils, first):
        """Keys of the pairs of triangles of contact pairs (m, 4), the first ``first`` vertices of which are one side."""
        stencils = np.asarray(stencils, dtype=np.int64).reshape(-1, 4)
        if first == 1:
            keys = self.of_vertices(stencils[:, 0], self.triangle(stencils[:, 1:]))
        else:
            keys = self.of_edges(self.edge(stencils[:, :2]), self.edge(stencils[:, 2:]))
        return keys[keys >= 0]

    def of_vertices(self, vertices, triangles):
        """Keys (m, k) of the pairs of triangles affected if vertices (m,) pass through triangles (m,), see :class:`Tangles`."""
        return self.key(self._of_vertex[vertices], triangles[:, None])

    def of_edges(self, one, other):
        """As :meth:`of_vertices`, if edges (m,) pass through edges (m,)."""
        keys = self.key(self._of_edge[one][:, :, None], self._of_edge[other][:, None, :])
        return keys.reshape(len(one), self._of_edge.shape[1] ** 2)

    def left_out(self, tangled):
        """The contact pairs between the pairs of triangles ``tangled`` (K,), sorted keys.

        Returns:
            The number of vertex–triangle pairs; the vertices (P, 4), sorted; whether all of their pairs of triangles are
            tangled (P,); offsets (P + 1,) in the indices of the tangled ones; these indices.
        """
        one, other = np.divmod(tangled, self.count)
        stencils, tables = [], []
        both = np.concatenate([one, other]), np.concatenate([other, one])
        pairs = np.stack([self.triangles[both[0]].ravel(), np.repeat(both[1], 3)], axis=1)
        pairs = np.unique(pairs[(self.triangles[pairs[:, 1]] != pairs[:, :1]).all(axis=1)], axis=0)
        stencils.append(np.column_stack([pairs[:, 0], np.sort(self.triangles[pairs[:, 1]], axis=1)]))
        tables.append(self.of_vertices(*pairs.T))
        pairs = np.stack([np.repeat(self.edges[one], 3, axis=1).ravel(), np.tile(self.edges[other], 3).ravel()], axis=1)
        pairs = np.unique(np.sort(pairs, axis=1), axis=0)  # edges are sorted by their ends
        ends = self.ends[pairs]
        pairs = pairs[(ends[:, 0, :, None] != ends[:, 1, None, :]).all(axis=(1, 2))]
        stencils.append(self.ends[pairs].reshape(-1, 4))
        tables.append(self.of_edges(*pairs.T))
        whole, counts, indices = [], [], []
        for k, table in enumerate(tables):
            at = np.minimum(np.searchsorted(tangled, table), len(tangled) - 1)
            there, order = tangled[at] == table, np.lexsort(stencils[k].T[::-1])
            stencils[k] = stencils[k][order]
            whole.append((there | (table < 0)).all(axis=1)[order])
            counts.append(there.sum(axis=1)[order])
            indices.append(at[order][there[order]])
        firsts = np.concatenate([[0], np.cumsum(np.concatenate(counts))])
        stacked = np.concatenate(stencils).astype(np.int32), np.concatenate(whole).astype(np.int32)
        return len(stencils[0]), *stacked, firsts, np.concatenate(indices)


def _table(members, count):
    """For each of ``count`` numbers, the rows of ``members`` (T, 3) that contain it, (count, k), filled with −1."""
    order = np.argsort(members.ravel(), kind="stable")
    numbers = members.ravel()[order]
    sizes = np.bincount(numbers, minlength=count)
    rank = np.arange(len(numbers)) - (np.cumsum(sizes) - sizes)[numbers]
    found = np.full((count, max(sizes.max(initial=0), 1)), -1, dtype=np.int64)
    found[numbers, rank] = order // 3
    return found
