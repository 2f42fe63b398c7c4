"""Kernels that apply a device function of :mod:`.rotation` to every matrix of an array."""

from functools import cache

import warp as wp


@cache
def into_three(function, matrix, types):
    """Kernel over matrices: (a[i], b[i], c[i]) = function(A[i]).

    Args:
        function: The device function.
        matrix: Warp type of A.
        types: Those of a, b and c.
    """
    a_type, b_type, c_type = types

    @wp.kernel(module="unique", enable_backward=False)
    def decompose(
        A: wp.array(dtype=matrix),
        # out
        a: wp.array(dtype=a_type),
        b: wp.array(dtype=b_type),
        c: wp.array(dtype=c_type),
    ):
        i = wp.tid()
        first, second, third = function(A[i])
        a[i] = first
        b[i] = second
        c[i] = third

    return decompose


@cache
def into_two(function, matrix, types):
    """Kernel over matrices: (a[i], b[i]) = function(A[i]); arguments as of :func:`into_three`."""
    a_type, b_type = types

    @wp.kernel(module="unique", enable_backward=False)
    def decompose(
        A: wp.array(dtype=matrix),
        # out
        a: wp.array(dtype=a_type),
        b: wp.array(dtype=b_type),
    ):
        i = wp.tid()
        first, second = function(A[i])
        a[i] = first
        b[i] = second

    return decompose
