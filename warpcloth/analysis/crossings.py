"""Finds intersecting triangles by exact predicates."""

from importlib.util import find_spec

import numpy as np


class Crossings:
    """Finds the pairs of triangles of a mesh that intersect.

    Triangles intersect if they touch, or, with a common vertex or edge, if they have more in common. Tests use the exact
    orientation predicates of libigl (Shewchuk 1997, *Adaptive precision floating-point arithmetic and fast robust geometric
    predicates*).

    Args:
        triangles: (T, 3), one index per vertex.

    Raises:
        ImportError: libigl is not installed.
    """

    def __init__(self, triangles: np.ndarray) -> None:
        if not find_spec("igl"):
            raise ImportError("intersections need libigl: pip install -e '.[check]' in the checkout")
        self._triangles = np.ascontiguousarray(triangles, dtype=np.int64)
        a, b, c = self._triangles.T
        self._proper = (a != b) & (b != c) & (c != a)
        self._fans, self._hinges, self._twins = _neighbours(self._triangles, np.flatnonzero(self._proper))

    def pairs(self, points: np.ndarray, judged: np.ndarray) -> np.ndarray:
        """Returns the pairs that intersect, (P, 2), sorted, of ``judged`` triangles (T,), with area, at points (n, 3) [m]."""
        from igl.predicates import find_self_intersections

        judged = judged & self._proper
        points, own = np.ascontiguousarray(points, dtype=np.float64), np.flatnonzero(judged)
        found = [np.empty((0, 2), np.int64)]
        if len(own):
            apart = own[find_self_intersections(points, self._triangles[own])[1].reshape(-1, 2)]
            # libigl tests neighbours with a tolerance of 1e-8, so they are tested here.
            corners = self._triangles[apart]
            found.append(apart[~(corners[:, 0, :, None] == corners[:, 1, None]).any(axis=(1, 2))])
        for candidates, cross in ((self._fans, _fans_cross), (self._hinges, _hinges_overlap)):
            rows, corners = candidates
            kept = judged[rows].all(axis=1)
            found.append(rows[kept][cross(points[corners[kept]])])
        found.append(self._twins[judged[self._twins].all(axis=1)])
        pairs = np.sort(np.concatenate(found), axis=1)
        return pairs[np.lexsort(pairs.T[::-1])]


def have_area(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Returns which triangles (T, 3) of points (n, 3) have an area, exactly, (T,)."""
    corners = points[triangles]
    found = np.zeros(len(triangles), dtype=bool)
    for axis in range(3):
        flat = corners.copy()
        flat[:, :, axis] = 0.0
        a, b, c = flat.transpose(1, 0, 2)
        found |= _side(a, b, c, np.broadcast_to(np.eye(3)[axis], (len(flat), 3))) != 0
    return found


def _side(a, b, c, d):
    """Returns the side of the plane abc of d, each (k, 3), exactly: 1, −1 or 0, (k,)."""
    from igl.predicates import orient3d

    return orient3d(*(np.ascontiguousarray(each) for each in (a, b, c, d))) if len(a) else np.zeros(0, np.int32)


def _fans_cross(corners):
    """Returns which triangles (v, a, b) and (v, c, d) have more than v in common, (k,), from corners (k, 5, 3).

    Near v they are sectors, which meet the plane of the other in rays that may coincide.
    """
    v, a, b, c, d = corners.transpose(1, 0, 2)
    of_first = [_side(v, c, d, each) for each in (a, b)]
    of_second = [_side(v, a, b, each) for each in (c, d)]
    rises, falls = ([(low <= 0) & (high >= 0) for low, high in (each, each[::-1])] for each in (of_first, of_second))
    found = (rises[0] & falls[1]) | (rises[1] & falls[0])
    flat = (of_first[0] == 0) & (of_first[1] == 0)
    found[flat] = _sectors_overlap(*(each[flat] for each in (v, a, b, c, d)))
    return found


def _sectors_overlap(v, a, b, c, d):
    above = _above(v, a, b)

    def holds(left, right, ray):
        turn = _side(v, left, right, above)
        return (turn * _side(v, left, ray, above) >= 0) & (turn * _side(v, ray, right, above) >= 0)

    return holds(a, b, c) | holds(a, b, d) | holds(c, d, a) | holds(c, d, b)


def _hinges_overlap(corners):
    """Returns which triangles (u, v, a) and (u, v, b) are folded flat, (k,), from corners (k, 4, 3)."""
    u, v, a, b = corners.transpose(1, 0, 2)
    found = _side(u, v, a, b) == 0
    u, v, a, b = (each[found] for each in (u, v, a, b))
    above = _above(u, v, a)
    found[found] = _side(u, v, a, above) == _side(u, v, b, above)
    return found


def _above(a, b, c):
    """Returns points (k, 3) off the planes abc: steps from a along the axis nearest to the normal."""
    normal = np.cross(b - a, c - a)
    rows, axis = np.arange(len(a)), np.abs(normal).argmax(axis=1) if len(a) else np.zeros(0, int)
    found = a.copy()
    found[rows, axis] += np.linalg.norm(b - a, axis=1) + np.linalg.norm(c - a, axis=1)
    return found


def _neighbours(triangles, own):
    """Finds the pairs of triangles with one common vertex (k, 5) and with two (k, 4), those vertices first, and with three."""
    count = len(triangles)
    corners = triangles[own].ravel()
    order = np.argsort(corners, kind="stable")
    vertex, owner = corners[order], own[order // 3]
    starts = np.flatnonzero(np.diff(vertex, prepend=-1))
    sizes = np.diff(starts, append=len(vertex))
    rows = np.arange(len(vertex))
    later = np.repeat(starts + sizes, sizes) - rows - 1  # number of later corners at the same vertex
    first = np.repeat(rows, later)
    second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(later) - later, later)
    keys, common = np.unique(owner[first] * count + owner[second], return_counts=True)
    pairs = np.stack([keys // count, keys % count], axis=1)
    found = []
    for shared in (1, 2):
        some = pairs[common == shared]
        a, b = triangles[some[:, 0]], triangles[some[:, 1]]
        in_both, in_first = (a[:, :, None] == b[:, None]).any(axis=2), (b[:, :, None] == a[:, None]).any(axis=2)
        parts = [a[in_both].reshape(-1, shared), a[~in_both].reshape(-1, 3 - shared), b[~in_first].reshape(-1, 3 - shared)]
        found.append((some, np.concatenate(parts, axis=1)))
    return *found, pairs[common == 3]
