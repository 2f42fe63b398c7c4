"""Small meshes that several tests need."""

import numpy as np

import warpcloth as wc

PAIR = wc.Mesh(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), edges=[[0, 1]])


def kite(apex):
    """Two triangles with that angle [°] opposite the edge (0, 1) that they share."""
    height = 0.5 / np.tan(np.radians(apex / 2))
    return wc.Mesh([[0.0, 0, 0], [1.0, 0, 0], [0.5, height, 0], [0.5, -height, 0]], [[0, 1, 2], [1, 0, 3]])
