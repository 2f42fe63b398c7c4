"""A curtain on rings that slide along a rod. Its last ring pulls it shut, and a ball swings into it.

Rings are pins that are free along the rod. The first ring is fixed, and keyframes move the last one.
"""

import numpy as np

import warpcloth as wc


def scene(
    nx: int = 49,
    ny: int = 33,
    width: float = 2.0,
    height: float = 1.4,
    gathered: float = 0.5,
    pleats: int = 6,
    duration: float = 3.0,
):
    """Vertices across and down, width and height [m], initial fraction of the width, pleats, duration [s]."""
    for name, value in {"width": width, "height": height, "gathered": gathered, "duration": duration}.items():
        wc.checks.number(name, value, above=0.0)
    wc.checks.whole("pleats", pleats, 1)
    wc.checks.whole("nx", nx, 2 * pleats + 1)
    if not gathered < 1.0:
        raise ValueError(f"gathered is {gathered}; it must be below 1, the whole width")
    fps = 60.0
    mesh = wc.Mesh.grid(nx, ny, size=(width, height), pattern="alternating")
    # Zigzag pleats with the rest length of each edge. Rings are at their rear folds.
    along = mesh.points[:, 0] / width * 2.0 * pleats
    depth = 0.5 * width / pleats * np.sqrt(1.0 - gathered**2)
    positions = np.stack([gathered * mesh.points[:, 0], -mesh.points[:, 2], depth * np.abs((along + 1.0) % 2.0 - 1.0)], axis=1)
    rings = np.round(np.linspace(0, nx - 1, pleats + 1)).astype(int)
    times = np.arange(round(duration * fps) + 1) / fps
    led = np.tile(positions[rings], (len(times), 1, 1))
    drawn = 0.5 - 0.5 * np.cos(np.pi * np.minimum(times / (0.5 * duration), 1.0))
    led[:, -1, 0] += (0.97 - gathered) * width * drawn
    axes = ["xyz", *["yz"] * (pleats - 1), "xyz"]
    swing = np.pi * np.clip(times / duration - 0.5, 0.0, 0.5) * 2.0
    ball = np.stack([0.5 * width + 0.0 * times, -0.7 * height + 0.0 * times, 0.9 - 0.8 * np.sin(swing)], axis=1)
    return wc.Scene(
        mesh,
        density=0.2,
        positions=positions,
        terms=[
            wc.Spring(pairs=("structural", "shear"), stiffness=500.0, damping=0.02),
            wc.QuadraticBending(stiffness=1e-5),
        ],
        pins=wc.Pins(rings, led, axes),
        colliders=[wc.Sphere(radius=0.25, position=ball, friction=0.2, name="ball")],
        contact=wc.Contact(distance=5e-3),
        duration=duration,
        fps=fps,
        name="curtain",
    )
