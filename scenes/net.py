"""A flat square net without pins and gravity: unit masses 1 m apart, equal springs.

The largest ω²m/k at rest, and λ_max of Jacobi sweeps, are known. For 40 × 40 vertices they are 3.99 and 1.997 with structural
springs, 7.98 and 3.99 with shear springs too, and 10.09 and 5.05 with bending springs too.
"""

from typing import Literal, get_args

import numpy as np

import warpcloth as wc

Kind = Literal["structural", "shear", "bending"]


def scene(n: int = 10, kind: Kind = "shear", stiffness: float = 1.0, duration: float = 1.0):
    """n vertices a side; kind: structural, shear (with structural) or bending (with both); stiffness [N/m]; duration [s]."""
    kinds = get_args(Kind)
    wc.checks.choice("kind", kind, kinds)
    return wc.Scene(
        wc.Mesh.grid(n, n, size=float(n - 1)),
        masses=np.ones(n * n),
        terms=[wc.Spring(pairs=kinds[: kinds.index(kind) + 1], stiffness=stiffness)],
        gravity=(0.0, 0.0, 0.0),
        duration=duration,
        name="net",
    )
