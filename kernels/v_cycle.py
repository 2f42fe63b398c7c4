"""Kernels of a V-cycle; ``active[copy]`` is 1 while a copy iterates."""

from functools import cache

import warp as wp

from .block_rows import block_rows, lanes_of_rows, product_of_row
from .memory import load
from .reduce import sum_of_lanes
from .vectors import types


def _module(dtype, terms=0):
    return f"warpcloth.v_cycle.{dtype.__name__}" + f".{terms}" * (terms > 0)


@cache
def residual(dtype, block: int, terms: int):
    """Device function (i, lane, matrix, x, further, r) → r[i] − (A x)[i] − further[i], in all lanes of the row.

    ``further`` may be None.
    """
    vec3, _ = types(dtype)
    lanes = lanes_of_rows(block)
    product, sum_over = product_of_row(dtype, lanes, terms), sum_of_lanes(dtype, lanes)

    @wp.func
    def residual_of_row(
        i: int,
        lane: int,
        matrix: block_rows(dtype),
        x: wp.array(dtype=vec3),
        further: wp.array(dtype=vec3),
        r: wp.array(dtype=vec3),
    ):
        total = r[i] - sum_over(product(matrix, i, lane, x, x, dtype(0.0)))
        if further:
            total -= further[i]
        return total

    return residual_of_row


@cache
def subtract_product(dtype, block: int, terms: int = 0):
    """Kernel over (copies, threads): out = r − A x, minus a ``further`` product with x if not None; out may be r.

    On CUDA threads share rows; on the CPU a copy has one.
    """
    vec3, _ = types(dtype)
    remaining, lanes = residual(dtype, block, terms), lanes_of_rows(block)

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
        copy, thread = wp.tid()
        if active[copy] == 0:
            return
        if wp.static(block == 0):
            for i in range(copy * per_copy, (copy + 1) * per_copy):
                out[i] = remaining(i, 0, matrix, x, further, r)
        else:
            i = copy * per_copy + thread // wp.static(lanes)
            lane = thread % wp.static(lanes)
            total = remaining(i, lane, matrix, x, further, r)
            if lane == 0:
                out[i] = total

    return subtract_rows


@cache
def restrict(dtype):
    """Kernel over (copies, threads): r_c = Pᵀr, x_c = S r_c."""
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
        threads: int,
        # out
        coarse_r: wp.array(dtype=vec3),
        coarse_x: wp.array(dtype=vec3),
    ):
        copy, thread = wp.tid()
        if active[copy] == 0:
            return
        for i in range(thread, coarse_per_copy, threads):
            total = vec3()
            for s in range(index(offsets, i), index(offsets, i + 1)):
                total += weight(weights, s) * vector(r, copy * per_copy + index(sources, s))
            at = copy * coarse_per_copy + i
            coarse_r[at] = total
            coarse_x[at] = sweep[at] * total

    return restrict_rows


@cache
def prolong(dtype):
    """Kernel over (copies, threads): d = P x_c."""
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
        threads: int,
        # out
        d: wp.array(dtype=vec3),
    ):
        copy, thread = wp.tid()
        if active[copy] == 0:
            return
        for i in range(thread, per_copy, threads):
            total = vec3()
            for s in range(index(offsets, i), index(offsets, i + 1)):
                total += weight(weights, s) * vector(coarse_x, copy * coarse_per_copy + index(parents, s))
            d[copy * per_copy + i] = total

    return prolong_rows


@cache
def sweep_after(dtype, block: int, terms: int = 0):
    """Kernel over (copies, threads): x += d + S(r − A d), minus a ``further`` product with d if not None."""
    vec3, mat33 = types(dtype)
    remaining, lanes = residual(dtype, block, terms), lanes_of_rows(block)

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
        copy, thread = wp.tid()
        if active[copy] == 0:
            return
        if wp.static(block == 0):
            for i in range(copy * per_copy, (copy + 1) * per_copy):
                x[i] = x[i] + d[i] + sweep[i] * remaining(i, 0, matrix, d, further, r)
        else:
            i = copy * per_copy + thread // wp.static(lanes)
            lane = thread % wp.static(lanes)
            total = remaining(i, lane, matrix, d, further, r)
            if lane == 0:
                x[i] = x[i] + d[i] + sweep[i] * total

    return sweep_rows
