"""Factories of the kernels that take an explicit step in one pass over the vertices: the forces of all terms and the update.

:func:`sweep` is for one thread a copy. It handles each element at its lowest vertex i, in the order of the vertices: the force
on i is then complete and no later element asks where it is, so that x, v move on in place. :func:`gather` is for one thread a
vertex, and writes x to another array than it reads.
"""

from functools import cache

import warp as wp

from .assemble import types
from .elements import Part, chain_of, elements_of, load, load_shared, local_gradient, of_corner, store
from .gather import gather_terms


@cache
def sweep_term(part: Part, dtype):
    """The device function that adds the forces of the elements of lowest vertex i: returned of i, in ``gradient`` of others."""
    vec3, _ = types(dtype)
    term = part.term
    K, damped, shared, ordered = wp.constant(term.vertices), part.damped, part.shared, part.ordered
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
        k = dtype(0.0)
        if wp.static(shared):
            k = number(elements.stiffness, 0)
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
            if wp.static(not shared):
                k = number(elements.stiffness, e)
            g = local(k, beta, r, y, dy, h)
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
        total = total_of(chain, i, inverse_mass.shape[0], x, v, h)  # of pins too: what follows need not wait for w
        w = number(inverse_mass, i)
        place = vector(x, i)
        velocity = vector(v, i)
        if w > dtype(0.0):
            place, velocity = step(place, velocity, gravity[i // per_copy] - w * total, h)
        put(x_after, i, place)
        put(v_after, i, velocity)

    return gather_vertices
