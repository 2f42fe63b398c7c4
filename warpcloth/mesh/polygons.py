"""Cuts polygons into triangles."""

import numpy as np

from ..kernels.deformation import FLATTEST

# Largest ratio of the area of a face's triangles to that of its outline; a face folded by 90° along a diagonal has it.
_MAX_FOLD = 2**0.5


def triangles_of(points, counts, holes=()):
    """Cuts faces into triangles like :func:`cut`, and refuses those that cannot be cut.

    Raises:
        ValueError: A face crosses itself or is far from planar; the message names it by its index.
    """
    triangles, bad = cut(points, counts, holes)
    for face in bad[:1]:
        raise ValueError(f"face {face} crosses itself or is far from planar; it must have a simple, nearly flat outline")
    return triangles


def cut(points, counts, holes=()):
    """Cuts faces into triangles, each of k corners into k − 2.

    A face becomes a fan of triangles from its first corner if none of them is flat or turned over, as for all convex faces
    without straight corners. Others are cut by ear clipping (mapbox-earcut) in a coordinate plane.

    Args:
        points: Positions of the corners of one face after another, (C, 3).
        counts: Number of corners of each face (F,), at least 3.
        holes: Faces that are left out.

    Returns:
        Triangles (T, 3), rows of ``points``, in the order of the faces, and a list of the faces that cross themselves or are
        far from planar. These are fans, like faces without area or with a corner that is not finite.
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
        fans = np.logical_and.reduceat(upwards & ~_flat(corners, normals), first)
        fans &= np.add.reduceat(angles, first) <= 2.0 * np.pi  # else the fan overlaps itself
        bad = []
        for k in np.flatnonzero(~fans & np.isfinite(outlines).all(axis=1)):
            rows = first[k] + np.arange(sizes[k])
            ring = start[of_polygons[first[k]]]
            ears = _ears(points[ring : ring + sizes[k] + 2], outlines[k])
            if ears is None:
                bad.append(polygons[k])
            else:
                triangles[of_polygons[rows]] = ring + ears
                normals[rows] = _normals(points[ring + ears])
        areas = np.add.reduceat(np.linalg.norm(normals, axis=1), first)
        folded = areas > _MAX_FOLD * (1.0 + FLATTEST) * np.linalg.norm(outlines, axis=1)
    return triangles, sorted({*bad, *polygons[folded]})


def _normals(corners):
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _flat(corners, normals):
    """Returns which triangles (T, 3, 3) a `Mesh` refuses as flat."""
    sides = corners - np.roll(corners, 1, axis=1)
    return ~(np.linalg.norm(normals, axis=1) > FLATTEST * np.einsum("tki,tki->tk", sides, sides).max(axis=1))


def _ears(x, outline):
    """Returns triangles (k − 2, 3) of a face with corners (k, 3) and area vector (3,), or None if it crosses itself."""
    import mapbox_earcut

    count, axis = len(x), int(np.argmax(np.abs(outline)))
    fan = np.stack([np.zeros(count - 2, dtype=int), np.arange(1, count - 1), np.arange(2, count)], axis=1)
    if _flat(x[fan], _normals(x[fan])).all():
        return fan
    # Dropping a coordinate keeps lines straight and orders of corners, without rounding.
    p = np.ascontiguousarray((x - x[0])[:, [(axis + 1) % 3, (axis + 2) % 3][:: 1 if outline[axis] > 0.0 else -1]])
    ring = _without_straight(p)
    if len(ring) < 3 or _crosses(p):
        return None
    found = ring[mapbox_earcut.triangulate_float64(p[ring], np.array([len(ring)], dtype=np.uint32)).reshape(-1, 3)]
    found = _with_straight(found, count)
    if found is None or len(found) != count - 2:
        return None
    a, b, c = p[found].swapaxes(0, 1)
    return None if (_cross(b - a, c - a) < 0.0).any() else found


def _cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _without_straight(p):
    """Returns the corners of a polygon (k, 2) but those that repeat the one before or lie between their neighbours."""
    ring = np.flatnonzero((p != np.roll(p, 1, axis=0)).any(axis=1))
    before, after = p[ring] - p[np.roll(ring, 1)], p[np.roll(ring, -1)] - p[ring]
    longest = np.maximum((before**2).sum(axis=1), (after**2).sum(axis=1))
    straight = (np.abs(_cross(before, after)) <= FLATTEST * longest) & ((before * after).sum(axis=1) > 0.0)
    return ring[~straight]


def _with_straight(triangles, count):
    """Inserts the corners that triangles (T, 3) leave out into the sides along which they lie; None if these are missing."""
    used = np.zeros(count, dtype=bool)
    used[triangles] = True
    ring = np.roll(np.arange(count), -int(np.argmax(used)))
    before = ring[np.maximum.accumulate(np.where(used[ring], np.arange(count), 0))].tolist()
    triangles, after = triangles.tolist(), int(ring[0])
    for corner, a in zip(ring[:0:-1].tolist(), before[:0:-1], strict=True):
        if not used[corner]:
            t, k = next(((t, k) for t in triangles for k in range(3) if (t[k - 1], t[k]) == (a, after)), (None, 0))
            if t is None:
                return None
            triangles.append([corner, after, t[k - 2]])
            t[k] = corner
        after = corner
    return np.array(triangles)


def _crosses(p):
    """Returns whether two sides of a polygon (k, 2) cross, beyond touching."""
    q = np.roll(p, -1, axis=0)
    for k in range(len(p) - 2):
        a, b, c, d = p[k], q[k], p[k + 2 :], q[k + 2 :]
        apart = (_cross(b - a, c - a) * _cross(b - a, d - a) >= 0.0) | (_cross(d - c, a - c) * _cross(d - c, b - c) >= 0.0)
        if not apart.all():
            return True
    return False
