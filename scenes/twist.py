"""A twisted cylinder of cloth: keyframes rotate its ends about the axis in opposite directions, and then keep them.

Wrung tight, it may hold its pinned ends back from their keyframes.
"""

import numpy as np

import warpcloth as wc


def scene(
    turns: float = 3.0,
    around: int = 48,
    along: int = 40,
    radius: float = 0.1,
    length: float = 0.5,
    stiffness: float = 100.0,
    duration: float = 4.0,
):
    """Relative turns of the ends, edges around and along, radius and length [m], springs [N/m], duration [s]."""
    wc.checks.number("turns", turns)
    wc.checks.whole("around", around, 4)
    wc.checks.whole("along", along, 2)
    for name, value in {"radius": radius, "length": length, "duration": duration}.items():
        wc.checks.number(name, value, above=0.0)
    fps, grid = 25.0, wc.Mesh.grid(around + 1, along + 1, pattern="alternating")
    row, column = np.divmod(np.arange((around + 1) * (along + 1)), around + 1)
    triangles = (row * around + column % around)[grid.triangles]  # the last column is the first
    row, column = np.divmod(np.arange(around * (along + 1)), around)
    angle = 2.0 * np.pi * column / around

    def turned(by):
        return np.stack([length * (row / along - 0.5), radius * np.cos(angle + by), radius * np.sin(angle + by)], axis=1)

    times = np.arange(round(duration * fps) + 1) / (round(duration * fps))
    by = np.pi * turns * np.minimum(times / 0.8, 1.0)
    ends = (row == 0) | (row == along)
    keyframes = np.stack([turned(each * np.sign(row - 1))[ends] for each in by])
    return wc.Scene(
        wc.Mesh(turned(0.0), triangles),
        density=0.15,
        terms=[wc.Spring(pairs="edges", stiffness=stiffness, damping=0.01), wc.QuadraticBending(stiffness=1e-5)],
        pins=wc.Pins(np.flatnonzero(ends), keyframes),
        gravity=(0.0, 0.0, 0.0),
        self_contact=wc.SelfContact(distance=2e-3, held_pins="allow"),
        duration=duration,
        fps=fps,
        name="twist",
    )
