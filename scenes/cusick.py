"""Cusick's drape test: a disc of 30 cm hangs over the edge of a disc of 18 cm, which holds it, with warp along x.

Vertices up to the edge of the support, two rows, are pinned; there is no cloth further in. `start` numbers the small random
waves from which it falls.
"""

import numpy as np

import warpcloth as wc

SUPPORT, RADIUS = 0.09, 0.15  # [m]


def scene(fabric: str = "cotton", rows: int = 12, start: int = 0, duration: float = 2.0):
    """One of 'warpcloth fabrics' or a Fabric, rows of triangles in the ring, number of the start, duration [s]."""
    wc.checks.whole("rows", rows, 4)
    wc.checks.whole("start", start, 0)
    step = np.log(RADIUS / SUPPORT) / rows  # rows of the logarithm of the radius, so that all triangles are nearly equilateral
    around = round(2.0 * np.pi * np.sqrt(0.75) / step)
    row, column = np.mgrid[-1 : rows + 1, :around]
    radius, angle = SUPPORT * np.exp(step * row), 2.0 * np.pi * (column + 0.5 * (row % 2)) / around
    points = np.stack([radius * np.cos(angle), 0.0 * angle, radius * np.sin(angle)], axis=-1).reshape(-1, 3)
    here = row[:-1] * around + column[:-1] + around
    after = here + (column[:-1] + 1) % around - column[:-1]
    a, b, c, d = here, after, here + around, after + around
    ahead = (row[:-1] % 2)[..., None]  # rows that are half an edge ahead
    triangles = np.where(ahead, np.stack([a, b, d, a, d, c], axis=-1), np.stack([a, b, c, b, d, c], axis=-1))
    mesh = wc.Mesh(points, triangles.reshape(-1, 3), texture_coordinates=points[:, [0, 2]])
    random, out = np.random.default_rng(start), np.maximum((radius - SUPPORT) / (RADIUS - SUPPORT), 0.0).ravel()
    waves, phase = random.normal(size=12), random.uniform(0.0, 2.0 * np.pi, 12)
    lift = 1e-3 * out**2 * (waves * np.cos(np.outer(angle.ravel(), np.arange(1, 13)) + phase)).sum(axis=1)
    return wc.Scene(
        mesh,
        fabric=fabric,
        positions=points + np.outer(lift, [0.0, 1.0, 0.0]),
        pins=np.flatnonzero(row.ravel() <= 0),
        duration=duration,
        name="cusick",
    )
