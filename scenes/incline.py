"""A sheet on a slope, at rest at first, at the gap of its weight: it sticks for tan θ < μ, else it slides.

The acceleration of a sliding sheet is g(sin θ − μ cos θ) down the slope, which descends along x.
"""

import numpy as np

import warpcloth as wc


def scene(angle: float = 30.0, friction: float = 0.3, n: int = 9, size: float = 0.2, duration: float = 1.0):
    """Slope θ [degrees], coefficient of friction μ, vertices per side, side [m], duration [s]."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    density, distance = 0.15, 1e-3
    contact = wc.Contact(distance=distance, stiffness=10.0 * 9.81 * density / distance)
    grid = wc.Mesh.grid(n, n, size=size, pattern="alternating")
    above = distance * (1.0 - 0.1 * c)  # the gap at which contact carries the weight
    return wc.Scene(
        wc.Mesh((grid.points + np.array([0.0, above, 0.0])) @ turn.T, grid.triangles),
        density=density,
        terms=[wc.Spring(stiffness=100.0), wc.QuadraticBending(stiffness=1e-5)],
        colliders=[wc.Plane(normal=turn[:, 1], friction=friction, name="slope")],
        contact=contact,
        duration=duration,
        name="incline",
    )
