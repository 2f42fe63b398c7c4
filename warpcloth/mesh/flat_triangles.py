"""Removes triangles without area, and keeps closed surfaces closed."""

import numpy as np

from .mesh import FLATTEST

_FLIPS = 20  # rounds of edge flips
_FLAT = 1e-4  # ratio of height to longest side below which a triangle is flipped, because float32 gives it no normal


def without_slivers(points, triangles):
    """Returns triangles (T, 3) with area for the same surface: two corners at one position are removed, corners on a line flip
    their longest side.

    Raises:
        ValueError: None has an area.
    """
    index = np.unique(points, axis=0, return_inverse=True)[1].reshape(-1)
    triangles = triangles[(index[triangles] != np.roll(index[triangles], 1, axis=1)).all(axis=1)]
    for _ in range(_FLIPS):
        flat = _flat(points[triangles], _FLAT)
        if not flat.any() or flat.all():
            break
        triangles = _flipped(points, triangles, index, np.flatnonzero(flat).tolist())
    triangles = triangles[~_flat(points[triangles], FLATTEST)]
    if not len(triangles):
        raise ValueError("has no triangle with an area, must have one to be a collider")
    return triangles


def _flat(corners, least):
    sides = corners - np.roll(corners, 1, axis=1)
    doubled = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    return ~(doubled > least * np.einsum("tki,tki->tk", sides, sides).max(axis=1))


def _flipped(points, triangles, index, flat):
    """Flips the longest side of flat triangles whose neighbour is not flipped in this round."""
    triangles = triangles.copy()
    beyond = {}
    for t, corners in enumerate(index[triangles].tolist()):
        beyond |= {(corners[k], corners[k - 2]): (t, k) for k in range(3)}  # the side from corner k to the next
    touched = set()
    for t in flat:
        sides = points[np.roll(triangles[t], -1)] - points[triangles[t]]
        k = int(np.argmax((sides**2).sum(axis=1)))
        p, q, r = np.roll(triangles[t], -k)
        other, side = beyond.get((int(index[q]), int(index[p])), (t, 0))
        if other == t or touched & {t, other}:
            continue
        d = triangles[other][side - 1]
        triangles[t], triangles[other] = (r, p, d), (d, q, r)
        touched |= {t, other}
    return triangles
