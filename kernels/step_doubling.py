"""Kernels of steps by error: differences of two results, and counts of steps in another unit."""

from functools import cache

import warp as wp

from .vectors import types

FIRST = wp.constant(wp.int64(2**62))


@cache
def subtract_positions(dtype):
    vec3, _ = types(dtype)

    @wp.kernel(module=f"warpcloth.step_doubling.{dtype.__name__}", enable_backward=False)
    def subtract(
        # state in
        a: wp.array(dtype=vec3),
        b: wp.array(dtype=vec3),
        # out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        out[i] = a[i] - b[i]

    return subtract


@wp.kernel(module="warpcloth.step_counts", enable_backward=False)
def scale_steps(
    # state in
    steps: wp.array(dtype=wp.int32),
    # parameters
    times: int,
    parts: int,
    # out
    out: wp.array(dtype=wp.int32),
):
    """Kernel over numbers of steps: out = steps·times/parts."""
    i = wp.tid()
    out[i] = steps[i] * times / parts


@wp.kernel(module="warpcloth.step_counts", enable_backward=False)
def divide_sums(
    # state in
    sums: wp.array(dtype=wp.int64),
    # parameters
    parts: int,
    # out
    out: wp.array(dtype=wp.int64),
):
    """Kernel over sums over steps: out = sums/parts, rounded down."""
    i = wp.tid()
    out[i] = sums[i] / wp.int64(parts)


@wp.kernel(module="warpcloth.step_counts", enable_backward=False)
def add_to_sums(
    # state in
    found: wp.array(dtype=wp.int64),
    # parameters
    parts: int,
    # out
    sums: wp.array(dtype=wp.int64),
):
    """Kernel over sums over steps: adds what is new to those of `divide_sums`, ``parts`` times."""
    i = wp.tid()
    sums[i] += (found[i] - sums[i] / wp.int64(parts)) * wp.int64(parts)


@wp.kernel(module="warpcloth.step_counts", enable_backward=False)
def scale_notes(
    # state in
    notes: wp.array(dtype=wp.int64),
    # parameters
    times: int,
    parts: int,
    rest: wp.int64,
    keep: int,
    # out
    out: wp.array(dtype=wp.int64),
):
    """Kernel over notes FIRST − (step·rest + other): writes them with step·times/parts, or keeps present ones."""
    i = wp.tid()
    note = notes[i]
    if keep != 0 and out[i] != wp.int64(0):
        return
    if note != wp.int64(0):
        key = FIRST - note
        step = key / rest
        note = FIRST - (step * wp.int64(times) / wp.int64(parts) * rest + (key - step * rest))
    out[i] = note
