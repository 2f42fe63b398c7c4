"""Factories of the kernels of one thread by which a loop on the device counts its passes, before and after what decides.

Each belongs to the module of the kernels that it runs with.
"""

from functools import cache

import warp as wp


@cache
def count_pass(module: str):
    """Kernel of one thread: counts a pass; proceed = 0, until a copy asks for another."""

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
    """Kernel of one thread: proceed = 0 once there were ``most`` passes."""

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
    """Kernel of one thread: passes that are left −= 1."""

    @wp.kernel(module="unique", enable_backward=False)
    def count_left(
        # in and out
        left: wp.array(dtype=wp.int32),
    ):
        left[0] = left[0] - 1

    return count_left
