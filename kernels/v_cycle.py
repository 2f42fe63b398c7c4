"""Factories of the kernels of a V-cycle on the CPU, see :mod:`warpcloth.numerics.v_cycle`.

A copy has one thread, for each thread would copy the structs. ``active[copy]`` is 1 while a copy iterates.
"""

from functools import cache

import warp as wp

from .block_rows import block_rows, product_of_row
from .memory import load
from .vectors import types


def _module(dtype, terms=0):
    """The name of a module, in which no two kernels have one name."""
    return f"warpcloth.v_cycle.{dtype.__name__}" + f".{terms}" * (terms > 0)


@cache
def subtract_product(dtype, terms: int = 0):
    """Kernel over copies: out = r − A x, minus a ``further`` product with x if that is not None. ``out`` may be r."""
    vec3, _ = types(dtype)
    product = product_of_row(dtype, 1, terms)

    @wp.kernel(module=_module(dtype, terms), enable_backward=False)
    def subtract_rows(
        # elements
        matrix: block_rows(dtype),
        # state in
        x: wp.array(dtype=vec3),
        further: wp.array(dtype=vec3),
        r: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        # out
        out: wp.array(dtype=vec3),
    ):
        copy = wp.tid()
        if active[copy] == 0:
            return
        for i in range(copy * per_copy, (copy + 1) * per_copy):
            total = r[i] - product(matrix, i, 0, x, x, dtype(0.0))
            if further:
                total -= further[i]
            out[i] = total

    return subtract_rows


@cache
def restrict(dtype):
    """Kernel over copies: r_c = Pᵀr, x_c = S r_c."""
    vec3, mat33 = types(dtype)
    index, weight, vector = load(wp.int32), load(dtype), load(vec3)

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def restrict_rows(
        # elements
        offsets: wp.array(dtype=wp.int32),
        sources: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=dtype),
        # state in
        r: wp.array(dtype=vec3),
        sweep: wp.array(dtype=mat33),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        coarse_per_copy: int,
        # out
        coarse_r: wp.array(dtype=vec3),
        coarse_x: wp.array(dtype=vec3),
    ):
        copy = wp.tid()
        if active[copy] == 0:
            return
        for i in range(coarse_per_copy):
            total = vec3()
            for s in range(index(offsets, i), index(offsets, i + 1)):
                total += weight(weights, s) * vector(r, copy * per_copy + index(sources, s))
            at = copy * coarse_per_copy + i
            coarse_r[at] = total
            coarse_x[at] = sweep[at] * total

    return restrict_rows


@cache
def prolong(dtype):
    """Kernel over copies: d = P x_c."""
    vec3, _ = types(dtype)
    index, weight, vector = load(wp.int32), load(dtype), load(vec3)

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def prolong_rows(
        # elements
        offsets: wp.array(dtype=wp.int32),
        parents: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=dtype),
        # state in
        coarse_x: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        coarse_per_copy: int,
        # out
        d: wp.array(dtype=vec3),
    ):
        copy = wp.tid()
        if active[copy] == 0:
            return
        for i in range(per_copy):
            total = vec3()
            for s in range(index(offsets, i), index(offsets, i + 1)):
                total += weight(weights, s) * vector(coarse_x, copy * coarse_per_copy + index(parents, s))
            d[copy * per_copy + i] = total

    return prolong_rows


@cache
def sweep_after(dtype, terms: int = 0):
    """Kernel over copies: x += d + S(r − A d), minus a ``further`` product with d if that is not None."""
    vec3, mat33 = types(dtype)
    product = product_of_row(dtype, 1, terms)

    @wp.kernel(module=_module(dtype, terms), enable_backward=False)
    def sweep_rows(
        # elements
        matrix: block_rows(dtype),
        # state in
        sweep: wp.array(dtype=mat33),
        d: wp.array(dtype=vec3),
        further: wp.array(dtype=vec3),
        r: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        # in and out
        x: wp.array(dtype=vec3),
    ):
        copy = wp.tid()
        if active[copy] == 0:
            return
        for i in range(copy * per_copy, (copy + 1) * per_copy):
            total = r[i] - product(matrix, i, 0, d, d, dtype(0.0))
            if further:
                total -= further[i]
            x[i] = x[i] + d[i] + sweep[i] * total

    return sweep_rows
