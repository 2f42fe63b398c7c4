"""Interpolation from a coarse level of vertices to the next finer one."""

from functools import cache

import warp as wp

from .vectors import types


@cache
def follow(dtype):
    """Kernel over (copies, dropped vertices): d = Σ weight·d over the kept parents of each."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def follow_kept(
        # elements
        dropped: wp.array(dtype=wp.int32),
        offsets: wp.array(dtype=wp.int32),
        parents: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=dtype),
        # parameters
        per_copy: int,
        # in and out
        d: wp.array(dtype=vec3),
    ):
        copy, i = wp.tid()
        total = vec3()
        for n in range(offsets[i], offsets[i + 1]):
            total += weights[n] * d[copy * per_copy + parents[n]]
        d[copy * per_copy + dropped[i]] = total

    return follow_kept
