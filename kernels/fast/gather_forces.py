"""Sums over the elements of a vertex for all terms in one launch, in a fixed order."""

from functools import cache

import warp as wp

from ..local import from_corner
from ..memory import load, load_shared, store
from ..reduce import sum_of_lanes
from ..transpose import to_corner
from ..vectors import types
from .packed_residual import unpack_residual
from .term_facts import TermFacts, chain_of, elements_struct, local_gradient


@cache
def move_of(dtype, ahead):
    """Device function (v, i, h) → displacement of xᵢ: h vᵢ, or, for int32 v, the packed residual in units of h."""
    vec3, _ = types(dtype)
    if ahead is wp.int32:
        whole = load(wp.int32)

        @wp.func
        def unpacked(v: wp.array(dtype=wp.int32), i: int, unit: dtype):
            return unpack_residual(whole(v, i), unit)

        return unpacked
    vector = load(vec3)

    @wp.func
    def scaled(v: wp.array(dtype=vec3), i: int, h: dtype):
        return h * vector(v, i)

    return scaled


@cache
def gather_term(part: TermFacts, dtype, ahead=None, lanes: int = 1):
    """Device function (elements, i, lane, N, x, v, h) → ∂U/∂xᵢ + ∂D/∂xᵢ [N] of one term.

    ∂U/∂x is at x, or, if ``ahead`` is the type of v, at x moved by :func:`move_of`. Each of the ``lanes`` threads takes every
    ``lanes``-th element.
    """
    if part.rows:
        return gather_matrix_rows(part, dtype, ahead, lanes)
    if part.pairs:
        return gather_pairs(part, dtype, ahead, lanes)
    vec3, _ = types(dtype)
    v_type = ahead or vec3
    term = part.term
    K, damped, shared, padded = wp.constant(term.vertices), part.damped, part.shared, part.padded
    moved = damped or ahead is not None
    precision = part.precision(dtype)
    wide, y_type = types(precision)[0], wp.types.matrix((term.rows, 3), precision)
    exact_rest = wp.types.vector(term.parameters, precision)
    part_of, share_of = from_corner(term, precision), to_corner(term, dtype)
    local = local_gradient(part, dtype, ahead is not None)
    vector, whole, vertex, number = load(vec3), load(wp.int32), load(wp.int32, 2), load_shared(dtype)
    moves = move_of(dtype, ahead)
    rest_of = load(wp.types.vector(term.parameters, dtype))

    @wp.func
    def total_of(
        elements: elements_struct(part, dtype),
        i: int,
        lane: int,
        count: int,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=v_type),
        h: dtype,
    ):
        total = vec3()
        beta = dtype(0.0)
        k = dtype(0.0)
        if wp.static(shared):
            k = number(elements.stiffness, 0)
        slot = whole(elements.offsets, i)
        left = whole(elements.offsets, i + 1) - slot - lane
        if wp.static(padded):
            slot = lane * count + i
        else:
            slot += lane
        while left > 0:
            code = whole(elements.codes, slot)
            e = code // K
            stored = rest_of(elements.rest, e)
            r = exact_rest(stored)
            y = y_type()
            dy = y_type()
            for corner in range(K):
                j = vertex(elements.stencil, K * e + corner)
                y += part_of(r, corner, wide(vector(x, j)))
                if wp.static(moved):
                    dy += part_of(r, corner, wide(moves(v, j, h)))
            if wp.static(damped):
                beta = number(elements.damping, e)
            if wp.static(not shared):
                k = number(elements.stiffness, e)
            total += share_of(stored, code - K * e, local(k, beta, r, y, dy, h))
            if wp.static(padded):
                slot += lanes * count
            else:
                slot += lanes
            left -= lanes
        return total

    return total_of


@cache
def gather_pairs(part: TermFacts, dtype, ahead, lanes: int):
    """:func:`gather_term` for pairs, without branches: an empty slot pairs the vertex with itself, without force."""
    vec3, _ = types(dtype)
    v_type = ahead or vec3
    term = part.term
    (firsts, seconds), damped, shared = part.pairs, part.damped, part.shared
    slots = firsts + seconds
    apart = shared and not damped
    ragged, each, firsts, slots = slots % lanes > 0, wp.constant(-(-slots // lanes)), wp.constant(firsts), wp.constant(slots)
    moved = damped or ahead is not None
    precision = part.precision(dtype)
    wide, y_type = types(precision)[0], wp.types.matrix((term.rows, 3), precision)
    exact_rest = wp.types.vector(term.parameters, precision)
    part_of, share_of = from_corner(term, precision), to_corner(term, dtype)
    local = local_gradient(part, dtype, ahead is not None)
    vector, whole, number, moves = load(vec3), load(wp.int32), load_shared(dtype), move_of(dtype, ahead)
    rest_of = load(wp.types.vector(term.parameters, dtype))

    @wp.func
    def total_of(
        elements: elements_struct(part, dtype),
        i: int,
        lane: int,
        count: int,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=v_type),
        h: dtype,
    ):
        total = vec3()
        beta = dtype(0.0)
        position = vector(x, i)
        move = vec3()
        if wp.static(moved):
            move = moves(v, i, h)
        k = dtype(1.0)
        for n in range(each):
            s = n * lanes + lane
            if wp.static(ragged):
                s = wp.min(s, slots - 1)
            corner = wp.where(s < firsts, 0, 1)  # with one lane constant for the compiler, and so are the weights
            slot = s * count + i
            code = whole(elements.codes, slot)
            if wp.static(ragged):
                code = wp.where(n * lanes + lane < slots, code, i)
            stored = rest_of(elements.rest, slot)
            r = exact_rest(stored)
            y = part_of(r, corner, wide(position)) + part_of(r, 1 - corner, wide(vector(x, code)))
            dy = y_type()
            if wp.static(moved):
                dy = part_of(r, corner, wide(move)) + part_of(r, 1 - corner, wide(moves(v, code, h)))
            if wp.static(damped):
                beta = number(elements.damping, slot)
            if wp.static(not apart):
                k = number(elements.stiffness, slot)
            total += share_of(stored, corner, local(k, beta, r, y, dy, h))
        if wp.static(apart):
            total *= number(elements.stiffness, i)
        return total

    return total_of


@cache
def gather_matrix_rows(part: TermFacts, dtype, ahead, lanes: int):
    """:func:`gather_term` from rows of the matrix Q of a quadratic energy, Σⱼ Qᵢⱼ (xⱼ − xᵢ)."""
    vec3, _ = types(dtype)
    v_type = ahead or vec3
    vector, whole, number, moves = load(vec3), load(wp.int32), load(dtype), move_of(dtype, ahead)
    moved, ragged = ahead is not None, part.rows % lanes > 0
    each, slots = wp.constant(-(-part.rows // lanes)), wp.constant(part.rows)

    @wp.func
    def pull_of(
        elements: elements_struct(part, dtype),
        slot: int,
        position: vec3,
        move: vec3,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=v_type),
        h: dtype,
    ):
        j = whole(elements.codes, slot)
        apart = vector(x, j) - position
        if wp.static(moved):
            apart += moves(v, j, h) - move
        return number(elements.stiffness, slot) * apart

    @wp.func
    def total_of(
        elements: elements_struct(part, dtype),
        i: int,
        lane: int,
        count: int,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=v_type),
        h: dtype,
    ):
        total = vec3()
        position = vector(x, i)
        move = vec3()
        if wp.static(moved):
            move = moves(v, i, h)
        for n in range(each):
            s = n * lanes + lane
            if wp.static(ragged):
                if s < slots:
                    total += pull_of(elements, s * count + i, position, move, x, v, h)
            else:
                total += pull_of(elements, s * count + i, position, move, x, v, h)
        return total

    return total_of


@cache
def gather_terms(parts: tuple[TermFacts, ...], dtype, ahead=None, lanes: int = 1):
    vec3, _ = types(dtype)
    v_type = ahead or vec3
    chain_type = chain_of(parts, dtype)
    key = dtype, ahead, lanes
    first, others = (gather_term(parts[0], *key), gather_terms(parts[1:], *key)) if parts else (None, None)

    @wp.func
    def total_of(
        chain: chain_type, i: int, lane: int, count: int, x: wp.array(dtype=vec3), v: wp.array(dtype=v_type), h: dtype
    ):
        if wp.static(first is None):
            return vec3()
        else:
            return first(chain.first, i, lane, count, x, v, h) + others(chain.others, i, lane, count, x, v, h)

    return total_of


@cache
def sum_at_vertices(parts: tuple[TermFacts, ...], dtype, ahead=None, lanes: int = 1):
    """Device function (thread, chain, N, x, v, h) → the sum at vertex ``thread // lanes``."""
    vec3, _ = types(dtype)
    v_type = ahead or vec3
    total_of = gather_terms(parts, dtype, ahead, lanes)
    chain_type = chain_of(parts, dtype)
    if lanes == 1:

        @wp.func
        def alone(thread: int, chain: chain_type, count: int, x: wp.array(dtype=vec3), v: wp.array(dtype=v_type), h: dtype):
            return total_of(chain, thread, 0, count, x, v, h)

        return alone
    sum_over = sum_of_lanes(dtype, lanes)

    @wp.func
    def together(thread: int, chain: chain_type, count: int, x: wp.array(dtype=vec3), v: wp.array(dtype=v_type), h: dtype):
        i = thread // lanes
        return sum_over(total_of(chain, i, thread - i * lanes, count, x, v, h))

    return together


@cache
def gather_forces(parts: tuple[TermFacts, ...], dtype, corrected: bool = False, lanes: int = 1):
    """Kernel over vertices, ``lanes`` threads each: out += ∂U/∂x [N] of all terms, at x, or if ``corrected`` at x + d."""
    vec3, _ = types(dtype)
    total_of = sum_at_vertices(parts, dtype, vec3 if corrected else None, lanes)
    vector, put = load(vec3), store(vec3)

    @wp.kernel(module="unique", enable_backward=False)
    def gather(
        # elements
        chain: chain_of(parts, dtype),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # in and out
        out: wp.array(dtype=vec3),
    ):
        thread = wp.tid()
        total = total_of(thread, chain, x.shape[0], x, d, dtype(1.0))
        i = thread // lanes
        if thread == i * lanes:
            put(out, i, vector(out, i) + total)

    return gather
