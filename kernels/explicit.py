"""Factories of the kernels that take an explicit step in one pass over the vertices: the forces of all terms and the update.

A kernel of several terms is made of one function and one struct of arrays a term, each with those of the terms after it inside.
:func:`sweep` is for one thread a copy. It handles each element at its lowest vertex i, in the order of the vertices: the force
on i is then complete and no later element asks where it is, so that x, v move on in place. :func:`gather` is for one thread a
vertex. It sums over the incidences of its vertex in a fixed order, and writes x to another array than it reads.
"""

from functools import cache
from typing import NamedTuple

import warp as wp

from .assemble import types
from .term import Term


class Part(NamedTuple):
    """What a kernel needs to know of the elements of one term.

    Attributes:
        term: The :class:`.term.Term`.
        damped: Whether it has damping, taken at x + h v about the state x, see :class:`.term.Dissipation`.
        ordered: Whether the lowest vertex, for :func:`sweep`, is the first of all its elements.
        padded: Whether the incidences that :func:`gather` reads are rows of equal length, one slot of all vertices after another.
    """

    term: Term
    damped: bool = False
    ordered: bool = False
    padded: bool = False


@cache
def load(dtype, ndim=1):
    """The device function (a, i) → element i of contiguous memory, without the arithmetic of strides and negative indices.

    That is half the time of a sweep over springs.
    """

    @wp.func_native("return a.data[i];")
    def load_element(a: wp.array(dtype=dtype, ndim=ndim), i: int) -> dtype: ...

    return load_element


@cache
def load_shared(dtype):
    """The same of arrays of any stride, such as 0 of what all elements share."""

    @wp.func_native("return *(decltype(a.data))((char*)a.data + size_t(i) * size_t(a.strides[0]));")
    def load_strided(a: wp.array(dtype=dtype), i: int) -> dtype: ...

    return load_strided


@cache
def store(dtype):
    """The device function (a, i, value): a[i] = value, as :func:`load`."""

    @wp.func_native("a.data[i] = value;")
    def store_element(a: wp.array(dtype=dtype), i: int, value: dtype): ...

    return store_element


@cache
def local_gradient(part: Part, dtype):
    """The device function (k, β, rest, y, dy, h) → kA ∂u/∂y (M, 3), and what damping adds to it at y + dy."""
    term = part.term
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    gradient, measure = term.gradient, term.measure

    @wp.func
    def elastic(k: dtype, beta: dtype, r: rest_type, y: y_type, dy: y_type, h: dtype):
        return (k * measure(r)) * gradient(y, r)

    if not part.damped:
        return elastic
    damped = term.dissipation.term or term
    change_of, rest_of, damped_gradient, damped_measure = (
        term.dissipation.change,
        term.dissipation.rest,
        damped.gradient,
        damped.measure,
    )

    @wp.func
    def with_damping(k: dtype, beta: dtype, r: rest_type, y: y_type, dy: y_type, h: dtype):
        s = rest_of(y, change_of(y, y, r), r, dtype(1.0))
        return elastic(k, beta, r, y, dy, h) + (beta / h * damped_measure(s)) * damped_gradient(y + dy, s)

    return with_damping


@cache
def of_corner(term: Term, dtype):
    """The device functions of a corner: (rest, corner, place) → its part w ⊗ place of y, (rest, corner, g) → w·g."""
    vec3, _ = types(dtype)
    M, weight = wp.constant(term.rows), term.weight
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)

    @wp.func
    def part(rest: rest_type, corner: int, place: vec3):
        w = weight(rest, corner)
        y = y_type()
        for m in range(M):
            y[m] = w[m] * place
        return y

    @wp.func
    def force(rest: rest_type, corner: int, g: y_type):
        w = weight(rest, corner)
        total = w[0] * g[0]
        for m in range(1, M):
            total += w[m] * g[m]
        return total

    return part, force


@cache
def elements_of(part: Part, dtype):
    """The struct of what a kernel reads of one term.

    Swept: of :attr:`offsets` (N+1,) the elements of each lowest vertex. Gathered: ``codes`` K·element + corner of the incidences
    of each vertex, of K = 2 instead 2·neighbour + corner, and stiffness, damping and rest state are then those of the
    incidences. Padded, ``slots`` for each vertex, slot by slot and -1 where there are no more; else from offsets[i] on.
    """

    @wp.struct
    class Elements:
        offsets: wp.array(dtype=wp.int32)
        codes: wp.array(dtype=wp.int32)
        slots: int
        stencil: wp.array2d(dtype=wp.int32)
        stiffness: wp.array(dtype=dtype)
        damping: wp.array(dtype=dtype)
        rest: wp.array(dtype=wp.types.vector(part.term.parameters, dtype))

    return Elements


@wp.struct
class Nothing:
    """The end of a chain."""

    unused: int


@cache
def chain_of(parts: tuple[Part, ...], dtype):
    """The struct of what a kernel reads of all terms: that of the first, and the chain of the others."""
    if not parts:
        return Nothing
    first_type, others_type = elements_of(parts[0], dtype), chain_of(parts[1:], dtype)

    @wp.struct
    class Chain:
        first: first_type
        others: others_type

    return Chain


@cache
def sweep_term(part: Part, dtype):
    """The device function that adds the forces of the elements of lowest vertex i: returned of i, in ``gradient`` of others."""
    vec3, _ = types(dtype)
    term = part.term
    K, damped, ordered = wp.constant(term.vertices), part.damped, part.ordered
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    (part_of, force_of), local = of_corner(term, dtype), local_gradient(part, dtype)
    vector, whole, vertex, rest_of, number = load(vec3), load(wp.int32), load(wp.int32, 2), load(rest_type), load_shared(dtype)
    put = store(vec3)

    @wp.func
    def add(
        elements: elements_of(part, dtype),
        i: int,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        h: dtype,
        gradient: wp.array(dtype=vec3),
    ):
        total = vec3()
        place = vector(x, i)
        move = vec3()
        if wp.static(damped):
            move = h * vector(v, i)
        e = whole(elements.offsets, i)
        last = whole(elements.offsets, i + 1)
        beta = dtype(0.0)
        while e < last:
            r = rest_of(elements.rest, e)
            if wp.static(not ordered):
                j = vertex(elements.stencil, K * e)
                place = vector(x, j)
                if wp.static(damped):
                    move = h * vector(v, j)
            y = part_of(r, 0, place)
            dy = y_type()
            if wp.static(damped):
                beta = number(elements.damping, e)
                dy = part_of(r, 0, move)
            for corner in range(1, K):
                j = vertex(elements.stencil, K * e + corner)
                y += part_of(r, corner, vector(x, j))
                if wp.static(damped):
                    dy += part_of(r, corner, h * vector(v, j))
            g = local(number(elements.stiffness, e), beta, r, y, dy, h)
            if wp.static(ordered):
                total += force_of(r, 0, g)
                for corner in range(1, K):
                    j = vertex(elements.stencil, K * e + corner)
                    put(gradient, j, vector(gradient, j) + force_of(r, corner, g))
            else:
                for corner in range(K):
                    j = vertex(elements.stencil, K * e + corner)
                    if j == i:
                        total += force_of(r, corner, g)
                    else:
                        put(gradient, j, vector(gradient, j) + force_of(r, corner, g))
            e += 1
        return total

    return add


@cache
def sweep_terms(parts: tuple[Part, ...], dtype):
    """The same of all terms."""
    vec3, _ = types(dtype)
    chain_type = chain_of(parts, dtype)

    if not parts:

        @wp.func
        def add_nothing(
            chain: chain_type,
            i: int,
            x: wp.array(dtype=vec3),
            v: wp.array(dtype=vec3),
            h: dtype,
            gradient: wp.array(dtype=vec3),
        ):
            return vec3()

        return add_nothing
    first, others = sweep_term(parts[0], dtype), sweep_terms(parts[1:], dtype)

    @wp.func
    def add(
        chain: chain_type,
        i: int,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        h: dtype,
        gradient: wp.array(dtype=vec3),
    ):
        return first(chain.first, i, x, v, h, gradient) + others(chain.others, i, x, v, h, gradient)

    return add


@cache
def advance(dtype, symplectic: bool):
    """The device function (x, v, a, h) → x, v after a step: kick and drift, or drift and kick at the same state."""
    vec3, _ = types(dtype)

    @wp.func
    def kick_and_drift(x: vec3, v: vec3, a: vec3, h: dtype):
        after = v + h * a
        return x + h * after, after

    @wp.func
    def drift_and_kick(x: vec3, v: vec3, a: vec3, h: dtype):
        return x + h * v, v + h * a

    return kick_and_drift if symplectic else drift_and_kick


@cache
def sweep(parts: tuple[Part, ...], dtype, symplectic: bool, flags: str):
    """Kernel over copies, each from its first vertex to its last: v, x after a step, a = g − ∇U/m.

    ``gradient`` is what other terms have left, and 0 afterwards. ``flags`` are those of the compiler, on the CPU.
    """
    vec3, _ = types(dtype)
    add, step = sweep_terms(parts, dtype), advance(dtype, symplectic)
    vector, number, put = load(vec3), load(dtype), store(vec3)

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": flags})
    def sweep_vertices(
        chain: chain_of(parts, dtype),
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        per_copy: int,
        h: dtype,
        # in and out
        gradient: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
    ):
        copy = wp.tid()
        g = gravity[copy]
        i = copy * per_copy
        end = i + per_copy
        while i < end:
            total = add(chain, i, x, v, h, gradient) + vector(gradient, i)
            w = number(inverse_mass, i)
            if w > dtype(0.0):
                place, velocity = step(vector(x, i), vector(v, i), g - w * total, h)
                put(x, i, place)
                put(v, i, velocity)
            put(gradient, i, vec3())
            i += 1

    return sweep_vertices


@cache
def gather_term(part: Part, dtype):
    """The device function (elements, i, N, x, v, h) → ∂U/∂xᵢ + ∂D/∂xᵢ [N] of one term."""
    vec3, _ = types(dtype)
    term = part.term
    K, damped, padded, pairs = wp.constant(term.vertices), part.damped, part.padded, term.vertices == 2
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    (part_of, force_of), local = of_corner(term, dtype), local_gradient(part, dtype)
    vector, whole, vertex, rest_of, number = load(vec3), load(wp.int32), load(wp.int32, 2), load(rest_type), load_shared(dtype)

    @wp.func
    def total_of(elements: elements_of(part, dtype), i: int, count: int, x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), h: dtype):
        total = vec3()
        beta = dtype(0.0)
        place = vector(x, i)
        move = vec3()
        if wp.static(damped):
            move = h * vector(v, i)
        slot = i
        left = elements.slots
        if wp.static(not padded):
            slot = whole(elements.offsets, i)
            left = whole(elements.offsets, i + 1) - slot
        while left > 0:
            code = whole(elements.codes, slot)
            if wp.static(padded):
                if code < 0:
                    break
            y = y_type()
            dy = y_type()
            e = slot
            corner = code & 1
            if wp.static(pairs):
                j = code >> 1
                r = rest_of(elements.rest, e)
                y = part_of(r, corner, place) + part_of(r, 1 - corner, vector(x, j))
                if wp.static(damped):
                    dy = part_of(r, corner, move) + part_of(r, 1 - corner, h * vector(v, j))
            else:
                e = code // K
                corner = code - K * e
                r = rest_of(elements.rest, e)
                for c in range(K):
                    j = vertex(elements.stencil, K * e + c)
                    y += part_of(r, c, vector(x, j))
                    if wp.static(damped):
                        dy += part_of(r, c, h * vector(v, j))
            if wp.static(damped):
                beta = number(elements.damping, e)
            g = local(number(elements.stiffness, e), beta, r, y, dy, h)
            total += force_of(r, corner, g)
            if wp.static(padded):
                slot += count
            else:
                slot += 1
            left -= 1
        return total

    return total_of


@cache
def gather_terms(parts: tuple[Part, ...], dtype):
    """The same of all terms."""
    vec3, _ = types(dtype)
    chain_type = chain_of(parts, dtype)

    if not parts:

        @wp.func
        def total_of_nothing(
            chain: chain_type, i: int, count: int, x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), h: dtype
        ):
            return vec3()

        return total_of_nothing
    first, others = gather_term(parts[0], dtype), gather_terms(parts[1:], dtype)

    @wp.func
    def total_of(chain: chain_type, i: int, count: int, x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), h: dtype):
        return first(chain.first, i, count, x, v, h) + others(chain.others, i, count, x, v, h)

    return total_of


@cache
def gather(parts: tuple[Part, ...], dtype, symplectic: bool, fast: bool):
    """Kernel over vertices: x, v after a step, a = g − ∇U/m.

    Where nothing is damped v may be ``v_after``. ``fast`` takes approximate quotients and roots, of the last bit or two; NaN
    stays.
    """
    vec3, _ = types(dtype)
    total_of, step = gather_terms(parts, dtype), advance(dtype, symplectic)
    vector, number, put = load(vec3), load(dtype), store(vec3)

    @wp.kernel(module="unique", enable_backward=False, module_options={"fast_math": fast})
    def gather_vertices(
        chain: chain_of(parts, dtype),
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        per_copy: int,
        h: dtype,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        # out
        x_after: wp.array(dtype=vec3),
        v_after: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        w = number(inverse_mass, i)
        place = vector(x, i)
        velocity = vector(v, i)
        if w > dtype(0.0):
            total = total_of(chain, i, inverse_mass.shape[0], x, v, h)
            place, velocity = step(place, velocity, gravity[i // per_copy] - w * total, h)
        put(x_after, i, place)
        put(v_after, i, velocity)

    return gather_vertices
