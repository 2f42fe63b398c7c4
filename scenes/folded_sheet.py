"""A square cloth of 1 m that falls, flat or folded in two with a gap between layers; `bench` measures self-contact on it."""

import numpy as np

import warpcloth as wc


def scene(n: int = 64, layers: int = 2, gap: float = 1e-3, distance: float = 1e-3, duration: float = 1.0):
    """Vertices per side, layers (1 or 2), gap between them [m], contact distance [m], duration [s]."""
    wc.checks.whole("n", n, 2)
    wc.checks.whole("layers", layers, 1, most=2)
    wc.checks.number("gap", gap, above=0.0)
    grid, points = wc.Mesh.grid(n, n, size=1.0, pattern="alternating"), None
    if layers == 2:
        radius = 0.5 * gap
        # A row of vertices lies in the fold: edges across it without one would start as short as the gap, and spring open.
        s, half = grid.points[:, 0] - (n // 2) / (n - 1), 0.5 * np.pi * radius
        bent = np.abs(s) < half
        x = np.where(bent, radius * np.cos(s / radius), half - np.abs(s))
        y = np.where(bent, radius * np.sin(s / radius), np.sign(s) * radius)
        points = np.stack([x, y, grid.points[:, 2]], axis=1)
    return wc.Scene(
        grid,
        density=0.15,
        terms=[wc.Spring(pairs=("structural", "shear"), stiffness=300.0), wc.QuadraticBending(stiffness=1e-5)],
        positions=points,
        self_contact=wc.SelfContact(distance=distance),
        duration=duration,
        name="folded_sheet",
    )
