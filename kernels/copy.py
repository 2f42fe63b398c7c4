"""Copies between arrays."""

from functools import cache

import warp as wp

from .vectors import types


@cache
def copy_rows():
    """Kernel over rows of four numbers: out = source; it measures the bandwidth."""

    @wp.kernel(module="unique", enable_backward=False)
    def copy_each_row(
        # state in
        source: wp.array(dtype=wp.vec4),
        # out
        out: wp.array(dtype=wp.vec4),
    ):
        i = wp.tid()
        out[i] = source[i]

    return copy_each_row


@cache
def take_vertices(dtype):
    """Kernel over (copies · n): out = the values of each copy at the vertices ``indices`` (n,)."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def take_each_vertex(
        # state in
        values: wp.array(dtype=vec3),
        # parameters
        indices: wp.array(dtype=wp.int32),
        # out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        n = indices.shape[0]
        out[i] = values[i // n * n + indices[i % n]]

    return take_each_vertex


@cache
def copy_chosen(dtype):
    """Kernel over chosen vertices: out[targets[k]] = source[sources[k]]."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def copy_each_chosen(
        # elements
        sources: wp.array(dtype=wp.int32),
        targets: wp.array(dtype=wp.int32),
        # state in
        source: wp.array(dtype=vec3),
        # out
        out: wp.array(dtype=vec3),
    ):
        k = wp.tid()
        out[targets[k]] = source[sources[k]]

    return copy_each_chosen


@cache
def repeat_indices():
    """Kernel over (copies · m): out = the first copy's indices (m,), plus ``step`` per copy."""

    @wp.kernel(module="unique", enable_backward=False)
    def repeat_each_index(
        # elements
        indices: wp.array(dtype=wp.int32),
        # parameters
        step: int,
        # out
        out: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        m = indices.shape[0]
        out[i] = indices[i % m] + i // m * step

    return repeat_each_index
