"""Vectors as three columns, (3, m), which take a fraction of the time of rows, summed in the order of NumPy."""

import numpy as np


def columns_of(points, *indices):
    """Returns the columns (3, m) of points (n, 3) for each array of indices (m,)."""
    columns = np.ascontiguousarray(points.T)
    return [columns[:, each] for each in indices]


def dot(a, b):
    """Returns a·b (m,), summed as by ``np.einsum("mi,mi->m", …)``."""
    return a[0] * b[0] + a[2] * b[2] + a[1] * b[1]


def length(a):
    """Returns ‖a‖ (m,), summed as by ``np.linalg.norm``."""
    return np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


def cross_length(a, b):
    """Returns ‖a × b‖ (m,), as by ``np.cross``."""
    return length((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))
