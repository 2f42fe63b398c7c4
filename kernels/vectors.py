"""Vector and matrix types of a scalar type."""

from functools import cache

import warp as wp


@cache
def types(dtype):
    """The types (vec3, mat33) of a scalar type."""
    return wp.types.vector(3, dtype), wp.types.matrix((3, 3), dtype)
