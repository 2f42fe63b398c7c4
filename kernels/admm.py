"""Kernels of ADMM: implicit Euler, split into vertices and elements, which have a copy z of y."""

from functools import cache

import warp as wp

from .assemble import is_clear
from .local import local_coordinate
from .local_minimiser import local_minimiser
from .memory import load, load_shared, store
from .term import Term
from .transpose import to_corner
from .vectors import types


@cache
def stiffness_scale(term: Term, dtype):
    """Kernel over elements: out = ‖∂²u/∂y²‖, the scale of W²."""
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
        h = hessian(y_of(stencil, e, rest[e], x, x), rest[e], dtype(0.0))
        out[e] = wp.sqrt(wp.ddot(h, h))

    return scale


@cache
def admm_elements(term: Term, dtype):
    """Struct of the elements of a term: ratio r, scale s, W² = r s k A, z, u, gap = W²(y − z), change of W²z [N], and ``clear``
    or an empty array.
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
    """Kernel over elements: z = argmin U(z) + ½‖W(y + u − z)‖², u += y − z; writes gap and change.

    Elements whose vertex is within ``clear`` have u, gap and change 0.
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
    """Device functions (elements, e) → max(1, 1/r) and (elements, e, rest) → gap + W²u."""
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
    """Kernel over elements: adds max(1, 1/r) Gᵀgap to primal, Gᵀchange to dual, Gᵀ(gap + W²u) to force [N]."""
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
    """Kernel over vertices: the sums of :func:`scatter_admm` in a fixed order."""
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
