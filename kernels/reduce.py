"""Sums and maxima per copy, in double precision and in a fixed order, so that the same run gives the same bits.

Two launches: (copies, chunks) threads sum every chunks-th entry of their copy, then one thread a copy adds the chunks.
"""

from functools import cache

import warp as wp

from .vectors import types


@wp.func
def stands_aside(active: wp.array(dtype=wp.int32), copy: int):
    """Whether a copy is not among the active ones, (B,); none is left out where that is None."""
    if active:
        return active[copy] == 0
    return False


@cache
def partial_sum():
    """Kernel over (copies, chunks): out[copy, chunk] = Σ values."""

    @wp.kernel(module="warpcloth.reduce", enable_backward=False)
    def sum_chunks(
        # state in
        values: wp.array(dtype=wp.float64),
        # parameters
        per_copy: int,
        # out
        out: wp.array2d(dtype=wp.float64),
    ):
        copy, chunk = wp.tid()
        total = wp.float64(0.0)
        for i in range(chunk, per_copy, out.shape[1]):
            total += values[copy * per_copy + i]
        out[copy, chunk] = total

    return sum_chunks


@cache
def partial_dot(dtype):
    """Kernel over (copies, chunks): out[copy, chunk] = Σ a·b over vertices; of the copies that are active, if any are named."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def dot_chunks(
        # state in
        a: wp.array(dtype=vec3),
        b: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        # out
        out: wp.array2d(dtype=wp.float64),
    ):
        copy, chunk = wp.tid()
        if stands_aside(active, copy):
            return
        total = wp.float64(0.0)
        for i in range(chunk, per_copy, out.shape[1]):
            total += wp.float64(wp.dot(a[copy * per_copy + i], b[copy * per_copy + i]))
        out[copy, chunk] = total

    return dot_chunks


@cache
def partial_product(dtype):
    """Kernel over (copies, chunks): out[copy, chunk] = Σ a b of numbers; of the copies that are active, if any are named."""

    @wp.kernel(module="unique", enable_backward=False)
    def multiply_chunks(
        # state in
        a: wp.array(dtype=dtype),
        b: wp.array(dtype=dtype),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        # out
        out: wp.array2d(dtype=wp.float64),
    ):
        copy, chunk = wp.tid()
        if stands_aside(active, copy):
            return
        total = wp.float64(0.0)
        for i in range(chunk, per_copy, out.shape[1]):
            total += wp.float64(a[copy * per_copy + i]) * wp.float64(b[copy * per_copy + i])
        out[copy, chunk] = total

    return multiply_chunks


@cache
def finish_sum():
    """Kernel over copies: out[copy] = Σ partial[copy], and what out held too where ``accumulate`` is 1."""

    @wp.kernel(module="warpcloth.reduce", enable_backward=False)
    def add_chunks(
        # state in
        partial: wp.array2d(dtype=wp.float64),
        # parameters
        accumulate: int,
        # in and out
        out: wp.array(dtype=wp.float64),
    ):
        copy = wp.tid()
        total = wp.float64(0.0)
        if accumulate == 1:  # a factor of 0 would keep a NaN
            total = out[copy]
        for chunk in range(partial.shape[1]):
            total += partial[copy, chunk]
        out[copy] = total

    return add_chunks


@cache
def partial_largest(dtype):
    """Kernel over (copies, chunks): out[copy, chunk] = max wᵢ‖aᵢ‖ over vertices; NaN stays."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def largest_of_chunks(
        # elements
        weights: wp.array(dtype=dtype),
        # state in
        a: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        # out
        out: wp.array2d(dtype=wp.float64),
    ):
        copy, chunk = wp.tid()
        most = wp.float64(0.0)
        for j in range(chunk, per_copy, out.shape[1]):
            i = copy * per_copy + j
            value = wp.float64(weights[i]) * wp.float64(wp.length(a[i]))
            if most == most and not (value <= most):
                most = value
        out[copy, chunk] = most

    return largest_of_chunks


@cache
def partial_largest_number():
    """Kernel over (copies, chunks): out[copy, chunk] = max of numbers of 0 or more; NaN stays."""

    @wp.kernel(module="unique", enable_backward=False)
    def largest_number_of_chunks(
        # state in
        values: wp.array(dtype=wp.float64),
        # parameters
        per_copy: int,
        # out
        out: wp.array2d(dtype=wp.float64),
    ):
        copy, chunk = wp.tid()
        most = wp.float64(0.0)
        for i in range(chunk, per_copy, out.shape[1]):
            value = values[copy * per_copy + i]
            if most == most and not (value <= most):
                most = value
        out[copy, chunk] = most

    return largest_number_of_chunks


@cache
def finish_largest():
    """Kernel over copies: out[copy] = max partial[copy]; NaN stays."""

    @wp.kernel(module="warpcloth.reduce", enable_backward=False)
    def largest_chunk(
        # state in
        partial: wp.array2d(dtype=wp.float64),
        # out
        out: wp.array(dtype=wp.float64),
    ):
        copy = wp.tid()
        most = wp.float64(0.0)
        for chunk in range(partial.shape[1]):
            if most == most and not (partial[copy, chunk] <= most):
                most = partial[copy, chunk]
        out[copy] = most

    return largest_chunk


@cache
def keep_largest():
    """Kernel over copies: out[copy] = max(out[copy], value[copy]) of numbers of 0 or more; NaN stays."""

    @wp.kernel(module="warpcloth.reduce", enable_backward=False)
    def keep(
        # state in
        values: wp.array(dtype=wp.float64),
        # in and out
        out: wp.array(dtype=wp.float64),
    ):
        copy = wp.tid()
        if out[copy] == out[copy] and not (values[copy] <= out[copy]):
            out[copy] = values[copy]

    return keep
