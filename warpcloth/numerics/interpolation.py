"""Interpolation of displacements between levels of a cloth, for multigrid.

A level keeps an independent set of the vertices of the finer one, so that every dropped vertex has a kept neighbour. Vertices
take displacements from a few kept ones, with weights by moving least squares (Levin 1998) on the rest shape. The weights
reproduce each affine function of the rest positions, and therefore translations and rotations of a flat piece, in whatever
shape the cloth is. So they do not change during a run, and one weight serves all three coordinates.
"""

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


def interpolations(points, pairs, free, coarsest):
    """Returns the interpolation to each level from the next coarser one, finer ones first.

    Args:
        points: Rest positions (n, 3) [m].
        pairs: Pairs of vertices (E, 2) of which a coarser level keeps one, see :func:`neighbours`.
        free: Which vertices move, (n,) booleans. The others have no level.
        coarsest: The number of vertices below which a level gets no coarser one.

    Returns:
        A list of scipy matrices in compressed rows, (n, n₁), (n₁, n₂) …, whose rows sum to 1, or to 0 for vertices that do not
        move.
    """
    from scipy.sparse import coo_array, csr_array

    found, n = [], len(points)
    vertices, ones = np.flatnonzero(free), np.ones(len(pairs), dtype=np.int32)
    joined = coo_array((ones, pairs.T), shape=(n, n)).tocsr()[vertices][:, vertices]
    graph, at = _pattern(joined + joined.T), np.asarray(points, dtype=np.float64)[vertices]
    while len(at) > coarsest:
        kept = np.flatnonzero(_independent(graph))
        if len(kept) * SHRINKS > len(at):
            break
        weights, graph = _coarser(graph, at, kept)
        if not found:
            first = csr_array((np.ones(len(vertices)), (vertices, np.arange(len(vertices)))), (n, len(vertices)))
            weights = first @ weights
        weights.sort_indices()
        found.append(weights)
        at = at[kept]
    return found


def _pattern(matrix):
    """Returns a matrix of ones where ``matrix`` has an entry off its diagonal."""
    from scipy.sparse import csr_array

    whole = matrix.tocoo()
    off = whole.row != whole.col
    ones = np.ones(np.count_nonzero(off), dtype=np.int32)
    return csr_array((ones, (whole.row[off], whole.col[off])), shape=matrix.shape)


def _independent(graph):
    """Returns which vertices are kept, (n,): in order, each one without a kept neighbour."""
    offsets, neighbours = graph.indptr.tolist(), graph.indices.tolist()
    kept, decided = np.zeros(graph.shape[0], dtype=bool), bytearray(graph.shape[0])
    for v in range(graph.shape[0]):
        if not decided[v]:
            kept[v] = True
            for u in neighbours[offsets[v] : offsets[v + 1]]:
                decided[u] = 1
    return kept


def _coarser(graph, points, kept):
    """Returns the interpolation from the ``kept`` vertices, (n, n_c), and the graph of these.

    Each vertex belongs to the nearest kept vertex among itself and its neighbours. Kept vertices are neighbours if the graph
    joins vertices that belong to them.
    """
    from scipy.sparse import csr_array, eye_array

    n, coarse = len(points), len(kept)
    itself = eye_array(n, dtype=np.int32, format="csr")
    chosen = csr_array((np.ones(coarse, dtype=np.int32), (kept, np.arange(coarse))), shape=(n, coarse))
    near = _sorted(((graph + itself) @ chosen).tocoo(), points, kept)
    owner = near[1][np.searchsorted(near[0], np.arange(n))]
    belongs = csr_array((np.ones(n, dtype=np.int32), (np.arange(n), owner)), shape=(n, coarse))
    joined = _pattern(belongs.T @ graph @ belongs)
    candidates = belongs @ (joined + eye_array(coarse, dtype=np.int32, format="csr"))
    rows, parents, distances = _sorted(candidates.tocoo(), points, kept)
    first = np.searchsorted(rows, np.arange(n))
    used = np.arange(len(rows)) - first[rows] < PARENTS
    rows, parents, distances = rows[used], parents[used], distances[used]
    weights = _moving_least_squares(rows, points[kept[parents]] - points[rows], distances)
    own = kept[parents] == rows
    is_kept = np.zeros(n, dtype=bool)
    is_kept[kept] = True
    weights = np.where(is_kept[rows], own.astype(float), weights)
    used = weights != 0.0
    return csr_array((weights[used], (rows[used], parents[used])), shape=(n, coarse)), joined


def _sorted(pairs, points, kept):
    """Returns (row, kept vertex, distance) of the entries of a matrix, sorted by row and distance."""
    distances = np.linalg.norm(points[pairs.row] - points[kept[pairs.col]], axis=1)
    order = np.lexsort((pairs.col, distances, pairs.row))
    return pairs.row[order], pairs.col[order], distances[order]


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
