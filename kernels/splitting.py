"""Factories of the kernels of ADMM: implicit Euler split into elements, with copies z of their y, and vertices."""

from functools import cache

import warp as wp

from .assemble import local_coordinate, types
from .term import Term


@cache
def start_splitting(term: Term, dtype):
    """Kernel over elements: z = y at x̃, u = 0."""
    vec3, _ = types(dtype)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    y_of = local_coordinate(term, dtype, False)

    @wp.kernel(module="unique", enable_backward=False)
    def start(
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        x: wp.array(dtype=vec3),
        # out
        z: wp.array(dtype=y_type),
        u: wp.array(dtype=y_type),
    ):
        e = wp.tid()
        z[e] = y_of(stencil, e, rest[e], x, x)
        u[e] = y_type()

    return start


@cache
def split(term: Term, dtype):
    """Kernel over elements, the local step of ADMM: z = argmin U(z) + ½‖W(y + u − z)‖², then u += y − z, with W² = r k A.

    For u(y) = ½‖y − p(y)‖² that is z = (p(v) + r v)/(1 + r), v = y + u. gap = W²(y − z), change = W²(z − z before) [N].
    """
    vec3, _ = types(dtype)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    y_of, measure, project = local_coordinate(term, dtype, True), term.measure, term.project

    @wp.kernel(module="unique", enable_backward=False)
    def split_elements(
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        ratio: dtype,
        # in and out
        z: wp.array(dtype=y_type),
        u: wp.array(dtype=y_type),
        # out
        gap: wp.array(dtype=y_type),
        change: wp.array(dtype=y_type),
    ):
        e = wp.tid()
        r = rest[e]
        w2 = ratio * stiffness[e] * measure(r)
        y = y_of(stencil, e, r, x, d)
        v = y + u[e]
        after = v + (project(v, r) - v) / (dtype(1.0) + ratio)
        gap[e] = w2 * (y - after)
        change[e] = w2 * (after - z[e])
        z[e] = after
        u[e] = v - after

    return split_elements


@cache
def scatter_splitting(term: Term, dtype):
    """Kernel over elements: adds Gᵀgap to primal, Gᵀchange to dual, Gᵀ(gap + W²u) to force [N]. For the CPU."""
    vec3, _ = types(dtype)
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    weight, measure = term.weight, term.measure

    @wp.kernel(module="unique", enable_backward=False)
    def scatter(
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        ratio: dtype,
        u: wp.array(dtype=y_type),
        gap: wp.array(dtype=y_type),
        change: wp.array(dtype=y_type),
        # in and out
        primal: wp.array(dtype=vec3),
        dual: wp.array(dtype=vec3),
        force: wp.array(dtype=vec3),
    ):
        e = wp.tid()
        r = rest[e]
        pull = gap[e] + (ratio * stiffness[e] * measure(r)) * u[e]
        for i in range(K):
            w = weight(r, i)
            a = vec3()
            b = vec3()
            c = vec3()
            for m in range(M):
                a += w[m] * gap[e][m]
                b += w[m] * change[e][m]
                c += w[m] * pull[m]
            wp.atomic_add(primal, stencil[e, i], a)
            wp.atomic_add(dual, stencil[e, i], b)
            wp.atomic_add(force, stencil[e, i], c)

    return scatter


@cache
def gather_splitting(term: Term, dtype):
    """Kernel over vertices: the same sums in a fixed order, through the incidences of :func:`assemble.gather_gradient`."""
    vec3, _ = types(dtype)
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    weight, measure = term.weight, term.measure

    @wp.kernel(module="unique", enable_backward=False)
    def gather(
        offsets: wp.array(dtype=wp.int32),
        incidences: wp.array(dtype=wp.int32),
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        ratio: dtype,
        u: wp.array(dtype=y_type),
        gap: wp.array(dtype=y_type),
        change: wp.array(dtype=y_type),
        # in and out
        primal: wp.array(dtype=vec3),
        dual: wp.array(dtype=vec3),
        force: wp.array(dtype=vec3),
    ):
        v = wp.tid()
        a = vec3()
        b = vec3()
        c = vec3()
        for n in range(offsets[v], offsets[v + 1]):
            e = incidences[n] // K
            r = rest[e]
            w = weight(r, incidences[n] - e * K)
            pull = gap[e] + (ratio * stiffness[e] * measure(r)) * u[e]
            for m in range(M):
                a += w[m] * gap[e][m]
                b += w[m] * change[e][m]
                c += w[m] * pull[m]
        primal[v] = primal[v] + a
        dual[v] = dual[v] + b
        force[v] = force[v] + c

    return gather
