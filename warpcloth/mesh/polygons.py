"""Cuts polygons into triangles."""

import numpy as np

from ..kernels.deformation import FLATTEST

# Largest ratio of the area of a face's triangles to that of its outline; a face folded by 90° along a diagonal has it.
_MAX_FOLD = 2**0.5
_STRAIGHT = 3e-5  # ratio of height to longest side below which a corner of a fan is straight but for rounding
_TOUCHING = 1e-5  # how far sides must pass through each other to cross, relative to the size of the face


def triangles_of(points, counts, holes=()):
    """Cuts faces like :func:`cut`, and raises ValueError for one that crosses or touches itself or is far from planar."""
    triangles, bad = cut(points, counts, holes)
    for face in bad[:1]:
        raise ValueError(f"face {face} crosses or touches itself, or is not planar; its outline must be simple and nearly flat")
    return triangles


def loose_triangles_of(points, counts, holes=()):
    """Cuts faces like :func:`cut`; those that cannot be cut become fans."""
    return cut(points, counts, holes)[0]


def cut(points, counts, holes=()):
    """Cuts faces (F,) of ``counts`` corners (C, 3) into triangles (T, 3) of corners, each of k corners into k − 2, but for
    ``holes``.

    A face becomes a fan from its first corner if none of its triangles is flat or turned over. Others are cut by ear clipping
    (mapbox-earcut) in a coordinate plane, and flipped until all diagonals are Delaunay. Faces that cross or touch themselves or
    are far from planar become fans, and are returned too.
    """
    solid = np.ones(len(counts), dtype=bool)
    solid[np.asarray(holes, dtype=np.int64)] = False
    face = np.repeat(np.arange(len(counts)), np.where(solid, counts - 2, 0))
    start = (np.cumsum(counts) - counts)[face]
    step = np.arange(len(face)) - np.searchsorted(face, face)
    triangles = np.stack([start, start + step + 1, start + step + 2], axis=1)
    of_polygons = np.flatnonzero(counts[face] > 3)
    if not len(of_polygons):
        return triangles, []
    polygons, first, sizes = np.unique(face[of_polygons], return_index=True, return_counts=True)
    corners = points[triangles[of_polygons]]
    with np.errstate(invalid="ignore", over="ignore"):
        normals = _normals(corners)
        outlines = np.add.reduceat(normals, first)  # area vectors
        upwards = np.einsum("ti,ti->t", normals, np.repeat(outlines, sizes, axis=0)) > 0.0
        cosines = np.einsum("ti,ti->t", corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        angles = np.arctan2(np.linalg.norm(normals, axis=1), cosines)
        heights = _heights(corners, normals)
        fans = np.logical_and.reduceat(upwards & (heights > FLATTEST), first)
        fans &= np.add.reduceat(angles, first) <= 2.0 * np.pi  # else the fan overlaps itself
        kept = fans & np.logical_and.reduceat(heights > _STRAIGHT, first)
        solid = np.logical_or.reduceat(heights > FLATTEST, first) & np.isfinite(outlines).all(axis=1)
        others = np.flatnonzero(solid & ~kept)
        bad = np.zeros(len(sizes), dtype=bool)
        if len(others):
            found, good = _ears(points, start[of_polygons[first[others]]], sizes[others] + 2, outlines[others])
            rows = np.flatnonzero(np.isin(np.repeat(np.arange(len(sizes)), sizes), others[good]))
            triangles[of_polygons[rows]] = found
            normals[rows] = _normals(points[found])
            bad[others] = ~good & ~fans[others]
        areas = np.add.reduceat(np.linalg.norm(normals, axis=1), first)
        bad |= areas > _MAX_FOLD * (1.0 + FLATTEST) * np.linalg.norm(outlines, axis=1)
    return triangles, polygons[bad].tolist()


def _normals(corners):
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _heights(corners, normals):
    sides = corners - np.roll(corners, 1, axis=1)
    return np.linalg.norm(normals, axis=1) / np.einsum("tki,tki->tk", sides, sides).max(axis=1)


def _ears(points, starts, counts, outlines):
    """Cuts faces with these first corners in points (C, 3), numbers of corners and area vectors (F, 3) into triangles (T, 3),
    and returns which could be cut.
    """
    import mapbox_earcut

    ends, axes = np.cumsum(counts), np.abs(outlines).argmax(axis=1)
    begins, face = ends - counts, np.repeat(np.arange(len(counts)), counts)
    corners = np.repeat(starts - begins, counts) + np.arange(len(face))
    # Dropping a coordinate keeps lines straight and orders of corners, without rounding.
    kept = (axes[:, None] + [1, 2]) % 3
    kept = np.where((outlines[np.arange(len(axes)), axes] > 0.0)[:, None], kept, kept[:, ::-1])
    p = np.take_along_axis(points[corners] - points[starts[face]], kept[face], axis=1)
    p /= np.maximum.reduceat(np.abs(p).max(axis=1), begins)[face, None]
    # Earcut leaves out corners that lie on a line exactly, so lines are bent for it.
    bent = p + 1e-7 * np.sin(p @ np.array([[7.0, 11.0], [13.0, 5.0]]))
    found = [
        begin + mapbox_earcut.triangulate_float64(bent[begin:end], np.array([end - begin], dtype=np.uint32)).reshape(-1, 3)
        for begin, end in zip(begins.tolist(), ends.tolist(), strict=True)
    ]
    good = (np.array([len(each) for each in found]) == counts - 2) & ~_crossing(p, face)
    found = np.concatenate(found).astype(np.int64)
    chosen = _delaunay(p, found[good[face[found[:, 0]]]])
    a, b, c = p[chosen].swapaxes(0, 1)
    x = points[corners[chosen]]
    wrong = ~((_cross(b - a, c - a) > 0.0) & (_heights(x, _normals(x)) > FLATTEST))
    good[face[chosen[wrong, 0]]] = False
    return corners[chosen[good[face[chosen[:, 0]]]]], good


def _cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _delaunay(p, triangles):
    """Flips diagonals of plane triangles (T, 3) with corners p (k, 2) until none sees more than 180°."""
    for _ in range(len(p)):
        start, end, apex = (np.roll(triangles, -k, axis=1).ravel() for k in range(3))
        keys = np.minimum(start, end) * len(p) + np.maximum(start, end)
        order = np.argsort(keys, kind="stable")
        twice = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
        one, two = order[twice], order[twice + 1]
        to_start, to_end = p[start] - p[apex], p[end] - p[apex]
        angles = np.arctan2(np.abs(_cross(to_start, to_end)), (to_start * to_end).sum(axis=1))
        seen = angles[one] + angles[two]
        a, b, c, d = p[start[one]], p[end[one]], p[apex[one]], p[apex[two]]
        wrong = np.flatnonzero((seen > np.pi + 1e-9) & (_cross(a - c, d - c) > 0.0) & (_cross(b - d, c - d) > 0.0))
        if not len(wrong):
            break
        wrong = wrong[np.argsort(-seen[wrong], kind="stable")]
        one, two = one[wrong], two[wrong]
        # Of the diagonals of one triangle the worst is flipped first.
        ranks, pairs = np.full(len(triangles), len(wrong)), np.stack([one // 3, two // 3])
        np.minimum.at(ranks, pairs.ravel(), np.tile(np.arange(len(wrong)), 2))
        ready = (ranks[pairs] == np.arange(len(wrong))).all(axis=0)
        one, two = one[ready], two[ready]
        triangles[one // 3] = np.stack([apex[one], start[one], apex[two]], axis=1)
        triangles[two // 3] = np.stack([apex[two], end[one], apex[one]], axis=1)
    return triangles


def _crossing(p, face):
    """Returns which polygons have sides that cross, from all corners (k, 2) and their polygon."""
    found, after = np.zeros(face[-1] + 1, dtype=bool), np.arange(1, len(p) + 1)
    last = np.flatnonzero(np.diff(face, append=-1))
    after[last] = np.searchsorted(face, face[last])
    ends = np.stack([p[:, 0], p[after, 0]]) + 4.0 * face  # polygons lie beside one another
    order = np.argsort(ends.min(axis=0), kind="stable")
    lows, highs = ends[:, order].min(axis=0), ends[:, order].max(axis=0)
    one, step = np.arange(len(p)), 0
    while len(one):
        step += 1
        one = one[one + step < len(p)]
        one = one[lows[one + step] <= highs[one]]
        first, second = order[one], order[one + step]
        a, b, c, d = p[first], p[after[first]], p[second], p[after[second]]
        found[face[first[_pass(a, b, c, d) & _pass(c, d, a, b)]]] = True
    return found


def _pass(a, b, c, d):
    least = _TOUCHING * np.linalg.norm(b - a, axis=1)
    left, right = _cross(b - a, c - a), _cross(b - a, d - a)
    return (np.minimum(left, right) < -least) & (np.maximum(left, right) > least)
