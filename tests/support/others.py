"""The scene of tests of other simulators."""

import numpy as np

import warpcloth as wc

MESH = wc.Mesh.grid(4, 4, pattern="alternating")
MASSES = np.linspace(0.1, 0.2, 16)
SPRINGS = wc.Spring(pairs=("structural", "shear"), stiffness=300.0)
BENDING = wc.QuadraticBending(stiffness=1e-2)


def declared(**fields):
    """A net held at two corners, with other fields."""
    return wc.Scene(MESH, **({"masses": MASSES, "terms": [SPRINGS, BENDING], "pins": [0, 3], "duration": 0.5} | fields))
