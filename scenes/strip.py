"""A strip cut at an angle to the warp is pulled by its ends: E(θ), 1/E = c⁴/E₁ + s⁴/E₂ + (1/G − 2ν₁₂/E₁)s²c².

The grips hold its ends along x only, so strips at an angle shear and stretch uniformly.
"""

import numpy as np

import warpcloth as wc


def scene(
    fabric: str = "cotton",
    angle: float = 45.0,
    strain: float = 1e-3,
    elements: int = 16,
    length: float = 0.2,
    width: float = 0.05,
    duration: float = 1.0,
):
    """One of 'warpcloth fabrics', angle to the warp [°], strain, elements along, length and width [m], duration [s]."""
    wc.checks.number("angle", angle)
    wc.checks.number("strain", strain, above=0.0)
    wc.checks.number("length", length, above=0.0)
    wc.checks.number("width", width, above=0.0)
    wc.checks.whole("elements", elements, 1)
    cloth = wc.fabrics.find(fabric)
    across = max(round(width / length * elements), 1)
    mesh = wc.Mesh.grid(elements + 1, across + 1, size=(length, width), pattern="alternating")
    x, n = mesh.points[:, 0], across + 1
    ends = np.concatenate([np.flatnonzero(x == x.min()), np.flatnonzero(x == x.max())])
    keyframes = np.linspace(mesh.points[ends], mesh.points[ends] + np.outer(x[ends] * strain, [1.0, 0.0, 0.0]), 61)
    return wc.Scene(
        mesh,
        density=cloth.density,
        terms=[cloth.membrane(warp_angle=-np.radians(angle))],
        pins=wc.Pins(ends, keyframes, axes=["xz"] + ["x"] * (2 * n - 1)),
        gravity=(0.0, 0.0, 0.0),
        free_axes=np.tile([True, False, True], (len(x), 1)),
        duration=duration,
        name="strip",
    )
