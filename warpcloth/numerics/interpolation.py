"""Interpolation of displacements between levels of a cloth, for multigrid.

A level keeps an independent set of the vertices of the finer one, so that every dropped vertex has a kept neighbour. Vertices
take displacements from a few kept ones, with weights by moving least squares (Levin 1998) on the rest shape. The weights
reproduce each affine function of the rest positions, and therefore translations and rotations of a flat piece, in whatever
shape the cloth is. So they do not change during a run, and one weight serves all three coordinates.
"""

from typing import NamedTuple

import numpy as np

# A level has at least this many times fewer vertices than the finer one; otherwise it is not worth its launches.
SHRINKS = 1.2
# Vertices follow so many of the nearest kept ones, whose weights fall to 0 at FAR times the distance of the last.
PARENTS, FAR = 4, 1.3


def neighbours(mesh):
    """Returns the edges of a mesh and the pairs of vertices opposite them, (E, 2).

    On a grid these are the 8 neighbours of a vertex, of which an independent set has a quarter. A mesh in which three triangles
    share an edge has no hinges; then it is the edges alone.
    """
    if not len(mesh.triangles):
        return mesh.edges
    try:
        return np.concatenate([mesh.edges, mesh.hinges[:, 2:]])
    except ValueError:
        return mesh.edges


class Interpolation(NamedTuple):
    """The interpolation P (n, n_c) to a level from the next coarser one, in compressed rows.

    Attributes:
        offsets: Where each row starts, (n + 1,).
        parents: The coarse vertices that each vertex follows, ascending in a row.
        weights: Their weights, which sum to 1 in a row, or to 0 for vertices that do not move.
        coarse: n_c.
    """

    offsets: np.ndarray
    parents: np.ndarray
    weights: np.ndarray
    coarse: int

    def transposed(self):
        """Returns (offsets, vertices, weights) of the columns."""
        order = np.argsort(self.parents, kind="stable")
        rows = np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))
        return _offsets(self.parents, self.coarse), rows[order], self.weights[order]

    def matrix(self):
        """Returns P as a scipy matrix in compressed rows."""
        from scipy.sparse import csr_array

        return csr_array((self.weights, self.parents, self.offsets), (len(self.offsets) - 1, self.coarse))


def interpolations(points, pairs, free, coarsest):
    """Returns the interpolation to each level from the next coarser one, as scipy matrices; see :func:`find`."""
    return [level.matrix() for level in find(points, pairs, free, coarsest)]


def find(points, pairs, free, coarsest):
    """Finds the interpolation to each level from the next coarser one, finer ones first.

    Args:
        points: Rest positions (n, 3) [m].
        pairs: Pairs of vertices (E, 2) of which a coarser level keeps one, see :func:`neighbours`.
        free: Which vertices move, (n,) booleans. The others have no level.
        coarsest: The number of vertices below which a level gets no coarser one.

    Returns:
        A list of :class:`Interpolation`.
    """
    found, vertices = [], np.flatnonzero(free)
    number = np.full(len(free), -1)
    number[vertices] = np.arange(len(vertices))
    one, two = number[np.asarray(pairs)].T
    both = (one >= 0) & (two >= 0)
    edges = _symmetric(one[both], two[both], len(vertices))
    at = np.asarray(points, dtype=np.float64)[vertices]
    while len(at) > coarsest:
        is_kept = _independent(edges, len(at))
        coarse = int(np.count_nonzero(is_kept))
        if coarse * SHRINKS > len(at):
            break
        rows, parents, weights, edges = _coarser(edges, at, is_kept)
        if not found:
            rows = vertices[rows]
        found.append(Interpolation(_offsets(rows, len(at) if found else len(free)), parents, weights, coarse))
        at = at[is_kept]
    return found


def _offsets(rows, n):
    """Returns where each of n rows starts, (n + 1,), from the row of each entry."""
    return np.append(0, np.cumsum(np.bincount(rows, minlength=n)))


def _symmetric(one, two, n):
    """Returns (row, column) of the entries of a symmetric pattern with its diagonal, sorted and once each."""
    n, itself = np.int64(n), np.arange(n)
    keys = np.sort(np.concatenate([one * n + two, two * n + one, itself * n + itself]))
    return np.divmod(keys[np.flatnonzero(np.diff(keys, prepend=-1))], max(n, 1))


def _independent(edges, n):
    """Returns which vertices are kept, (n,): in order, each one without a kept neighbour."""
    offsets, neighbours = _offsets(edges[0], n).tolist(), edges[1].tolist()
    kept, decided = np.zeros(n, dtype=bool), bytearray(n)
    for v in range(n):
        if not decided[v]:
            kept[v] = True
            for u in neighbours[offsets[v] : offsets[v + 1]]:
                decided[u] = 1
    return kept


def _coarser(edges, points, is_kept):
    """Finds the interpolation from the kept vertices, and which of these are neighbours.

    Each vertex belongs to the nearest kept vertex among itself and its neighbours. Kept vertices are neighbours if vertices
    that belong to them are.

    Args:
        edges: (row, column) of the vertices and their neighbours, sorted.
        points: Positions (n, 3) [m].
        is_kept: Which vertices are kept, (n,).

    Returns:
        (rows, parents, weights, edges): the entries of the interpolation, sorted, and the edges of the coarser level.
    """
    kept, dropped = np.flatnonzero(is_kept), np.flatnonzero(~is_kept)
    coarse = len(kept)
    number = np.cumsum(is_kept) - 1
    near = is_kept[edges[1]]
    rows, parents, _ = _sorted(edges[0][near], number[edges[1][near]], points, kept)
    owner = np.empty(len(points), dtype=np.int64)
    owner[rows[::-1]] = parents[::-1]  # the first of each row, which is the nearest
    joined = _symmetric(owner[edges[0]], owner[edges[1]], coarse)
    starts = _offsets(joined[0], coarse)
    own = owner[dropped]
    counts = starts[own + 1] - starts[own]
    first = np.cumsum(counts) - counts
    others = joined[1][np.arange(counts.sum()) + np.repeat(starts[own] - first, counts)]
    rows, parents, distances = _sorted(np.repeat(dropped, counts), others, points, kept)
    used = np.arange(len(rows)) - _offsets(rows, len(points))[rows] < PARENTS
    rows, parents, distances = rows[used], parents[used], distances[used]
    weights = _moving_least_squares(rows, points[kept[parents]] - points[rows], distances)
    used = weights != 0.0
    rows, parents = np.concatenate([kept, rows[used]]), np.concatenate([number[kept], parents[used]])
    order = np.argsort(rows * np.int64(coarse) + parents)
    return rows[order], parents[order], np.concatenate([np.ones(coarse), weights[used]])[order], joined


def _sorted(rows, parents, points, kept):
    """Returns (row, kept vertex, distance), sorted by row and distance, and where these are equal as they were given."""
    distances = np.linalg.norm(points[kept[parents]] - points[rows], axis=1)
    order = np.lexsort((distances, rows))
    return rows[order], parents[order], distances[order]


def _moving_least_squares(rows, offsets, distances):
    """Returns weights (E,) of the parents of each row, sorted by row and distance, that sum to 1.

    They minimise Σ w²/φ among those with Σ w = 1 and Σ w·offset = 0, and are 0 beyond FAR times the third distance. The second
    condition is met as far as the offsets span, because a small multiple of their moments is added to these.
    """
    starts = np.flatnonzero(np.diff(rows, prepend=-1))
    counts = np.diff(np.append(starts, len(rows)))
    of_row = np.repeat(np.arange(len(starts)), counts)
    radius = FAR * distances[starts + counts - 1]
    radius = np.maximum(radius, 1e-30)[of_row]
    near = distances / radius
    phi = (np.maximum(1.0 - near, 0.0) / (near + 1e-3)) ** 2
    basis = np.concatenate([np.ones((len(rows), 1)), offsets / radius[:, None]], axis=1)
    moments = np.add.reduceat(phi[:, None, None] * basis[:, :, None] * basis[:, None, :], starts, axis=0)
    axes = np.arange(1, 4)
    spread = moments[:, axes, axes].sum(axis=1)
    moments[:, axes, axes] += (1e-4 * spread + 1e-12 * moments[:, 0, 0] + 1e-30)[:, None]
    right = np.zeros((len(starts), 4, 1))
    right[:, 0] = 1.0
    coefficients = np.linalg.solve(moments, right)[:, :, 0]
    return phi * np.einsum("ek,ek->e", basis, coefficients[of_row])
