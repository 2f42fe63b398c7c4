"""Factories of the kernels that turn a term into sums over vertices and copies: energy, gradient, Hessian blocks.

With ``project`` the only kernels that know stencils; none of them knows a material. Each kernel is compiled only when a
solver asks for it. Signatures: elements, state in, parameters, out.
"""

from functools import cache

import warp as wp

from .memory import load, load_shared, store
from .term import Term


@cache
def types(dtype):
    """The vector and 3×3 matrix types of a scalar type: (vec3, mat33)."""
    return wp.types.vector(3, dtype), wp.types.matrix((3, 3), dtype)


@cache
def local_coordinate(term: Term, dtype, corrected: bool):
    """The device function (stencil, element, rest, x, d) → y = Σᵢ wᵢ ⊗ xᵢ of a term, or with ``corrected`` Σᵢ wᵢ ⊗ (xᵢ + dᵢ).

    In float32 the sum x + d would lose the digits of d to the size of x; the difference of neighbouring x is nearly exact.
    """
    vec3, _ = types(dtype)
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    weight, vector, vertex = term.weight, load(vec3), load(wp.int32, 2)

    @wp.func
    def part_of(rest: rest_type, corner: int, place: vec3):
        w = weight(rest, corner)
        y = y_type()
        for m in range(M):
            y[m] = w[m] * place
        return y

    @wp.func
    def y_of(stencil: wp.array2d(dtype=wp.int32), e: int, rest: rest_type, x: wp.array(dtype=vec3), d: wp.array(dtype=vec3)):
        y = part_of(rest, 0, vector(x, vertex(stencil, K * e)))
        for i in range(1, K):
            y += part_of(rest, i, vector(x, vertex(stencil, K * e + i)))
        if wp.static(corrected):
            for i in range(K):
                y += part_of(rest, i, vector(d, vertex(stencil, K * e + i)))
        return y

    return y_of


@cache
def energy(term: Term, dtype, corrected: bool = False):
    """Kernel over elements: out[e] = kₑ Aₑ u(yₑ) [J], in double precision for the sum that follows."""
    vec3, _ = types(dtype)
    rest_type = wp.types.vector(term.parameters, dtype)
    y_of, u, measure = local_coordinate(term, dtype, corrected), term.energy, term.measure
    rest_of, number = load(rest_type), load_shared(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def energy_of_elements(
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        out: wp.array(dtype=wp.float64),
    ):
        e = wp.tid()
        r = rest_of(rest, e)
        out[e] = wp.float64(number(stiffness, e) * measure(r) * u(y_of(stencil, e, r, x, d), r))

    return energy_of_elements


@cache
def scatter_gradient(term: Term, dtype, corrected: bool = False):
    """Kernel over elements: adds kₑ Aₑ wᵢ·∂u/∂y [N] to out[vertex i]. For the CPU, in order: nothing is atomic."""
    vec3, _ = types(dtype)
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type = wp.types.vector(term.parameters, dtype)
    y_of, weight, gradient, measure = local_coordinate(term, dtype, corrected), term.weight, term.gradient, term.measure
    vector, vertex, rest_of, number, put = load(vec3), load(wp.int32, 2), load(rest_type), load_shared(dtype), store(vec3)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter(
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        out: wp.array(dtype=vec3),
    ):
        e = wp.tid()
        r = rest_of(rest, e)
        g = (number(stiffness, e) * measure(r)) * gradient(y_of(stencil, e, r, x, d), r)
        for i in range(K):
            w = weight(r, i)
            force = w[0] * g[0]
            for m in range(1, M):
                force += w[m] * g[m]
            v = vertex(stencil, K * e + i)
            put(out, v, vector(out, v) + force)

    return scatter


@cache
def hessian_blocks(term: Term, dtype, corrected: bool = False):
    """Kernel over elements: out[e, K·i + j] = kₑ Aₑ ∂²u/∂xᵢ∂xⱼ [N/m], under the policy of the element's copy."""
    vec3, mat33 = types(dtype)
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type = wp.types.vector(term.parameters, dtype)
    y_of, weight, hessian, measure = local_coordinate(term, dtype, corrected), term.weight, term.hessian, term.measure

    @wp.kernel(module="unique", enable_backward=False)
    def blocks_of_elements(
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        elements_per_copy: int,
        policy: wp.array(dtype=wp.int32),
        out: wp.array2d(dtype=mat33),
    ):
        e = wp.tid()
        r = rest[e]
        corners = out.shape[1] // K  # K, but unknown to the compiler: unrolling all of this takes it seconds
        h = (stiffness[e] * measure(r)) * hessian(y_of(stencil, e, r, x, d), r, policy[e // elements_per_copy])
        for i in range(corners):
            wi = weight(r, i)
            for j in range(corners):
                wj = weight(r, j)
                block = mat33()
                for m in range(M):
                    for n in range(M):
                        w = wi[m] * wj[n]
                        for row in range(3):
                            for column in range(3):
                                block[row, column] = block[row, column] + w * h[3 * m + row, 3 * n + column]
                out[e, K * i + j] = block

    return blocks_of_elements


@cache
def constant_blocks(term: Term, dtype):
    """Kernel over elements: out[e, K·i + j] = kₑ Aₑ wᵢ·wⱼ [N/m], the matrix kAGᵀG of the weights, in double precision."""
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type = wp.types.vector(term.parameters, dtype)
    weight, measure = term.weight, term.measure

    @wp.kernel(module="unique", enable_backward=False)
    def blocks_of_weights(
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        out: wp.array2d(dtype=wp.float64),
    ):
        e = wp.tid()
        r = rest[e]
        scale = wp.float64(stiffness[e]) * wp.float64(measure(r))
        for i in range(K):
            wi = weight(r, i)
            for j in range(K):
                wj = weight(r, j)
                total = wp.float64(0.0)
                for m in range(M):
                    total += wp.float64(wi[m]) * wp.float64(wj[m])
                out[e, K * i + j] = scale * total

    return blocks_of_weights
