"""Kernels of additive multigrid; ``active[copy]`` is 1 while a copy iterates."""

from functools import cache

import warp as wp

from .block_rows import LANES, lanes_of_rows
from .memory import load
from .reduce import stands_aside, sum_of_lanes, wait_for_block
from .vectors import types

# Threads that share a column of P̄, which has more blocks than a row, in a launch of its own and in :func:`refine`.
COLUMN_LANES, FEWER = 32, 16


def _module(dtype):
    return f"warpcloth.additive_multigrid.{dtype.__name__}"


@cache
def smooth_interpolation(dtype):
    """Kernel over (copies, blocks of AP): P̄ = P − S A P in place of AP, and again ``by_column``, at the ``slots``; 0 in locked
    rows.
    """
    vec3, mat33 = types(dtype)

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def smooth(
        # elements
        rows: wp.array(dtype=wp.int32),
        slots: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=dtype),
        mobility: wp.array(dtype=vec3),
        # state in
        sweep: wp.array(dtype=mat33),
        # parameters
        due: wp.array(dtype=wp.int32),
        per_copy: int,
        # in and out
        values: wp.array(dtype=mat33),
        # out
        by_column: wp.array(dtype=mat33),
    ):
        copy, t = wp.tid()
        if stands_aside(due, copy):
            return
        i, s = copy * per_copy + rows[t], copy * rows.shape[0] + t
        found = weights[t] * wp.identity(n=3, dtype=dtype) - sweep[i] * values[s]
        if mobility:
            for axis in range(3):
                if mobility[i][axis] == dtype(0.0):
                    for other in range(3):
                        found[axis, other] = dtype(0.0)
        values[s] = found
        by_column[copy * rows.shape[0] + slots[t]] = found

    return smooth


@cache
def transfer(dtype):
    """Struct of P̄ from a coarser level, by rows and by columns, and of that level.

    Column i has the ``entries`` from ``starts`` [i] on; ``values`` are the blocks of P̄ by rows, ``sweep`` is S of the coarser
    level, ``dense`` its inverse, or None.
    """
    vec3, mat33 = types(dtype)

    @wp.struct
    class Transfer:
        rows: wp.array(dtype=wp.int32)
        columns: wp.array(dtype=wp.int32)
        starts: wp.array(dtype=wp.int32)
        entries: wp.array(dtype=wp.int32)
        values: wp.array(dtype=mat33)
        by_column: wp.array(dtype=mat33)
        sweep: wp.array(dtype=mat33)
        dense: wp.array(dtype=mat33)
        r: wp.array(dtype=vec3)
        x: wp.array(dtype=vec3)
        n: int
        coarse: int

    return Transfer


@cache
def restricted(dtype, lanes: int):
    """Device function (transfer, copy, i, lane, r): r_c = P̄ᵀr and x_c = S r_c of coarse row i."""
    vec3, mat33 = types(dtype)
    index, block, vector, sum_over = load(wp.int32), load(mat33), load(vec3), sum_of_lanes(dtype, lanes)

    @wp.func
    def restrict_row(T: transfer(dtype), copy: int, i: int, lane: int, r: wp.array(dtype=vec3)):
        first, count = copy * T.n, copy * T.columns.shape[0]
        total = vec3()
        for s in range(index(T.starts, i) + lane, index(T.starts, i + 1), wp.static(lanes)):
            total += wp.transpose(block(T.by_column, count + s)) * vector(r, first + index(T.entries, s))
        total = sum_over(total)
        if lane == 0:
            at = copy * T.coarse + i
            T.r[at] = total
            if not T.dense:
                T.x[at] = block(T.sweep, at) * total

    return restrict_row


@cache
def prolonged(dtype, lanes: int):
    """Device function (transfer, copy, i, lane, x): x += P̄ x_c of row i."""
    vec3, mat33 = types(dtype)
    index, block, vector, sum_over = load(wp.int32), load(mat33), load(vec3), sum_of_lanes(dtype, lanes)

    @wp.func
    def prolong_row(T: transfer(dtype), copy: int, i: int, lane: int, x: wp.array(dtype=vec3)):
        first, count = copy * T.coarse, copy * T.columns.shape[0]
        total = vec3()
        for s in range(index(T.rows, i) + lane, index(T.rows, i + 1), wp.static(lanes)):
            total += block(T.values, count + s) * vector(T.x, first + index(T.columns, s))
        total = sum_over(total)
        if lane == 0:
            at = copy * T.n + i
            x[at] = x[at] + total

    return prolong_row


@cache
def restrict_smoothly(dtype):
    """CUDA kernel over (copies, COLUMN_LANES · coarse rows): r_c = P̄ᵀr, x_c = S r_c."""
    vec3, _ = types(dtype)
    restrict_row = restricted(dtype, COLUMN_LANES)

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def restrict_rows(
        # elements
        T: transfer(dtype),
        # state in
        r: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
    ):
        copy, thread = wp.tid()
        if active[copy] == 1:
            restrict_row(T, copy, thread // wp.static(COLUMN_LANES), thread % wp.static(COLUMN_LANES), r)

    return restrict_rows


@cache
def prolong_smoothly(dtype):
    """CUDA kernel over (copies, LANES · rows): x += P̄ x_c."""
    vec3, _ = types(dtype)
    prolong_row = prolonged(dtype, LANES)

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def prolong_rows(
        # elements
        T: transfer(dtype),
        # parameters
        active: wp.array(dtype=wp.int32),
        # in and out
        x: wp.array(dtype=vec3),
    ):
        copy, thread = wp.tid()
        if active[copy] == 1:
            prolong_row(T, copy, thread // wp.static(LANES), thread % wp.static(LANES), x)

    return prolong_rows


@cache
def refine(dtype, block: int):
    """Kernel over (copies, threads): x += P̄ M_c P̄ᵀ r, by all transfers from the ``first`` on.

    A copy has a ``block`` of threads, or one on the CPU, where ``block`` is 0.
    """
    vec3, mat33 = types(dtype)
    lanes, dense_block, vector = lanes_of_rows(block), load(mat33), load(vec3)
    wide = FEWER if block > 1 else 1
    restrict_row, prolong_row, sum_over = restricted(dtype, wide), prolonged(dtype, lanes), sum_of_lanes(dtype, lanes)
    rows = max(block // lanes, 1)
    columns = max(block // wide, 1)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def refine_copies(
        # elements
        transfers: wp.array(dtype=transfer(dtype)),
        # state in
        r: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
        first: int,
        # in and out
        x: wp.array(dtype=vec3),
    ):
        copy, thread = wp.tid()
        if active[copy] == 0:
            return
        lane = thread % wp.static(lanes)
        row = thread // wp.static(lanes)
        last = transfers.shape[0] - 1
        for k in range(first, last + 1):
            T = transfers[k]
            right = r
            if k > first:
                right = transfers[k - 1].r
            for i in range(thread // wp.static(wide), T.coarse, wp.static(columns)):
                restrict_row(T, copy, i, thread % wp.static(wide), right)
            wait_for_block()
        T = transfers[last]
        if T.dense:
            for i in range(row, T.coarse, wp.static(rows)):
                total = vec3()
                for j in range(lane, T.coarse, wp.static(lanes)):
                    total += dense_block(T.dense, (copy * T.coarse + i) * T.coarse + j) * vector(T.r, copy * T.coarse + j)
                total = sum_over(total)
                if lane == 0:
                    T.x[copy * T.coarse + i] = total
            wait_for_block()
        for back in range(last + 1 - first):
            k = last - back
            T = transfers[k]
            out = x
            if k > first:
                out = transfers[k - 1].x
            for i in range(row, T.n, wp.static(rows)):
                prolong_row(T, copy, i, lane, out)
            wait_for_block()

    return refine_copies
