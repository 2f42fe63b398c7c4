"""Kernels of a prefix sum: sums of chunks, their prefix sums, prefix sums within."""

from functools import cache

import warp as wp

MODULE = "warpcloth.scan"


@cache
def sum_chunks():
    """Kernel over chunks: sums of their values."""

    @wp.kernel(module=MODULE, enable_backward=False)
    def sum_each(
        # state in
        values: wp.array(dtype=wp.int32),
        # parameters
        size: int,
        # out
        sums: wp.array(dtype=wp.int32),
    ):
        c = wp.tid()
        total = wp.int32(0)
        for i in range(c * size, wp.min((c + 1) * size, values.shape[0])):
            total += values[i]
        sums[c] = total

    return sum_each


@cache
def add_chunks(block: int):
    """Kernel over the threads of a ``block`` (0: one thread of the CPU): replaces sums of chunks by sums of those before."""
    threads = max(block, 1)

    @wp.kernel(module=f"{MODULE}.{block}", enable_backward=False)
    def add_all(
        # in and out
        sums: wp.array(dtype=wp.int32),
    ):
        thread = wp.tid()
        each = (sums.shape[0] + wp.static(threads - 1)) // wp.static(threads)
        first = wp.min(thread * each, sums.shape[0])
        end = wp.min(first + each, sums.shape[0])
        total = wp.int32(0)
        if wp.static(block > 1):
            for c in range(first, end):
                total += sums[c]
            total = wp.untile(wp.tile_scan_exclusive(wp.tile(total)))
        for c in range(first, end):
            value = sums[c]
            sums[c] = total
            total += value

    return add_all


@cache
def write_sums():
    """Kernel over chunks: out (n+1,) = sums of the values before each entry, and the total."""

    @wp.kernel(module=MODULE, enable_backward=False)
    def write_each(
        # state in
        values: wp.array(dtype=wp.int32),
        sums: wp.array(dtype=wp.int32),
        # parameters
        size: int,
        # out
        out: wp.array(dtype=wp.int32),
    ):
        c = wp.tid()
        total = sums[c]
        n = values.shape[0]
        for i in range(c * size, wp.min((c + 1) * size, n)):
            out[i] = total
            total += values[i]
            if i == n - 1:
                out[n] = total

    return write_each
