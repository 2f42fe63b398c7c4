"""A square sheet in a hinged frame, whose sides lie along warp and weft, is pulled along a diagonal: the shear modulus G.

The sides a keep their lengths and turn towards each other by the angle γ. The frame is pulled along its diagonal by
F = aG sin γ cos γ/sin(π/4 − γ/2).
"""

import numpy as np

import warpcloth as wc


def scene(fabric: str = "cotton", angle: float = 20.0, n: int = 9, side: float = 0.2, duration: float = 1.0):
    """One of 'warpcloth fabrics', γ [°], vertices per side, side [m], duration [s]."""
    wc.checks.number("angle", angle, above=0.0)
    if angle >= 90.0:
        raise ValueError(f"angle is {angle:g}; it must be below 90, at which the frame is shut")
    wc.checks.whole("n", n, 3)
    cloth = wc.fabrics.find(fabric)
    mesh = wc.Mesh.grid(n, n, size=side, pattern="alternating")
    half = 0.5 * np.radians(np.linspace(0.0, angle, 61))
    c, s, no = np.cos(half), np.sin(half), 0.0 * half
    turns = np.stack([c, no, s, no, no, no, s, no, c], axis=-1).reshape(-1, 3, 3)  # of both sides, by γ/2 each
    return wc.Scene(
        mesh,
        density=cloth.density,
        terms=[cloth.membrane()],
        pins=wc.Pins(mesh.boundary, mesh.points[mesh.boundary] @ turns),
        gravity=(0.0, 0.0, 0.0),
        free_axes=np.tile([True, False, True], (n * n, 1)),
        duration=duration,
        name="picture_frame",
    )
