"""A vertical chain of N springs and N equal masses that hangs from its upper end: at rest its tip is mg/k·N(N+1)/2 lower."""

import numpy as np

import warpcloth as wc


def scene(links: int = 20, length: float = 1.0, mass: float = 0.01, stiffness: float = 1e3, duration: float = 1.0):
    """Number of springs, total length [m], each mass [kg], stiffness of each spring [N/m], duration [s]."""
    return wc.Scene(
        wc.Mesh.chain(links + 1, length=length, direction=(0.0, -1.0, 0.0)),
        masses=np.full(links + 1, mass),
        terms=[wc.Spring(pairs="edges", stiffness=stiffness)],
        pins=[0],
        duration=duration,
        name="chain",
    )
