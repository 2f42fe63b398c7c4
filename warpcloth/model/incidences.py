"""The elements of each vertex."""

import numpy as np


def incidences_of(vertices, count):
    """The elements of each vertex, one vertex after another.

    Args:
        vertices: (E·K,) the corners of elements, one element after another.
        count: Vertices, N.

    Returns:
        (offsets (N+1,), codes (E·K,)): vertex i has the codes from offsets[i] to offsets[i+1], K·element + corner, in order.
    """
    codes = np.argsort(vertices, kind="stable")
    return np.searchsorted(vertices[codes], np.arange(count + 1)), codes
