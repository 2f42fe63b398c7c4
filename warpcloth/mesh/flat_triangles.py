"""Triangles without area, turned into others so that a surface stays whole."""

import numpy as np

from .mesh import FLATTEST

_FLIPS = 20  # rounds in which flat triangles are turned into others
_FLAT = 1e-4  # height over the longest side at which they are: float32 leaves them no normal


def without_slivers(points, triangles):
    """The triangles of a surface as ones with an area, which a `Mesh` must have.

    Those with two corners at one position are left out. One whose corners are on a line, as fans of polygons with such corners
    have, changes its longest side for the other diagonal with the triangle beyond, so that a closed surface stays closed.

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
    """Which triangles (T, 3, 3) are no higher than a part of their longest side."""
    sides = corners - np.roll(corners, 1, axis=1)
    doubled = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    return ~(doubled > least * np.einsum("tki,tki->tk", sides, sides).max(axis=1))


def _flipped(points, triangles, index, flat):
    """The triangles, some flat ones of which share another diagonal with the triangle beyond their longest side."""
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
