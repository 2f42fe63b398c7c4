"""Kernels of multigrid levels in every copy, and of the choice of a preconditioner.

A level has a symmetric matrix A of 3×3 blocks in compressed rows, and the diagonal blocks S of its Jacobi sweeps. P
interpolates from the next coarser level, with one weight for all coordinates and copies. ``due[copy]``, or None for all, is 1
where matrices are computed.
"""

from functools import cache

import warp as wp

from .block_pattern import find_column
from .linear import Solves
from .memory import load, store
from .reduce import stands_aside, sum_of_lanes
from .vectors import types

MODULE = "warpcloth.multigrid"
# Threads that share a row in sums over all of its blocks.
LANES = 32
# Weight of Jacobi sweeps. All below 2 converge, because S/ω is at most A⁻¹.
OMEGA = 1.8
# New coarse matrices cost about as much as so many cycles (3.0 to 3.5 on a core, 3.3 to 3.9 on an H200), and the sweeps of the
# finest level as one.
SPARED = 4
# The other preconditioner is tried again after so many solves.
AGED = 64
# A solve with diagonal blocks ends once it has cost this many times a solve with multigrid.
PATIENCE = 1.5
FADE = wp.constant(wp.float64(1.0 - 1.0 / AGED))


@wp.struct
class Rows:
    """Compressed rows of one copy: starts, and ascending columns; P has weights."""

    offsets: wp.array(dtype=wp.int32)
    columns: wp.array(dtype=wp.int32)
    weights: wp.array(dtype=wp.float64)


def _module(dtype):
    return f"{MODULE}.{dtype.__name__}"


@cache
def find_slots():
    """Kernel over rows: the block of a product L R to which each multiple of a block is added, in the order of L, then R.

    If ``symmetric``, blocks left of the diagonal have slot −1, and ``mirrors`` has the transpose of each block, or −1.
    ``counts`` is the number of multiples kept in each row.
    """

    @wp.kernel(module=MODULE, enable_backward=False)
    def find_each_slot(
        # elements
        left: Rows,
        right: Rows,
        product: Rows,
        # parameters
        symmetric: int,
        firsts: wp.array(dtype=wp.int32),
        # out
        slots: wp.array(dtype=wp.int32),
        counts: wp.array(dtype=wp.int32),
        mirrors: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        first, end = product.offsets[i], product.offsets[i + 1]
        at, count = int(firsts[i]), wp.int32(0)
        for t in range(first, end):
            mirrors[t] = -1
            if symmetric == 1:
                j = product.columns[t]
                mirrors[t] = find_column(product.columns, product.offsets[j], product.offsets[j + 1], i)
        for s in range(left.offsets[i], left.offsets[i + 1]):
            k = left.columns[s]
            for p in range(right.offsets[k], right.offsets[k + 1]):
                slot = wp.int32(-1)
                if symmetric == 0 or right.columns[p] >= i:
                    slot = find_column(product.columns, first, end, right.columns[p])
                    count += 1
                slots[at] = slot
                at += 1
        counts[i] = count

    return find_each_slot


@cache
def list_multiples(dtype):
    """Kernel over rows: the multiples weight·block of each block of L R, and where they end.

    One of L and R has weights, the other blocks; ``slots`` and ``firsts`` are of :func:`find_slots`, ``starts`` the first
    multiple of each row.
    """

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def list_each_multiple(
        # elements
        left: Rows,
        right: Rows,
        product: Rows,
        # state in
        slots: wp.array(dtype=wp.int32),
        # parameters
        firsts: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        # out
        ends: wp.array(dtype=wp.int32),
        sources: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=dtype),
    ):
        i = wp.tid()
        first, end = product.offsets[i], product.offsets[i + 1]
        for t in range(first, end):
            ends[t] = 0
        for at in range(firsts[i], firsts[i + 1]):
            if slots[at] >= 0:
                ends[slots[at]] = ends[slots[at]] + 1
        before = int(starts[i])
        for t in range(first, end):
            count = ends[t]
            ends[t] = before
            before += count
        at = int(firsts[i])
        for s in range(left.offsets[i], left.offsets[i + 1]):
            k = left.columns[s]
            for p in range(right.offsets[k], right.offsets[k + 1]):
                slot = slots[at]
                at += 1
                if slot >= 0:
                    source, weight = int(p), dtype(0.0)
                    if left.weights:
                        weight = dtype(left.weights[s])
                    else:
                        source = s
                        weight = dtype(right.weights[p])
                    sources[ends[slot]] = source
                    weights[ends[slot]] = weight
                    ends[slot] = ends[slot] + 1

    return list_each_multiple


@cache
def add_multiples(dtype):
    """Kernel over (copies, threads): blocks of a product, out = Σ weight·value, and its transpose, if any."""
    _, mat33 = types(dtype)
    index, weight, value, put = load(wp.int32), load(dtype), load(mat33), store(mat33)

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def add_each_multiple(
        # elements
        offsets: wp.array(dtype=wp.int32),
        sources: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=dtype),
        blocks: wp.array(dtype=wp.vec2i),
        # state in
        values: wp.array(dtype=mat33),
        # parameters
        due: wp.array(dtype=wp.int32),
        per_copy: int,
        count: int,
        threads: int,
        # out
        out: wp.array(dtype=mat33),
    ):
        copy, thread = wp.tid()
        if stands_aside(due, copy):
            return
        for t in range(thread, blocks.shape[0], threads):
            block = blocks[t]
            total = mat33()
            for s in range(index(offsets, block[0]), index(offsets, block[0] + 1)):
                total += weight(weights, s) * value(values, copy * per_copy + index(sources, s))
            first = copy * count
            put(out, first + block[0], total)
            if block[1] >= 0:
                put(out, first + block[1], wp.transpose(total))

    return add_each_multiple


@cache
def eliminate(dtype):
    """Kernel over (copies, m, m) blocks: a step of Gauss–Jordan inversion with pivot block p.

    A pivot that is not positive definite gives 0, so the inverse is semi-definite.
    """
    _, mat33 = types(dtype)

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def eliminate_pivot(
        # state in
        before: wp.array(dtype=mat33),
        # parameters
        due: wp.array(dtype=wp.int32),
        p: int,
        m: int,
        # out
        after: wp.array(dtype=mat33),
    ):
        copy, i, j = wp.tid()
        first = copy * m * m
        if stands_aside(due, copy):
            after[first + i * m + j] = before[first + i * m + j]
            return
        pivot = before[first + p * m + p]
        minor = pivot[0, 0] * pivot[1, 1] - pivot[0, 1] * pivot[1, 0]
        inverse = mat33()
        if pivot[0, 0] > dtype(0.0) and minor > dtype(0.0) and wp.determinant(pivot) > dtype(0.0):
            inverse = wp.inverse(pivot)
        found = inverse
        if i != p and j != p:
            found = before[first + i * m + j] - before[first + i * m + p] * inverse * before[first + p * m + j]
        elif i != p:
            found = -before[first + i * m + p] * inverse
        elif j != p:
            found = inverse * before[first + p * m + j]
        after[first + i * m + j] = found

    return eliminate_pivot


@cache
def factorise_diagonal(dtype):
    """Kernel over block rows: factor[i] = L⁻¹ with A[i, i] = LLᵀ, I/√‖A[i, i]‖ if indefinite, or 0 for 0, in float64."""
    _, mat33 = types(dtype)

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def factorise(
        # elements
        diagonal: wp.array(dtype=wp.int32),
        # state in
        values: wp.array(dtype=mat33),
        # parameters
        due: wp.array(dtype=wp.int32),
        per_copy: int,
        # out
        factor: wp.array(dtype=mat33),
    ):
        i = wp.tid()
        if stands_aside(due, i // per_copy):
            return
        zero = wp.float64(0.0)
        block = wp.mat33d(values[diagonal[i]])
        size = wp.sqrt(wp.ddot(block, block))
        found = wp.mat33d()
        if not (size == zero):
            found = wp.identity(n=3, dtype=wp.float64) / wp.sqrt(size)
            if block[0, 0] > zero:
                l00 = wp.sqrt(block[0, 0])
                l10 = block[1, 0] / l00
                l20 = block[2, 0] / l00
                rest = block[1, 1] - l10 * l10
                if rest > zero:
                    l11 = wp.sqrt(rest)
                    l21 = (block[2, 1] - l20 * l10) / l11
                    rest = block[2, 2] - l20 * l20 - l21 * l21
                    if rest > zero:
                        m00 = wp.float64(1.0) / l00
                        m11 = wp.float64(1.0) / l11
                        m22 = wp.float64(1.0) / wp.sqrt(rest)
                        m10 = -l10 * m00 * m11
                        m21 = -l21 * m11 * m22
                        m20 = -(l20 * m00 + l21 * m10) * m22
                        found = wp.mat33d(m00, zero, zero, m10, m11, zero, m20, m21, m22)
        factor[i] = mat33(found)

    return factorise


@cache
def scale_sweeps(dtype, block: int):
    """Kernel over (block rows, lanes): S[i] = ω LᵀL/Σⱼ‖L[i] A[i, j] L[j]ᵀ‖, L the inverse factors of the diagonal blocks.

    So no eigenvalue of S A exceeds ω (Baker et al. 2011, *Multigrid smoothers for ultraparallel computing*, for numbers).
    """
    vec3, mat33 = types(dtype)
    lanes = LANES if block > 1 else 1
    sum_over = sum_of_lanes(dtype, lanes)

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def scale(
        # elements
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        # state in
        values: wp.array(dtype=mat33),
        factor: wp.array(dtype=mat33),
        # parameters
        due: wp.array(dtype=wp.int32),
        per_copy: int,
        own: dtype,
        # out
        sweep: wp.array(dtype=mat33),
    ):
        i, lane = wp.tid()
        if stands_aside(due, i // per_copy):
            return
        left = factor[i]
        total = dtype(0.0)
        for s in range(offsets[i] + lane, offsets[i + 1], wp.static(lanes)):
            j = columns[s]
            if j != i:
                block = left * values[s] * wp.transpose(factor[j])
                rows = dtype(0.0)
                across = dtype(0.0)
                for a in range(3):
                    rows = wp.max(rows, wp.abs(block[a, 0]) + wp.abs(block[a, 1]) + wp.abs(block[a, 2]))
                    across = wp.max(across, wp.abs(block[0, a]) + wp.abs(block[1, a]) + wp.abs(block[2, a]))
                total += wp.sqrt(wp.min(rows * across, wp.ddot(block, block)))
        total = own + sum_over(vec3(total, dtype(0.0), dtype(0.0)))[0]
        if lane == 0:
            sweep[i] = dtype(OMEGA) / total * (wp.transpose(left) * left)

    return scale


# Indices of what a ChoiceState has of each copy.
BLOCKS, TRIAL, LIMIT, WAIT = (wp.constant(k) for k in range(4))
GAINED, COSTS = wp.constant(0), wp.constant(2)


@wp.struct
class ChoiceState:
    """Which preconditioner solves use, (B,).

    ``present`` has BLOCKS, 1 for diagonal blocks, 0 for multigrid; TRIAL, 1 for a trial of up to LIMIT iterations; and WAIT,
    the solves before the next trial. ``past`` has the decades of √(rᵀPr) that each GAINED and their COSTS in iterations with
    blocks, fading sums. ``by_blocks`` and ``by_cycles`` are the copies of a solve, ``any_blocks`` and ``any_cycles`` (1,)
    whether there are any. ``outdated`` coarse matrices are ``due`` where used.
    """

    present: wp.array(dtype=wp.vec4i)
    past: wp.array(dtype=wp.vec4d)
    by_blocks: wp.array(dtype=wp.int32)
    by_cycles: wp.array(dtype=wp.int32)
    any_blocks: wp.array(dtype=wp.int32)
    any_cycles: wp.array(dtype=wp.int32)
    outdated: wp.array(dtype=wp.int32)
    due: wp.array(dtype=wp.int32)
    any_due: wp.array(dtype=wp.int32)


@cache
def begin_choice():
    """Kernel over copies: divides those ``wanted`` by preconditioner, and sets their maximum of iterations.

    With blocks, that is ``PATIENCE`` times the cost of multigrid for the tolerance; trials have their own.
    """

    @wp.kernel(module=MODULE, enable_backward=False)
    def begin(
        # parameters
        wanted: wp.array(dtype=wp.int32),
        iterations: int,
        # in and out
        choice: ChoiceState,
        solves: Solves,
    ):
        copy = wp.tid()
        now = choice.present[copy]
        past = choice.past[copy]
        by_blocks = wanted[copy] * now[BLOCKS]
        by_cycles = wanted[copy] - by_blocks
        choice.by_cycles[copy] = by_cycles
        choice.by_blocks[copy] = by_blocks
        choice.due[copy] = by_cycles * choice.outdated[copy]
        if choice.due[copy] == 1:
            choice.outdated[copy] = 0
            choice.any_due[0] = 1
        if by_cycles == 1:
            choice.any_cycles[0] = 1
        if by_blocks == 1:
            choice.any_blocks[0] = 1
        most = iterations
        if now[TRIAL] == 1:
            most = wp.min(most, now[LIMIT])
        elif now[BLOCKS] == 1 and past[GAINED + 1] > wp.float64(0.0):
            decades = wp.max(-wp.log10(solves.tolerance[copy]), wp.float64(1.0))
            cost = wp.float64(PATIENCE) * decades * past[COSTS + 1] / past[GAINED + 1]
            most = wp.int32(wp.min(wp.float64(most), wp.ceil(cost)))
        solves.most[copy] = most

    return begin


@cache
def end_choice():
    """Kernel over copies: chooses the next preconditioner by decades gained for the cost, means over about ``AGED`` solves.

    The first solve is by multigrid, the second tries blocks; the other is tried again after ``AGED`` solves, or sooner if it
    gained more for its cost. A solve that is cut off gained nothing; one that ends at negative curvature does not count.
    """

    @wp.kernel(module=MODULE, enable_backward=False)
    def end(
        # state in
        solves: Solves,
        # parameters
        wanted: wp.array(dtype=wp.int32),
        cycle: int,
        # in and out
        choice: ChoiceState,
    ):
        copy = wp.tid()
        count = solves.iteration[copy]
        first, last = solves.first[copy], solves.next_rz[copy]
        if wanted[copy] == 0 or solves.negative[copy] == 1 or not (first > wp.float64(0.0) and last > wp.float64(0.0)):
            return
        now = choice.present[copy]
        used = 1 - now[BLOCKS]
        other = 1 - used
        cost = wp.where(used == 1, cycle * (count + 1 + wp.static(SPARED) * choice.due[copy]), count + 1)
        past = FADE * choice.past[copy]
        past[COSTS + used] += wp.float64(cost)
        if count < solves.most[copy]:
            past[GAINED + used] += wp.float64(0.5) * wp.log10(first / last)
        choice.past[copy] = past
        better = past[GAINED + used] * past[COSTS + other] > past[GAINED + other] * past[COSTS + used]
        if now[TRIAL] == 1:
            now[TRIAL] = 0
            now[WAIT] = wp.static(AGED)
            if not better:
                now[BLOCKS] = used
        else:
            now[WAIT] -= 1
            worse = past[GAINED + other] * past[COSTS + used] > past[GAINED + used] * past[COSTS + other]
            if now[WAIT] <= 0 or worse:
                now[TRIAL] = 1
                now[BLOCKS] = used
                now[LIMIT] = wp.where(other == 1, 2 * cost / cycle + 1, 2 * cost)
        choice.present[copy] = now

    return end
