"""Vertices at one position: where a mesh is cut, as along the seams of textures, and how they are welded."""

import numpy as np


def welded(faces):
    """Returns `FileFaces` without vertices that lie along a seam upon others; these are welded into the first of them."""
    pairs = _seam_pairs(faces.points, faces.counts, faces.corners)
    into = np.arange(len(faces.points))
    into[pairs[:, 1]] = pairs[:, 0]
    kept, renumbered = np.unique(into, return_inverse=True)
    at_vertices = faces.st is not None and len(faces.st) == len(into)
    st = faces.st[faces.corners] if at_vertices else faces.st
    return faces._replace(points=faces.points[kept], corners=renumbered[faces.corners], st=st) if len(pairs) else faces


def seam_pairs(points, triangles):
    """Returns pairs of vertices at one position (m, 2): the first on a seam, and each other.

    A seam is a side of one triangle alone where another such side lies.

    Args:
        points: (n, 3).
        triangles: (T, 3).
    """
    return _seam_pairs(points, np.full(len(triangles), 3), triangles.ravel())


def coincident(points):
    """Returns how many of the points (n, 3) lie exactly upon another that comes before."""
    return len(points) - len(first_of_equals(points)[0])


def piece_count(mesh):
    """Returns the number of connected pieces of a `Mesh`; a vertex without edges is one."""
    from scipy.sparse import coo_array  # loaded late, as importing this package stays light
    from scipy.sparse.csgraph import connected_components

    n, joined = len(mesh.points), tuple(mesh.edges.T)
    return int(connected_components(coo_array((np.ones(len(mesh.edges)), joined), shape=(n, n)), directed=False)[0])


def _seam_pairs(points, counts, corners):
    """Like :func:`seam_pairs`, for faces of several numbers of corners (F,), with their vertices one after another (C,)."""
    first, group = first_of_equals(points)
    if len(first) == len(points):
        return np.empty((0, 2), dtype=np.int64)
    following = np.arange(1, len(corners) + 1)
    following[np.cumsum(counts) - 1] -= counts
    sides = np.sort(np.stack([corners, corners[following]], axis=1), axis=1)
    free = sides[_times(sides) == 1]
    seam = np.unique(free[_times(np.sort(group[free], axis=1)) > 1])
    _, at, which = np.unique(group[seam], return_index=True, return_inverse=True)
    pairs = np.stack([seam[at][which], seam], axis=1)
    return pairs[pairs[:, 0] != pairs[:, 1]]


def _times(rows):
    """Returns how often each row occurs."""
    _, which, times = np.unique(rows, axis=0, return_inverse=True, return_counts=True)
    return times[which.ravel()]


def first_of_equals(points):
    """Returns the first row of each set of equal rows, in order, and for each row the index of its set."""
    order = np.lexsort(points.T)  # stable: equal rows stay in order
    new = np.concatenate([[True], (points[order][1:] != points[order][:-1]).any(axis=1)])
    first = order[new]
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    group = np.empty(len(points), dtype=np.int64)
    group[order] = rank[np.cumsum(new) - 1]
    return np.sort(first), group
