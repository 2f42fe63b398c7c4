"""Factories of the kernels of ADMM: implicit Euler, split into elements, each with its own copy z of y, and vertices."""

from functools import cache
from typing import Any

import warp as wp

from .contact.clear_elements import is_clear
from .local import local_coordinate
from .memory import load, load_shared, store
from .rotation import epsilon
from .term import HessianPolicy, Term
from .transpose import to_corner
from .vectors import types

CLAMP = wp.constant(int(HessianPolicy.CLAMP))
# Maximum number of Newton steps of a local problem, and of halvings of each step.
STEPS = 30


@wp.func
def solve_definite(H: Any, b: Any, n: int):
    """H⁻¹ b for a symmetric positive definite H, by Cholesky; n is an argument so that loops are not unrolled."""
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
    """Device function (v, z, rest, r, steps) → argmin u(z) + ½r‖v − z‖², r > 0, from the initial guess z.

    A term with a prox uses it. A term with a projection p uses (p(v) + r v)/(1 + r). Other terms use Newton's method with their
    semi-definite Hessian and a line search. The result is NaN if a force or the energy is not finite: CUDA's fused products
    overflow to infinity where others give NaN, and infinity could pass for a minimum.
    """
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    flat = wp.types.vector(3 * term.rows, dtype)
    size = wp.constant(3 * term.rows)
    project, prox, prox_from = term.project, term.prox, term.prox_from
    u, gradient, hessian = term.energy, term.gradient, term.hessian

    @wp.func
    def closed(v: y_type, z: y_type, rest: rest_type, r: dtype, steps: int):
        return v + (project(v, rest) - v) / (dtype(1.0) + r)

    @wp.func
    def by_prox(v: y_type, z: y_type, rest: rest_type, r: dtype, steps: int):
        if wp.static(prox_from is None):
            p = prox(v, rest, dtype(1.0) / r)
        else:
            p = prox_from(z, v, rest, dtype(1.0) / r)
        return p

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
                # Near the minimum rounding hides the decrease of u, so it may rise by some roundings.
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

    if prox is not None:
        return by_prox
    return closed if project is not None else newton


@cache
def stiffness_scale(term: Term, dtype):
    """Kernel over elements: out = ‖∂²u/∂y²‖, by which W² is scaled to the energy and to the unit of y."""
    vec3, _ = types(dtype)
    rest_type = wp.types.vector(term.parameters, dtype)
    y_of, hessian = local_coordinate(term, dtype, False), term.hessian

    @wp.kernel(module="unique", enable_backward=False)
    def scale(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        # state in
        x: wp.array(dtype=vec3),
        # out
        out: wp.array(dtype=dtype),
    ):
        e = wp.tid()
        h = hessian(y_of(stencil, e, rest[e], x, x), rest[e], CLAMP)
        out[e] = wp.sqrt(wp.ddot(h, h))

    return scale


@cache
def admm_elements(term: Term, dtype):
    """Struct of the elements of a term: ratio r, scale s, W² = r s k A, z, u, gap = W²(y − z), and the change of W²z [N].

    ``clear`` is that of :mod:`.contact.clear_elements`, or empty.
    """
    y_type = wp.types.matrix((term.rows, 3), dtype)

    @wp.struct
    class AdmmElements:
        stiffness: wp.array(dtype=dtype)
        ratio: wp.array(dtype=dtype)
        scale: wp.array(dtype=dtype)
        z: wp.array(dtype=y_type)
        u: wp.array(dtype=y_type)
        gap: wp.array(dtype=y_type)
        change: wp.array(dtype=y_type)
        clear: wp.array(dtype=dtype)

    return AdmmElements


@cache
def start_admm(term: Term, dtype):
    """Kernel over elements: z = y at x̃, u = 0."""
    vec3, _ = types(dtype)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    y_of = local_coordinate(term, dtype, False)

    @wp.kernel(module="unique", enable_backward=False)
    def start(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        # state in
        x: wp.array(dtype=vec3),
        # out
        of: admm_elements(term, dtype),
    ):
        e = wp.tid()
        of.z[e] = y_of(stencil, e, rest[e], x, x)
        of.u[e] = y_type()
        of.gap[e] = y_type()
        of.change[e] = y_type()

    return start


@cache
def split(term: Term, dtype):
    """Kernel over elements, the local step of ADMM: z = argmin U(z) + ½‖W(y + u − z)‖², u += y − z; writes gap and change.

    An element whose vertex is still within its ``clear`` is skipped: its u, gap and change are 0.
    """
    vec3, _ = types(dtype)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    y_of, measure, minimise = local_coordinate(term, dtype, True), term.measure, local_minimiser(term, dtype)
    rest_of, shared, take, put = load(rest_type), load_shared(dtype), load(y_type), store(y_type)

    @wp.kernel(module="unique", enable_backward=False)
    def split_elements(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        steps: int,
        # in and out
        of: admm_elements(term, dtype),
    ):
        e = wp.tid()
        if wp.static(term.clearance is not None):
            if of.clear.shape[0] > 0:
                if is_clear(of.clear[e], d[stencil[e, 0]]):
                    return
                of.clear[e] = dtype(0.0)
        r = rest_of(rest, e)
        part = shared(of.ratio, e) * shared(of.scale, e)
        w2 = part * shared(of.stiffness, e) * measure(r)
        y = y_of(stencil, e, r, x, d)
        v = y + take(of.u, e)
        before = take(of.z, e)
        after = minimise(v, before, r, part, steps)
        put(of.gap, e, w2 * (y - after))
        put(of.change, e, w2 * (after - before))
        put(of.z, e, after)
        put(of.u, e, v - after)

    return split_elements


@cache
def admm_forces(term: Term, dtype):
    """Device functions (elements, e) → max(1, 1/r) and (elements, e, rest) → gap + W²u, see :func:`scatter_admm`."""
    rest_type = wp.types.vector(term.parameters, dtype)
    measure, shared, take = term.measure, load_shared(dtype), load(wp.types.matrix((term.rows, 3), dtype))

    @wp.func
    def weight_of(of: admm_elements(term, dtype), e: int):
        part = shared(of.ratio, e)
        return wp.max(part, dtype(1.0)) / part

    @wp.func
    def pull_of(of: admm_elements(term, dtype), e: int, r: rest_type):
        w2 = shared(of.ratio, e) * shared(of.scale, e) * shared(of.stiffness, e) * measure(r)
        return take(of.gap, e) + w2 * take(of.u, e)

    return weight_of, pull_of


@cache
def scatter_admm(term: Term, dtype):
    """Kernel over elements: adds max(1, 1/r) Gᵀgap to primal, Gᵀchange to dual, Gᵀ(gap + W²u) to force [N].

    For the CPU, where one thread takes the elements in order: no addition is atomic.
    """
    vec3, _ = types(dtype)
    K = wp.constant(term.vertices)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    (weight_of, pull_of), share_of = admm_forces(term, dtype), to_corner(term, dtype)
    rest_of, take, vector, vertex, put = load(rest_type), load(y_type), load(vec3), load(wp.int32, 2), store(vec3)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        # state in
        of: admm_elements(term, dtype),
        # in and out
        primal: wp.array(dtype=vec3),
        dual: wp.array(dtype=vec3),
        force: wp.array(dtype=vec3),
    ):
        e = wp.tid()
        if wp.static(term.clearance is not None):
            if of.clear.shape[0] > 0 and of.clear[e] > dtype(0.0):
                return
        r = rest_of(rest, e)
        gap = take(of.gap, e)
        change = take(of.change, e)
        most = weight_of(of, e)
        pull = pull_of(of, e, r)
        for i in range(K):
            v = vertex(stencil, K * e + i)
            put(primal, v, vector(primal, v) + most * share_of(r, i, gap))
            put(dual, v, vector(dual, v) + share_of(r, i, change))
            put(force, v, vector(force, v) + share_of(r, i, pull))

    return scatter


@cache
def gather_admm(term: Term, dtype):
    """Kernel over vertices: the sums of :func:`scatter_admm` in a fixed order, see :func:`.transpose.gather`."""
    vec3, _ = types(dtype)
    K, rest_type = wp.constant(term.vertices), wp.types.vector(term.parameters, dtype)
    (weight_of, pull_of), share_of = admm_forces(term, dtype), to_corner(term, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def gather(
        # elements
        offsets: wp.array(dtype=wp.int32),
        codes: wp.array(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        # state in
        of: admm_elements(term, dtype),
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
            e = codes[n] // K
            i = codes[n] - e * K
            r = rest[e]
            a += weight_of(of, e) * share_of(r, i, of.gap[e])
            b += share_of(r, i, of.change[e])
            c += share_of(r, i, pull_of(of, e, r))
        primal[v] = primal[v] + a
        dual[v] = dual[v] + b
        force[v] = force[v] + c

    return gather
