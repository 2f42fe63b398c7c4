"""Kernels of a multigrid cycle with constant matrices of numbers, in every copy.

Copies share a pattern; the values of copy b are ``values[of_copy[b]]``.
"""

from functools import cache

import warp as wp

from .vectors import types

MODULE = "warpcloth.constant_multigrid"


@cache
def constant_rows(dtype):
    """Struct of compressed rows: offsets (n + 1,), columns (m,), values (matrices, m)."""

    @wp.struct
    class ConstantRows:
        offsets: wp.array(dtype=wp.int32)
        columns: wp.array(dtype=wp.int32)
        values: wp.array2d(dtype=dtype)

    return ConstantRows


@cache
def row_product(dtype):
    """Device function (rows, matrix, i, x, first) → Σⱼ A[i, j] x[first + j]."""
    vec3, _ = types(dtype)

    @wp.func
    def multiplied(rows: constant_rows(dtype), matrix: int, i: int, x: wp.array(dtype=vec3), first: int):
        total = vec3()
        for s in range(rows.offsets[i], rows.offsets[i + 1]):
            total += rows.values[matrix, s] * x[first + rows.columns[s]]
        return total

    return multiplied


@cache
def multiply_constant(dtype):
    """Kernel over (copies, rows): out = A x."""
    vec3, _ = types(dtype)
    product = row_product(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def multiply(
        # elements
        of_copy: wp.array(dtype=wp.int32),
        rows: constant_rows(dtype),
        # state in
        x: wp.array(dtype=vec3),
        # parameters
        n: int,
        columns: int,
        # out
        out: wp.array(dtype=vec3),
    ):
        copy, i = wp.tid()
        out[copy * n + i] = product(rows, of_copy[copy], i, x, copy * columns)

    return multiply


@cache
def subtract_constant(dtype):
    """Kernel over (copies, rows): out = b − A x, or 0 for a matrix that needs only ``cycle`` cycles."""
    vec3, _ = types(dtype)
    product = row_product(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def subtract(
        # elements
        of_copy: wp.array(dtype=wp.int32),
        cycles: wp.array(dtype=wp.int32),
        rows: constant_rows(dtype),
        # state in
        x: wp.array(dtype=vec3),
        b: wp.array(dtype=vec3),
        # parameters
        n: int,
        cycle: int,
        # out
        out: wp.array(dtype=vec3),
    ):
        copy, i = wp.tid()
        matrix = of_copy[copy]
        left = vec3()
        if cycle < cycles[matrix]:
            left = b[copy * n + i] - product(rows, matrix, i, x, copy * n)
        out[copy * n + i] = left

    return subtract


@cache
def multiply_dense(dtype):
    """Kernel over (copies, m): out = A x with dense symmetric A."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def multiply(
        # elements
        of_copy: wp.array(dtype=wp.int32),
        values: wp.array3d(dtype=dtype),
        # state in
        x: wp.array(dtype=vec3),
        # parameters
        m: int,
        # out
        out: wp.array(dtype=vec3),
    ):
        copy, i = wp.tid()
        matrix = of_copy[copy]
        total = vec3()
        for j in range(m):
            total += values[matrix, j, i] * x[copy * m + j]
        out[copy * m + i] = total

    return multiply


@cache
def add_levels(dtype):
    """Kernel over (copies, rows): out = Q x_c + T r, or += if ``accumulate`` is 1."""
    vec3, _ = types(dtype)
    product = row_product(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def add(
        # elements
        of_copy: wp.array(dtype=wp.int32),
        up: constant_rows(dtype),
        own: constant_rows(dtype),
        # state in
        coarse: wp.array(dtype=vec3),
        r: wp.array(dtype=vec3),
        # parameters
        n: int,
        coarse_n: int,
        accumulate: int,
        # in and out
        out: wp.array(dtype=vec3),
    ):
        copy, i = wp.tid()
        matrix = of_copy[copy]
        total = product(up, matrix, i, coarse, copy * coarse_n) + product(own, matrix, i, r, copy * n)
        if accumulate == 1:
            total += out[copy * n + i]
        out[copy * n + i] = total

    return add
