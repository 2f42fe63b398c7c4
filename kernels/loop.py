"""Factories of one-thread kernels that count the passes of a loop on the device, at the start and at the end of a pass.

Each is in the module of the kernels that it runs with.
"""

from functools import cache

import warp as wp


@cache
def count_pass(module: str):
    """Kernel of one thread: counts a pass and sets proceed = 0; a copy that needs another pass sets it to 1."""

    @wp.kernel(module=module, enable_backward=False)
    def count(
        # in and out
        passes: wp.array(dtype=wp.int32),
        # out
        proceed: wp.array(dtype=wp.int32),
    ):
        passes[0] = passes[0] + 1
        proceed[0] = 0

    return count


@cache
def limit_passes(module: str):
    """Kernel of one thread: proceed = 0 after ``most`` passes."""

    @wp.kernel(module=module, enable_backward=False)
    def limit(
        # state in
        passes: wp.array(dtype=wp.int32),
        # parameters
        most: int,
        # out
        proceed: wp.array(dtype=wp.int32),
    ):
        if passes[0] >= most:
            proceed[0] = 0

    return limit


@cache
def count_down():
    """Kernel of one thread: left −= 1, the number of passes left."""

    @wp.kernel(module="unique", enable_backward=False)
    def count_left(
        # in and out
        left: wp.array(dtype=wp.int32),
    ):
        left[0] = left[0] - 1

    return count_left
