"""An elastic cable that hangs from both ends. At rest it is an elastic catenary.

It starts as a V of its rest length. With the span d, length S > d, weight per length w and stretching stiffness EA, the
horizontal tension T solves d = (2T/w) asinh(wS/2T) + TS/EA. The sag is (T/w)(√(1 + (wS/2T)²) − 1) + wS²/(8EA).
"""

import numpy as np

import warpcloth as wc


def scene(
    links: int = 100,
    span: float = 1.0,
    length: float = 1.2,
    weight: float = 1.0,
    stretching: float = 1e4,
    duration: float = 1.0,
):
    """Number of springs, d [m], S [m], w [N/m], EA [N], duration [s]."""
    mesh = wc.Mesh.chain(links + 1, length=length, direction=(1.0, 0.0, 0.0))
    if not 0.0 < span <= length:
        raise ValueError(f"span is {span}; it must be above 0, and no more than the length, {length}")
    positions = mesh.points * (span / length)
    depth = np.sqrt(length**2 - span**2) / 2.0
    positions[:, 1] = -depth * (1.0 - np.abs(2.0 * positions[:, 0] / span - 1.0))
    return wc.Scene(
        mesh,
        density=weight / 9.81,
        positions=positions,
        terms=[wc.Spring(pairs="edges", stiffness=stretching * links / length)],
        pins=[0, links],
        duration=duration,
        name="catenary",
    )
