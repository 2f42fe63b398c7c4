"""Factories of what sums over the elements of a vertex in a fixed order, of all terms in one pass: deterministic on a GPU."""

from functools import cache

import warp as wp

from .assemble import types
from .elements import Part, chain_of, elements_of, load, load_shared, local_gradient, of_corner, store


@cache
def gather_term(part: Part, dtype, corrected: bool = False):
    """The device function (elements, i, N, x, v, h) → ∂U/∂xᵢ + ∂D/∂xᵢ [N] of one term; with ``corrected`` ∂U/∂xᵢ at x + h v."""
    if part.pairs:
        return gather_pairs(part, dtype, corrected)
    vec3, _ = types(dtype)
    term = part.term
    K, damped, shared, padded = wp.constant(term.vertices), part.damped, part.shared, part.padded
    moved = damped or corrected
    y_type = wp.types.matrix((term.rows, 3), dtype)
    (part_of, force_of), local = of_corner(term, dtype), local_gradient(part, dtype, corrected)
    vector, whole, vertex, number = load(vec3), load(wp.int32), load(wp.int32, 2), load_shared(dtype)
    rest_of = load(wp.types.vector(term.parameters, dtype))

    @wp.func
    def total_of(
        elements: elements_of(part, dtype), i: int, count: int, x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), h: dtype
    ):
        total = vec3()
        beta = dtype(0.0)
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
            for corner in range(K):
                j = vertex(elements.stencil, K * e + corner)
                y += part_of(r, corner, vector(x, j))
                if wp.static(moved):
                    dy += part_of(r, corner, h * vector(v, j))
            if wp.static(damped):
                beta = number(elements.damping, e)
            if wp.static(not shared):
                k = number(elements.stiffness, e)
            total += force_of(r, code - K * e, local(k, beta, r, y, dy, h))
            if wp.static(padded):
                slot += count
            else:
                slot += 1
            left -= 1
        return total

    return total_of


@cache
def gather_pairs(part: Part, dtype, corrected: bool):
    """The same of pairs, without a branch: what an empty slot gives, by whatever vertex, is left out of the sum.

    So all slots are read at once; one after another they take 1.2 times as long (H200, 64² vertices).
    """
    vec3, _ = types(dtype)
    term = part.term
    (firsts, seconds), damped, shared = part.pairs, part.damped, part.shared
    firsts, slots = wp.constant(firsts), wp.constant(firsts + seconds)
    moved = damped or corrected
    y_type = wp.types.matrix((term.rows, 3), dtype)
    (part_of, force_of), local = of_corner(term, dtype), local_gradient(part, dtype, corrected)
    vector, whole, number = load(vec3), load(wp.int32), load_shared(dtype)
    rest_of = load(wp.types.vector(term.parameters, dtype))

    @wp.func
    def total_of(
        elements: elements_of(part, dtype), i: int, count: int, x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), h: dtype
    ):
        total = vec3()
        beta = dtype(0.0)
        place = vector(x, i)
        move = vec3()
        if wp.static(moved):
            move = h * vector(v, i)
        k = dtype(0.0)
        if wp.static(shared):
            k = number(elements.stiffness, 0)
        for s in range(slots):
            corner = wp.where(s < firsts, 0, 1)  # known to the compiler, and so are the weights
            slot = s * count + i
            code = whole(elements.codes, slot)
            j = wp.max(code, 0)
            r = rest_of(elements.rest, slot)
            y = part_of(r, corner, place) + part_of(r, 1 - corner, vector(x, j))
            dy = y_type()
            if wp.static(moved):
                dy = part_of(r, corner, move) + part_of(r, 1 - corner, h * vector(v, j))
            if wp.static(damped):
                beta = number(elements.damping, slot)
            if wp.static(not shared):
                k = number(elements.stiffness, slot)
            force = force_of(r, corner, local(k, beta, r, y, dy, h))
            total += wp.where(code >= 0, force, vec3())
        return total

    return total_of


@cache
def gather_terms(parts: tuple[Part, ...], dtype, corrected: bool = False):
    """The same of all terms."""
    vec3, _ = types(dtype)
    chain_type = chain_of(parts, dtype)

    if not parts:

        @wp.func
        def total_of_nothing(chain: chain_type, i: int, count: int, x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), h: dtype):
            return vec3()

        return total_of_nothing
    first, others = gather_term(parts[0], dtype, corrected), gather_terms(parts[1:], dtype, corrected)

    @wp.func
    def total_of(chain: chain_type, i: int, count: int, x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), h: dtype):
        return first(chain.first, i, count, x, v, h) + others(chain.others, i, count, x, v, h)

    return total_of


@cache
def gather_gradient(parts: tuple[Part, ...], dtype, corrected: bool = False):
    """Kernel over vertices: adds ∂U/∂x [N] of all terms, at x or with ``corrected`` at x + d, to out."""
    vec3, _ = types(dtype)
    total_of, vector, put = gather_terms(parts, dtype, corrected), load(vec3), store(vec3)

    @wp.kernel(module="unique", enable_backward=False)
    def gather(
        chain: chain_of(parts, dtype),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        put(out, i, vector(out, i) + total_of(chain, i, x.shape[0], x, d, dtype(1.0)))

    return gather
