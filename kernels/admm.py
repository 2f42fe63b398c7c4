"""Factories of the kernels of ADMM: implicit Euler split into elements, with copies z of their y, and vertices."""

from functools import cache
from typing import Any

import warp as wp

from .assemble import local_coordinate, types
from .memory import load, load_shared, store
from .rotation import epsilon
from .term import HessianPolicy, Term

CLAMP = wp.constant(int(HessianPolicy.CLAMP))
# The most Newton steps of a local problem, and the most halvings of each.
STEPS = 30


@wp.func
def solve_definite(H: Any, b: Any, n: int):
    """H⁻¹ b of a symmetric positive definite H by Cholesky; n, its size, is unknown to the compiler, or it would unroll."""
    L = H
    x = b
    for j in range(n):
        s = L[j, j]
        for k in range(j):
            s -= L[j, k] * L[j, k]
        s = wp.sqrt(s)
        L[j, j] = s
        for i in range(j + 1, n):
            t = L[i, j]
            for k in range(j):
                t -= L[i, k] * L[j, k]
            L[i, j] = t / s
    for i in range(n):
        t = x[i]
        for k in range(i):
            t -= L[i, k] * x[k]
        x[i] = t / L[i, i]
    for step in range(n):
        i = n - 1 - step
        t = x[i]
        for k in range(i + 1, n):
            t -= L[k, i] * x[k]
        x[i] = t / L[i, i]
    return x


@cache
def local_minimiser(term: Term, dtype):
    """The device function (v, z, rest, r) → argmin u(z) + ½r‖v − z‖², r > 0, from a guess z.

    In closed form (p(v) + r v)/(1 + r) of a term that projects; else by Newton's method with the semi-definite Hessian of
    the term and a line search. NaN where a force or the energy is not finite, which would else pass for the minimum: of what
    overflows CUDA's fused products make infinity where others make NaN.
    """
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    flat = wp.types.vector(3 * term.rows, dtype)
    size = wp.constant(3 * term.rows)
    project, u, gradient, hessian = term.project, term.energy, term.gradient, term.hessian

    @wp.func
    def closed(v: y_type, z: y_type, rest: rest_type, r: dtype, steps: int):
        return v + (project(v, rest) - v) / (dtype(1.0) + r)

    @wp.func
    def value(v: y_type, z: y_type, rest: rest_type, r: dtype):
        return u(z, rest) + dtype(0.5) * r * wp.ddot(v - z, v - z)

    @wp.func
    def newton(v: y_type, z: y_type, rest: rest_type, r: dtype, steps: int):
        n = steps - steps + size  # unknown to the compiler, or it would unroll
        now = value(v, z, rest, r)
        other = value(v, v, rest, r)
        if not (now <= other):
            z = v
            now = other
        for _step in range(steps):
            g = gradient(z, rest) + r * (z - v)
            right = flat()
            for i in range(n):
                right[i] = -g[i // 3, i % 3]
            H = hessian(z, rest, CLAMP)
            for i in range(n):
                H[i, i] = H[i, i] + r
            p = solve_definite(H, right, n)
            slope = -wp.dot(right, p)
            if not (wp.dot(p, p) > dtype(64.0) * epsilon(r) * epsilon(r) * wp.ddot(z, z)):
                return z + (g - g) + (now - now) * z
            direction = y_type()
            for i in range(n):
                direction[i // 3, i % 3] = p[i]
            t = dtype(1.0)
            halvings = steps - steps  # 0, and no constant, so that it may change in the loop
            searching = halvings == 0
            while searching:
                after = value(v, z + t * direction, rest, r)
                # Near the minimum u resolves no decrease, and the step is right to rounding without one.
                if after <= now + dtype(1.0e-4) * t * slope + dtype(4.0) * epsilon(r) * wp.abs(now):
                    z = z + t * direction
                    now = after
                    searching = False
                else:
                    t = dtype(0.5) * t
                    halvings += 1
                    if halvings > steps:
                        return z + (now - now) * z
        return z + (now - now) * z

    return closed if project is not None else newton


@cache
def stiffness_scale(term: Term, dtype):
    """Kernel over elements: out = ‖∂²u/∂y²‖, which says how stiff an energy is to y, whatever both are measured in."""
    vec3, _ = types(dtype)
    rest_type = wp.types.vector(term.parameters, dtype)
    y_of, hessian = local_coordinate(term, dtype, False), term.hessian

    @wp.kernel(module="unique", enable_backward=False)
    def scale(
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        x: wp.array(dtype=vec3),
        # out
        out: wp.array(dtype=dtype),
    ):
        e = wp.tid()
        h = hessian(y_of(stencil, e, rest[e], x, x), rest[e], CLAMP)
        out[e] = wp.sqrt(wp.ddot(h, h))

    return scale


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
    """Kernel over elements, the local step of ADMM: z = argmin U(z) + ½‖W(y + u − z)‖², then u += y − z, with W² = r s k A.

    gap = W²(y − z), change = W²(z − z before) [N].
    """
    vec3, _ = types(dtype)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    y_of, measure, minimise = local_coordinate(term, dtype, True), term.measure, local_minimiser(term, dtype)
    rest_of, shared, take, put = load(rest_type), load_shared(dtype), load(y_type), store(y_type)

    @wp.kernel(module="unique", enable_backward=False)
    def split_elements(
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        ratio: wp.array(dtype=dtype),
        scale: wp.array(dtype=dtype),
        steps: int,
        # in and out
        z: wp.array(dtype=y_type),
        u: wp.array(dtype=y_type),
        # out
        gap: wp.array(dtype=y_type),
        change: wp.array(dtype=y_type),
    ):
        e = wp.tid()
        r = rest_of(rest, e)
        part = shared(ratio, e) * shared(scale, e)
        w2 = part * shared(stiffness, e) * measure(r)
        y = y_of(stencil, e, r, x, d)
        v = y + take(u, e)
        before = take(z, e)
        after = minimise(v, before, r, part, steps)
        put(gap, e, w2 * (y - after))
        put(change, e, w2 * (after - before))
        put(z, e, after)
        put(u, e, v - after)

    return split_elements


@cache
def scatter_splitting(term: Term, dtype):
    """Kernel over elements: adds max(1, 1/r) Gᵀgap to primal, Gᵀchange to dual, Gᵀ(gap + W²u) to force [N].

    For the CPU, in order: nothing is atomic.
    """
    vec3, _ = types(dtype)
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    weight, measure = term.weight, term.measure
    rest_of, shared, take = load(rest_type), load_shared(dtype), load(y_type)
    vector, vertex, put = load(vec3), load(wp.int32, 2), store(vec3)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter(
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        ratio: wp.array(dtype=dtype),
        scale: wp.array(dtype=dtype),
        u: wp.array(dtype=y_type),
        gap: wp.array(dtype=y_type),
        change: wp.array(dtype=y_type),
        # in and out
        primal: wp.array(dtype=vec3),
        dual: wp.array(dtype=vec3),
        force: wp.array(dtype=vec3),
    ):
        e = wp.tid()
        r = rest_of(rest, e)
        apart = take(gap, e)
        moved = take(change, e)
        part = shared(ratio, e)
        most = wp.max(part, dtype(1.0)) / part
        pull = apart + (part * shared(scale, e) * shared(stiffness, e) * measure(r)) * take(u, e)
        for i in range(K):
            w = weight(r, i)
            a = w[0] * apart[0]
            b = w[0] * moved[0]
            c = w[0] * pull[0]
            for m in range(1, M):
                a += w[m] * apart[m]
                b += w[m] * moved[m]
                c += w[m] * pull[m]
            v = vertex(stencil, K * e + i)
            put(primal, v, vector(primal, v) + most * a)
            put(dual, v, vector(dual, v) + b)
            put(force, v, vector(force, v) + c)

    return scatter


@cache
def gather_splitting(term: Term, dtype):
    """Kernel over vertices: the same sums in a fixed order, through :attr:`warpcloth.model.model.DeviceElements.incidences`."""
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
        ratio: wp.array(dtype=dtype),
        scale: wp.array(dtype=dtype),
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
            part = ratio[e]
            most = wp.max(part, dtype(1.0)) / part
            pull = gap[e] + (part * scale[e] * stiffness[e] * measure(r)) * u[e]
            for m in range(M):
                a += (most * w[m]) * gap[e][m]
                b += w[m] * change[e][m]
                c += w[m] * pull[m]
        primal[v] = primal[v] + a
        dual[v] = dual[v] + b
        force[v] = force[v] + c

    return gather
