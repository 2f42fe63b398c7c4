"""A square cloth of 1 m, initially horizontal, pinned at two corners of one side; it swings like a pendulum.

It has structural and shear springs, equal masses, and for an odd n mirror symmetry. The side with the pins lies along x at z =
0.
"""

import numpy as np

import warpcloth as wc


def scene(
    n: int = 32,
    stiffness: float = 1e3,
    bending: float = 1e-5,
    density: float = 0.1,
    duration: float = 1.0,
    fabric: str | None = None,
):
    """n vertices per side, springs [N/m], bending [N·m], density [kg/m²], duration [s]; or one of 'warpcloth fabrics'."""
    mesh = wc.Mesh.grid(n, n, size=1.0, pattern="alternating")
    if fabric is not None:
        return wc.Scene(mesh, fabric=fabric, pins=[0, n - 1], duration=duration, name="hanging")
    return wc.Scene(
        mesh,
        masses=np.full(n * n, density / n**2),
        terms=[
            wc.Spring(pairs=("structural", "shear"), stiffness=stiffness),
            wc.QuadraticBending(stiffness=bending),
        ],
        pins=[0, n - 1],
        duration=duration,
        name="hanging",
    )
