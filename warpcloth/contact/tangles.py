"""Triangles that cross or touch where a run starts: which pairs contact leaves out for them, and until when."""

import numpy as np
import warp as wp

from ..kernels import tangles as kernels


class Tangles:
    """Pairs of triangles that cross or touch at the start, and the pairs of contact that are left out for them.

    A vertex that goes through a triangle changes which triangles cross: each triangle of the vertex, with that triangle. Two
    edges that go through one another change it for each triangle of the one with each of the other. The filter leaves out a
    pair of contact only if all these pairs of triangles are tangled, so that no others come to cross; forces leave it out if
    one of them is. Two triangles are free once they neither cross nor are nearer than ``least`` at the end of a step. Then they
    stay so, for the filter has all their pairs.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        state: The :class:`warpcloth.core.state.State` of the solver, to which it adds which pairs are free.
        edges: Edges (E, 2) that go through triangles, vertices of the model.
        triangles: These triangles (E, 3).
        near: Pairs of contact that are too near, two lists of (m, 4): of a vertex and a triangle, and of two edges.
        least: Distance [m] from which two triangles are free.

    Attributes:
        pairs: The triangles of each tangled pair, (K, 2) indices in the mesh.
        copies: The copy of each, (K,).
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
        """Which have come free, (K,) 0 or 1."""
        return self._left.free.numpy()

    def left(self):
        """How many pairs of triangles have not come free yet, (B,)."""
        return np.bincount(self.copies[self.free == 0], minlength=self.model.copies)

    def start_again(self):
        """Forgets which have come free."""
        self._left.free.zero_()

    def launch_leave_out(self, stencils, counts, gap):
        """Sets the gap [m] of pairs that are left out to infinity, at which there is no contact."""
        self.model.launch(kernels.leave_out, len(stencils), [stencils, counts, self._left], [gap])

    def launch_open(self, stencils, counts, open):
        """Finds the pairs that no plane divides."""
        self.model.launch(kernels.find_open, len(stencils), [stencils, counts, self._left], [open])

    def launch_free(self, x):
        """Notes which triangles are free at x (N,)."""
        self.model.launch(self._free, len(self._keys), [self._corners, x, self.least], [self._left.free])


class _Incidence:
    """Which triangles and edges of all copies meet, by indices that count through the copies."""

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
        """Indices (m,) of edges by their ends (m, 2)."""
        ends = np.sort(np.asarray(ends, dtype=np.int64).reshape(-1, 2), axis=1)
        return np.searchsorted(self._edge_keys, ends[:, 0] * self.vertices + ends[:, 1])

    def triangle(self, corners):
        """Indices (m,) of triangles by their vertices (m, 3): those of an edge of each that have its third vertex too."""
        corners = np.sort(np.asarray(corners, dtype=np.int64).reshape(-1, 3), axis=1)
        around = self._of_edge[self.edge(corners[:, :2])]
        has = (self.triangles[around] == corners[:, None, 2:]).any(axis=2) & (around >= 0)
        return around[np.arange(len(corners)), has.argmax(axis=1)]

    def key(self, one, other):
        """A number for each pair of triangles, −1 where one is none, or both are one."""
        keys = np.minimum(one, other) * self.count + np.maximum(one, other)
        return np.where((one >= 0) & (other >= 0) & (one != other), keys, -1)

    def of_crossings(self, edges, triangles):
        """Pairs of triangles that cross where edges (m, 2) go through triangles (m, 3)."""
        keys = self.key(self._of_edge[self.edge(edges)], self.triangle(triangles)[:, None])
        return keys[keys >= 0]

    def of_near(self, stencils, first):
        """Pairs of triangles of which contact has these pairs (m, 4), the first side of which has so many vertices."""
        stencils = np.asarray(stencils, dtype=np.int64).reshape(-1, 4)
        if first == 1:
            keys = self.of_vertices(stencils[:, 0], self.triangle(stencils[:, 1:]))
        else:
            keys = self.of_edges(self.edge(stencils[:, :2]), self.edge(stencils[:, 2:]))
        return keys[keys >= 0]

    def of_vertices(self, vertices, triangles):
        """Pairs of triangles that come to cross, or cease to, where vertices (m,) go through triangles (m,): (m, k) keys."""
        return self.key(self._of_vertex[vertices], triangles[:, None])

    def of_edges(self, one, other):
        """Likewise where edges (m,) go through edges (m,)."""
        keys = self.key(self._of_edge[one][:, :, None], self._of_edge[other][:, None, :])
        return keys.reshape(len(one), self._of_edge.shape[1] ** 2)

    def left_out(self, tangled):
        """The pairs of contact between triangles in ``tangled`` (K,), sorted keys.

        Returns:
            How many are of a vertex and a triangle; their vertices (P, 4), sorted; whether all of their pairs of triangles are
            tangled (P,); offsets (P + 1,) in the indices of those that are; these indices.
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
    """For each of ``count`` numbers the rows of ``members`` (T, 3) that have it, (count, k) with −1 after the last."""
    order = np.argsort(members.ravel(), kind="stable")
    numbers = members.ravel()[order]
    sizes = np.bincount(numbers, minlength=count)
    rank = np.arange(len(numbers)) - (np.cumsum(sizes) - sizes)[numbers]
    found = np.full((count, max(sizes.max(initial=0), 1)), -1, dtype=np.int64)
    found[numbers, rank] = order // 3
    return found
