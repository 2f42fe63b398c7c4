"""A Jacobi sweep in one launch: each vertex gathers the corrections of its elements.

x̃ and 1/m of a vertex are a row of four numbers. d and λ are read from one array and written to another; the first corner's
thread updates λ.
"""

from functools import cache
from typing import NamedTuple

import warp as wp

from ..local import from_corner
from ..memory import load, load_shared, store
from ..project import multiplier, multiplier_type
from ..transpose import to_corner
from ..vectors import types
from .term_facts import TermFacts, chain_of, elements_struct


def slot_rows(slots):
    """Numbers of rows of pairs of a vertex, and of slots per row, 2 or 4, some empty, ordered by row, vertex, slot."""
    slots += slots % 2
    width = 2 if slots % 4 else 4
    return slots // width, width


@cache
def load_row(dtype, scalar, width):
    """Device function (a, i) → the i-th ``width`` scalars of contiguous memory, on CUDA 16 bytes at once."""
    row, number = f"wp::vec_t<{width}, wp::{scalar.__name__}>", {wp.float64: "double", wp.float32: "float"}.get(scalar, "int")
    each = min(width, 16 // wp.types.type_size_in_bytes(scalar))
    parts = range(width // each)
    loads = [f"const {number}{each} q{m} = ((const {number}{each}*)a.data)[{len(parts)} * i + {m}];" for m in parts]
    values = ", ".join(f"q{m}.{axis}" for m in parts for axis in "xyzw"[:each])
    lines = ["#if defined(__CUDA_ARCH__)", *loads, f"return {row}({values});"]
    lines += ["#else", f"return ((const {row}*)a.data)[i];", "#endif", ""]

    @wp.func_native("\n".join(lines))
    def load_slots(a: wp.array(dtype=dtype), i: int) -> wp.types.vector(width, scalar): ...

    return load_slots


@cache
def row_functions(part: TermFacts, dtype):
    """Device functions for pairs: (codes, q) → codes of row q; (a, q) → numbers of row q; (rest, row, i, N) → rest states
    (P, width) of a row of vertex i; (rest states, k) → that of slot k."""
    P, (_rows, width) = wp.constant(part.term.parameters), slot_rows(sum(part.pairs))
    rest_type = wp.types.vector(part.term.parameters, dtype)
    rests_type = wp.types.matrix((part.term.parameters, width), dtype)
    row_of_rest = load_row(rest_type, dtype, width)

    @wp.func
    def rests_of(rest: wp.array(dtype=rest_type), row: int, i: int, count: int):
        rests = rests_type()
        for p in range(P):
            rests[p] = row_of_rest(rest, (row * P + p) * count + i)
        return rests

    @wp.func
    def rest_of(rests: rests_type, k: int):
        r = rest_type()
        for p in range(P):
            r[p] = rests[p, k]
        return r

    return load_row(wp.int32, wp.int32, width), load_row(dtype, dtype, width), rests_of, rest_of


class Projected(NamedTuple):
    """Facts about the elements of one term, for which a sweep is compiled.

    Attributes:
        part: Their :class:`.term_facts.TermFacts`; pairs are in rows.
        scalar, multipliers, per_step: As in :mod:`..project`.
        even: Whether all elements share one factor.
    """

    part: TermFacts
    scalar: bool
    even: bool = False
    multipliers: bool = False
    per_step: bool = False

    @property
    def term(self):
        return self.part.term


@cache
def constraints_of(of: Projected, dtype):
    """Struct of one term for a sweep: elements, the factors of their Δλ, and λ before and after."""
    lambda_type = multiplier_type(of.term, dtype, of.scalar)

    @wp.struct
    class Constraints:
        elements: elements_struct(of.part, dtype)
        factor: wp.array(dtype=dtype)
        before: wp.array(dtype=lambda_type)
        after: wp.array(dtype=lambda_type)

    return Constraints


@cache
def set_vertex_rows(dtype):
    """Kernel over vertices: rows = (x̃, 1/m), d = 0."""
    vec3, _ = types(dtype)
    vec4 = wp.types.vector(4, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def set_rows(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        # state in
        x: wp.array(dtype=vec3),
        # out
        rows: wp.array(dtype=vec4),
        d: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        rows[i] = vec4(x[i][0], x[i][1], x[i][2], inverse_mass[i])
        d[i] = vec3()

    return set_rows


@cache
def correct_elements(of: Projected, dtype):
    """Device function (constraints, i, N, rows, d, h, sweeps) → m Δx of vertex i, summed over its elements; updates λ."""
    if of.part.pairs:
        return correct_pairs(of, dtype)
    (vec3, _), vec4 = types(dtype), wp.types.vector(4, dtype)
    term, shared, padded, multipliers = of.term, of.part.shared, of.part.padded, of.multipliers
    K, measure, change = wp.constant(term.vertices), term.measure, multiplier(term, dtype, of.scalar, of.per_step, multipliers)
    y_type, corners = wp.types.matrix((term.rows, 3), dtype), wp.types.vector(term.vertices, dtype)
    rest_type, lambda_type = wp.types.vector(term.parameters, dtype), multiplier_type(term, dtype, of.scalar)
    part_of, share_of = from_corner(term, dtype), to_corner(term, dtype)
    vector, quad, whole, vertex = load(vec3), load_row(vec4, dtype, 4), load(wp.int32), load(wp.int32, 2)
    rest_of, lambda_of, number, put = load(rest_type), load(lambda_type), load_shared(dtype), store(lambda_type)

    @wp.func
    def total_of(
        constraints: constraints_of(of, dtype),
        i: int,
        count: int,
        rows: wp.array(dtype=vec4),
        d: wp.array(dtype=vec3),
        h: dtype,
        sweeps: int,
    ):
        elements = constraints.elements
        total = vec3()
        before = lambda_type(dtype(0.0))
        k = dtype(0.0)
        if wp.static(shared):
            k = number(elements.stiffness, 0)
        slot = whole(elements.offsets, i)
        left = whole(elements.offsets, i + 1) - slot
        if wp.static(padded):
            slot = i
        while left > 0:
            code = whole(elements.codes, slot)
            e = code // K
            r = rest_of(elements.rest, e)
            y = y_type()
            dy = y_type()
            w = corners()
            for corner in range(K):
                j = vertex(elements.stencil, K * e + corner)
                there = quad(rows, j)
                y += part_of(r, corner, vec3(there[0], there[1], there[2]))
                dy += part_of(r, corner, vector(d, j))
                w[corner] = there[3]
            if wp.static(not shared):
                k = number(elements.stiffness, e)
            if wp.static(multipliers):
                before = lambda_of(constraints.before, e)
            compliance = dtype(1.0) / (k * measure(r) * h * h)
            more, moves = change(y + dy, r, w, compliance, before, sweeps)
            factor = number(constraints.factor, e)
            if wp.static(multipliers):
                if code == K * e:
                    put(constraints.after, e, before + factor * more)
            total += factor * share_of(r, code - K * e, moves)
            if wp.static(padded):
                slot += count
            else:
                slot += 1
            left -= 1
        return total

    return total_of


@cache
def correct_pairs(of: Projected, dtype):
    """:func:`correct_elements` for pairs as in :func:`.gather_forces.gather_pairs`, without λ."""
    (vec3, _), vec4 = types(dtype), wp.types.vector(4, dtype)
    term, (firsts, seconds) = of.term, of.part.pairs
    (rows_each, width), firsts = map(wp.constant, slot_rows(firsts + seconds)), wp.constant(firsts)
    measure, change = term.measure, multiplier(term, dtype, of.scalar, of.per_step, False)
    shared, even, row_type = of.part.shared, of.even, wp.types.vector(int(width), dtype)
    corners, lambda_type = wp.types.vector(2, dtype), multiplier_type(term, dtype, of.scalar)
    part_of, share_of = from_corner(term, dtype), to_corner(term, dtype)
    vector, quad, number = load(vec3), load_row(vec4, dtype, 4), load_shared(dtype)
    codes_of, numbers_of, rests_of, rest_of = row_functions(of.part, dtype)

    @wp.func
    def total_of(
        constraints: constraints_of(of, dtype),
        i: int,
        count: int,
        rows: wp.array(dtype=vec4),
        d: wp.array(dtype=vec3),
        h: dtype,
        sweeps: int,
    ):
        elements = constraints.elements
        total = vec3()
        here = quad(rows, i)
        position = vec3(here[0], here[1], here[2])
        move = vector(d, i)
        k = row_type()
        if wp.static(shared):
            k = row_type(number(elements.stiffness, 0))
        factor = row_type(dtype(1.0))
        for row in range(rows_each):
            q = row * count + i
            codes = codes_of(elements.codes, q)
            rests = rests_of(elements.rest, row, i, count)
            if wp.static(not shared):
                k = numbers_of(elements.stiffness, q)
            if wp.static(not even):
                factor = numbers_of(constraints.factor, q)
            for n in range(width):
                corner = wp.where(row * width + n < firsts, 0, 1)  # constant for the compiler, and so are the weights
                j = wp.max(codes[n], 0)
                r = rest_of(rests, n)
                there = quad(rows, j)
                y = part_of(r, corner, position) + part_of(r, 1 - corner, vec3(there[0], there[1], there[2]))
                dy = part_of(r, corner, move) + part_of(r, 1 - corner, vector(d, j))
                w = corners()
                w[corner] = here[3]
                w[1 - corner] = there[3]
                compliance = dtype(1.0) / (k[n] * measure(r) * h * h)
                _more, moves = change(y + dy, r, w, compliance, lambda_type(dtype(0.0)), sweeps)
                total += wp.where(codes[n] >= 0, factor[n] * share_of(r, corner, moves), vec3())
        if wp.static(even):
            total = number(constraints.factor, 0) * total
        return total

    return total_of


@cache
def correct_terms(parts: tuple[Projected, ...], dtype):
    (vec3, _), vec4 = types(dtype), wp.types.vector(4, dtype)
    chain_type = chain_of(parts, dtype, constraints_of)
    first, others = (correct_elements(parts[0], dtype), correct_terms(parts[1:], dtype)) if parts else (None, None)

    @wp.func
    def total_of(
        chain: chain_type,
        i: int,
        count: int,
        rows: wp.array(dtype=vec4),
        d: wp.array(dtype=vec3),
        h: dtype,
        sweeps: int,
    ):
        if wp.static(first is None):
            return vec3()
        else:
            return first(chain.first, i, count, rows, d, h, sweeps) + others(chain.others, i, count, rows, d, h, sweeps)

    return total_of


@cache
def gather_corrections(parts: tuple[Projected, ...], dtype, fast: bool):
    """Kernel over vertices: d_after = d + scaleᵢ Σ Δx, scaleᵢ of :func:`.jacobi.move_vertices`, ``fast`` of
    :func:`.gather_step.gather_step`.
    """
    (vec3, _), vec4 = types(dtype), wp.types.vector(4, dtype)
    total_of = correct_terms(parts, dtype)
    vector, quad, number, put = load(vec3), load_row(vec4, dtype, 4), load_shared(dtype), store(vec3)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options={"fast_math": fast})
    def correct_vertices(
        # elements
        chain: chain_of(parts, dtype, constraints_of),
        scale: wp.array(dtype=dtype),
        # state in
        rows: wp.array(dtype=vec4),
        d: wp.array(dtype=vec3),
        # parameters
        h: dtype,
        sweeps: int,
        # out
        d_after: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        total = total_of(chain, i, d.shape[0], rows, d, h, sweeps)
        put(d_after, i, vector(d, i) + number(scale, i) * (quad(rows, i)[3] * total))  # the scale may be huge where total is 0

    return correct_vertices
