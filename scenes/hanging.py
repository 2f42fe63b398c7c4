"""A square cloth of 1 m, horizontal at first, hung by two corners of one edge; it swings through.

0.1 kg/m², a quarter of each cell to each of its corners; structural and shear springs; two of its edges are mirror images of
each other for an odd number of vertices a side. The pinned edge lies along x at z = 0.
"""

import numpy as np

import warpcloth as wc


def scene(n: int = 32, stiffness: float = 1e3, bending: float = 1e-5, density: float = 0.1, duration: float = 1.0):
    """n vertices a side, spring stiffness [N/m], plate bending stiffness [N·m], density [kg/m²], duration [s]."""
    mesh = wc.Mesh.grid(n, n, size=1.0, pattern="alternating")
    share = np.full(n, 1.0 / (n - 1))
    share[[0, -1]] /= 2.0
    return wc.Scene(
        mesh,
        masses=density * np.outer(share, share).ravel(),
        terms=[
            wc.Spring(pairs=("structural", "shear"), stiffness=stiffness),
            wc.QuadraticBending(stiffness=bending),
        ],
        pins=[0, n - 1],
        duration=duration,
        name="hanging",
    )
