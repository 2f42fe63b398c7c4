"""Vertices at one position, as along seams of textures, and how they are welded."""

import numpy as np


def welded(faces):
    """Returns `FileFaces` whose seams are welded into the first vertices."""
    pairs = _seam_pairs(faces.points, faces.counts, faces.corners)
    into = np.arange(len(faces.points))
    into[pairs[:, 1]] = pairs[:, 0]
    kept, renumbered = np.unique(into, return_inverse=True)
    return faces._replace(points=faces.points[kept], corners=renumbered[faces.corners]) if len(pairs) else faces


def seam_pairs(points, triangles):
    """Returns pairs of vertices at one position (m, 2): the first on a seam, and each other.

    A seam is a side of one triangle (T, 3) where another such side lies, unless the triangles lie upon each other, as two
    layers do.
    """
    return _seam_pairs(points, np.full(len(triangles), 3), triangles.ravel())


def coincident(points):
    """Returns how many of points (n, 3) equal one before."""
    return len(points) - len(first_of_equals(points)[0])


def piece_count(mesh):
    """Returns the number of connected pieces of a `Mesh`, vertices without edges included."""
    from scipy.sparse import coo_array  # loaded late, as importing this package stays light
    from scipy.sparse.csgraph import connected_components

    n, joined = len(mesh.points), tuple(mesh.edges.T)
    return int(connected_components(coo_array((np.ones(len(mesh.edges)), joined), shape=(n, n)), directed=False)[0])


@np.errstate(invalid="ignore", over="ignore")  # points may be infinite
def _seam_pairs(points, counts, corners):
    first, group = first_of_equals(points)
    if len(first) == len(points):
        return np.empty((0, 2), dtype=np.int64)
    following = np.arange(1, len(corners) + 1)
    following[np.cumsum(counts) - 1] -= counts
    sides = np.stack([corners, corners[following]], axis=1)
    free = np.flatnonzero(_equal_rows(np.sort(sides, axis=1))[2] == 1)
    first, which, times = _equal_rows(np.sort(group[sides[free]], axis=1))
    normals = np.repeat(_area_vectors(points[corners], points[corners[following]], counts), counts, axis=0)[free]
    lengths, starts = np.linalg.norm(normals, axis=1), group[sides[free, 0]]
    # Sides of one surface run in opposite directions, and faces that turn back lie upon each other. Sides in the same direction
    # may be of a surface that is wound both ways, which goes on there, or of two layers.
    ahead = starts == starts[first]
    cosines = np.where(ahead, 1.0, -1.0) * (normals * normals[first]).sum(axis=1)
    layers = (cosines > np.where(ahead, 0.5, 1.0 - 1e-6) * lengths * lengths[first]) & (first != np.arange(len(free)))
    seam = np.unique(sides[free[(times > 1) & ~np.isin(which, which[layers])]])
    _, at, which = np.unique(group[seam], return_index=True, return_inverse=True)
    pairs = np.stack([seam[at][which], seam], axis=1)
    return pairs[pairs[:, 0] != pairs[:, 1]]


def _equal_rows(rows):
    """Returns for each row the first equal one, the number of their set, and its size."""
    _, first, which, times = np.unique(rows, axis=0, return_index=True, return_inverse=True, return_counts=True)
    which = which.ravel()
    return first[which], which, times[which]


def _area_vectors(starts, ends, counts):
    begins = np.cumsum(counts) - counts
    origins = np.repeat(starts[begins], counts, axis=0)
    return np.add.reduceat(np.cross(starts - origins, ends - origins), begins)


def first_of_equals(points):
    """Returns the first row of each set of equal rows, and the index of each row's set."""
    order = np.lexsort(points.T)  # stable: equal rows stay in order
    new = np.concatenate([[True], (points[order][1:] != points[order][:-1]).any(axis=1)])
    first = order[new]
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    group = np.empty(len(points), dtype=np.int64)
    group[order] = rank[np.cumsum(new) - 1]
    return np.sort(first), group
