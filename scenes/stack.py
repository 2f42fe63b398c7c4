"""Square sheets that fall onto one another on a floor. A ball then moves down and presses them.

Before that, each layer carries the weight of those above it: the sum over the layers at distances d < r of k(r − d), or of
kr²/4d for d < r/2.
"""

import numpy as np

import warpcloth as wc


def scene(sheets: int = 5, n: int = 24, size: float = 0.4, press: float = 0.5, friction: float = 0.3, duration: float = 2.0):
    """Sheets, vertices per side, side [m], gap under the ball over sheets times r, friction of all, duration [s]."""
    wc.checks.whole("sheets", sheets, 1)
    wc.checks.whole("n", n, 2)
    for name, value in {"size": size, "press": press, "duration": duration}.items():
        wc.checks.number(name, value, above=0.0)
    fps, density, distance, radius = 50.0, 0.15, 2e-3, 0.25 * size
    grid = wc.Mesh.grid(n, n, size=size, pattern="alternating")
    layers = 1.5 * distance * np.arange(1, sheets + 1)
    points = grid.points - 0.5 * size * np.array([1.0, 0.0, 1.0]) + np.multiply.outer(layers, [0.0, 1.0, 0.0])[:, None]
    triangles = grid.triangles + n * n * np.arange(sheets)[:, None, None]
    times = np.arange(round(duration * fps) + 1) / fps
    high, low = 1.5 * distance * (sheets + 1) + 0.2 * size, press * distance * sheets
    height = low + (high - low) * (0.5 + 0.5 * np.cos(np.pi * np.clip(2.0 * times / duration - 0.5, 0.0, 1.0)))
    ball = np.stack([0.0 * times, radius + height, 0.0 * times], axis=1)
    return wc.Scene(
        wc.Mesh(points.reshape(-1, 3), triangles.reshape(-1, 3)),
        density=density,
        terms=[
            wc.Spring(pairs="edges", stiffness=300.0, damping=0.05),
            wc.QuadraticBending(stiffness=1e-5),
        ],
        colliders=[
            wc.Plane(friction=friction, name="floor"),
            wc.Sphere(radius=radius, position=ball, friction=friction, name="ball"),
        ],
        contact=wc.Contact(distance=distance),
        self_contact=wc.SelfContact(distance=distance, friction=friction),
        duration=duration,
        fps=fps,
        name="stack",
    )
