"""Sums per copy, in double precision and in a fixed order, so that the same run gives the same bits.

Two launches: (copies, chunks) threads sum every chunks-th entry of their copy, then one thread a copy adds the chunks.
"""

from functools import cache

import warp as wp

from .assemble import types


@cache
def partial_sum():
    """Kernel over (copies, chunks): out[copy, chunk] = Σ values."""

    @wp.kernel(module="warpcloth.reduce", enable_backward=False)
    def sum_chunks(values: wp.array(dtype=wp.float64), per_copy: int, out: wp.array2d(dtype=wp.float64)):
        copy, chunk = wp.tid()
        total = wp.float64(0.0)
        for i in range(chunk, per_copy, out.shape[1]):
            total += values[copy * per_copy + i]
        out[copy, chunk] = total

    return sum_chunks


@cache
def partial_dot(dtype):
    """Kernel over (copies, chunks): out[copy, chunk] = Σ a·b over vertices."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def dot_chunks(a: wp.array(dtype=vec3), b: wp.array(dtype=vec3), per_copy: int, out: wp.array2d(dtype=wp.float64)):
        copy, chunk = wp.tid()
        total = wp.float64(0.0)
        for i in range(chunk, per_copy, out.shape[1]):
            total += wp.float64(wp.dot(a[copy * per_copy + i], b[copy * per_copy + i]))
        out[copy, chunk] = total

    return dot_chunks


@cache
def finish_sum():
    """Kernel over copies: out[copy] = start·out[copy] + Σ partial[copy], start 0 or 1."""

    @wp.kernel(module="warpcloth.reduce", enable_backward=False)
    def add_chunks(
        partial: wp.array2d(dtype=wp.float64),
        start: wp.float64,
        out: wp.array(dtype=wp.float64),
    ):
        copy = wp.tid()
        total = wp.float64(0.0)
        for chunk in range(partial.shape[1]):
            total += partial[copy, chunk]
        out[copy] = start * out[copy] + total

    return add_chunks
