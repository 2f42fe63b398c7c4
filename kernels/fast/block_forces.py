"""Functions that add the forces of a block of elements in stages, as loops that vectorise.

Local coordinates are gathered into scratch, forces are computed there, then scattered. In a piece of a block that is a run, the
vertices of each element are one higher than the last; others read stencils.
"""

from functools import cache

import warp as wp

from ..local import from_corner
from ..memory import load, load_shared, store
from ..transpose import to_corner
from ..vectors import types
from .term_facts import TermFacts, chain_of, elements_struct, local_gradient


@cache
def gather_piece(part: TermFacts, dtype, corrected: bool = False):
    """Device function (elements, first, count, base, x, v, h, y, dy) that sets y of a piece, and dy = h Σ wᵢ ⊗ vᵢ if the term
    is damped or ``corrected``.

    A positive ``count`` is a run from ``first`` on, a negative one −count other elements; scratch begins with the element
    ``base``.
    """
    vec3, _ = types(dtype)
    term = part.term
    K, moved = wp.constant(term.vertices), part.damped or corrected
    y_type = wp.types.matrix((term.rows, 3), dtype)
    part_of = from_corner(term, dtype)
    vector, vertex, rest_of = load(vec3), load(wp.int32, 2), load(wp.types.vector(term.parameters, dtype))
    put = store(y_type, dtype)

    @wp.func
    def gather(
        elements: elements_struct(part, dtype),
        first: int,
        count: int,
        base: int,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        h: dtype,
        y: wp.array(dtype=dtype),
        dy: wp.array(dtype=dtype),
    ):
        e = first
        if count > 0:
            ahead = wp.vector(length=K, dtype=wp.int32)
            for corner in range(K):
                ahead[corner] = vertex(elements.stencil, K * first + corner) - first
            while e < first + count:
                r = rest_of(elements.rest, e)
                total = part_of(r, 0, vector(x, e + ahead[0]))
                for corner in range(1, K):
                    total += part_of(r, corner, vector(x, e + ahead[corner]))
                put(y, e - base, total)
                if wp.static(moved):
                    total = part_of(r, 0, h * vector(v, e + ahead[0]))
                    for corner in range(1, K):
                        total += part_of(r, corner, h * vector(v, e + ahead[corner]))
                    put(dy, e - base, total)
                e += 1
        while e < first - count:
            r = rest_of(elements.rest, e)
            total = part_of(r, 0, vector(x, vertex(elements.stencil, K * e)))
            for corner in range(1, K):
                total += part_of(r, corner, vector(x, vertex(elements.stencil, K * e + corner)))
            put(y, e - base, total)
            if wp.static(moved):
                total = part_of(r, 0, h * vector(v, vertex(elements.stencil, K * e)))
                for corner in range(1, K):
                    total += part_of(r, corner, h * vector(v, vertex(elements.stencil, K * e + corner)))
                put(dy, e - base, total)
            e += 1

    return gather


@cache
def compute_forces(part: TermFacts, dtype, corrected: bool = False):
    """Device function (elements, first, last, h, y, dy) that replaces y of elements first to last − 1 by kA ∂u/∂y plus damping.

    With ``corrected``, forces are those at y + dy.
    """
    term = part.term
    damped, shared = part.damped, part.shared
    y_type, rest_type = wp.types.matrix((term.rows, 3), dtype), wp.types.vector(term.parameters, dtype)
    local, rest_of, number = local_gradient(part, dtype, corrected), load(rest_type), load(dtype)
    shared_number, take, put = load_shared(dtype), load(y_type, stored=dtype), store(y_type, dtype)

    @wp.func
    def compute(
        elements: elements_struct(part, dtype),
        first: int,
        last: int,
        h: dtype,
        y: wp.array(dtype=dtype),
        dy: wp.array(dtype=dtype),
    ):
        k = dtype(0.0)
        if wp.static(shared):
            k = shared_number(elements.stiffness, 0)
        beta = dtype(0.0)
        move = y_type()
        e = first
        while e < last:
            if wp.static(not shared):
                k = number(elements.stiffness, e)
            if wp.static(damped):
                beta = shared_number(elements.damping, e)
            if wp.static(damped or corrected):
                move = take(dy, e - first)
            put(y, e - first, local(k, beta, rest_of(elements.rest, e), take(y, e - first), move, h))
            e += 1

    return compute


@cache
def scatter_piece(part: TermFacts, dtype):
    """Device function (elements, first, count, base, forces, out): out += wᵢ·force for a piece."""
    vec3, _ = types(dtype)
    term = part.term
    K = wp.constant(term.vertices)
    y_type = wp.types.matrix((term.rows, 3), dtype)
    share_of = to_corner(term, dtype)
    vector, vertex, rest_of = load(vec3), load(wp.int32, 2), load(wp.types.vector(term.parameters, dtype))
    take, put = load(y_type, stored=dtype), store(vec3)

    @wp.func
    def scatter(
        elements: elements_struct(part, dtype),
        first: int,
        count: int,
        base: int,
        forces: wp.array(dtype=dtype),
        out: wp.array(dtype=vec3),
    ):
        if count > 0:
            for corner in range(K):
                ahead = vertex(elements.stencil, K * first + corner) - first
                e = first
                while e < first + count:
                    force = share_of(rest_of(elements.rest, e), corner, take(forces, e - base))
                    put(out, e + ahead, vector(out, e + ahead) + force)
                    e += 1
        other = first
        while other < first - count:
            r = rest_of(elements.rest, other)
            g = take(forces, other - base)
            for corner in range(K):
                i = vertex(elements.stencil, K * other + corner)
                put(out, i, vector(out, i) + share_of(r, corner, g))
            other += 1

    return scatter


@cache
def add_block(part: TermFacts, dtype, corrected: bool = False):
    """Device function (elements, block, x, v, h, y, dy, out): out += ∂U/∂x + ∂D/∂x [N] of the elements of a block.

    With ``corrected``, ∂U/∂x is that at x + h v.
    """
    vec3, _ = types(dtype)
    gather, compute = gather_piece(part, dtype, corrected), compute_forces(part, dtype, corrected)
    scatter = scatter_piece(part, dtype)
    whole = load(wp.int32)

    @wp.func
    def add(
        elements: elements_struct(part, dtype),
        block: int,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        h: dtype,
        y: wp.array(dtype=dtype),
        dy: wp.array(dtype=dtype),
        out: wp.array(dtype=vec3),
    ):
        start = whole(elements.offsets, block)
        end = whole(elements.offsets, block + 1)
        if start < end:
            base = whole(elements.codes, 2 * start)
            last = base
            piece = start
            while piece < end:
                first = whole(elements.codes, 2 * piece)
                count = whole(elements.codes, 2 * piece + 1)
                gather(elements, first, count, base, x, v, h, y, dy)
                last = first + wp.abs(count)
                piece += 1
            compute(elements, base, last, h, y, dy)
            piece = start
            while piece < end:
                scatter(elements, whole(elements.codes, 2 * piece), whole(elements.codes, 2 * piece + 1), base, y, out)
                piece += 1

    return add


@cache
def add_block_forces(parts: tuple[TermFacts, ...], dtype, corrected: bool = False):
    vec3, _ = types(dtype)
    chain_type = chain_of(parts, dtype)
    key = dtype, corrected
    first, others = (add_block(parts[0], *key), add_block_forces(parts[1:], *key)) if parts else (None, None)

    @wp.func
    def add(
        chain: chain_type,
        block: int,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        h: dtype,
        y: wp.array(dtype=dtype),
        dy: wp.array(dtype=dtype),
        out: wp.array(dtype=vec3),
    ):
        if wp.static(first is not None):
            first(chain.first, block, x, v, h, y, dy, out)
            others(chain.others, block, x, v, h, y, dy, out)

    return add
