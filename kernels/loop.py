"""Factory of the kernel that counts down a loop on the device."""

from functools import cache

import warp as wp


@cache
def count_down():
    """Kernel of one thread: left −= 1."""

    @wp.kernel(module="unique", enable_backward=False)
    def count_left(
        # in and out
        left: wp.array(dtype=wp.int32),
    ):
        left[0] = left[0] - 1

    return count_left
