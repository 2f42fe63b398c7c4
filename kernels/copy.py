"""A copy from array to array, to measure what a kernel can move at most."""

from functools import cache

import warp as wp


@cache
def copy_rows():
    """Kernel over rows of four numbers, as much as a thread reads at once: out = source."""

    @wp.kernel(module="unique", enable_backward=False)
    def copy_each_row(
        # in
        source: wp.array(dtype=wp.vec4),
        # out
        out: wp.array(dtype=wp.vec4),
    ):
        i = wp.tid()
        out[i] = source[i]

    return copy_each_row
