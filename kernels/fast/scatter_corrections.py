"""A Jacobi sweep in one thread of the CPU that adds each correction at once.

The key is (term, dtype, scalar, multipliers, per_step), as of :mod:`..project`.
"""

from functools import cache

import warp as wp

from ..assemble import is_clear
from ..memory import load, load_shared, store
from ..project import element_change, multiplier_type
from ..term import Term
from ..transpose import to_corner
from ..vectors import types


@cache
def add_correction(term: Term, dtype, scalar: bool, multipliers: bool, per_step: bool):
    """Device function that adds factorₑ Δxᵢ [m] of an element to out, and factorₑ Δλ to λ."""
    vec3, _ = types(dtype)
    K = wp.constant(term.vertices)
    rest_type, lambda_type = wp.types.vector(term.parameters, dtype), multiplier_type(term, dtype, scalar)
    change, share_of = element_change(term, dtype, scalar, per_step), to_corner(term, dtype)
    number, shared, vector, vertex = load(dtype), load_shared(dtype), load(vec3), load(wp.int32, 2)
    rest_of, put = load(rest_type), store(vec3)

    @wp.func
    def add(
        e: int,
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        inverse_mass: wp.array(dtype=dtype),
        factor: wp.array(dtype=dtype),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        h: dtype,
        sweeps: int,
        lambdas: wp.array(dtype=lambda_type),
        out: wp.array(dtype=vec3),
    ):
        r = rest_of(rest, e)
        before = lambda_type(dtype(0.0))
        if wp.static(multipliers):
            before = lambdas[e]
        more, rows = change(stencil, e, shared(stiffness, e), r, inverse_mass, x, d, h, before, sweeps)
        if wp.static(multipliers):
            lambdas[e] = before + factor[e] * more
        for i in range(K):
            v = vertex(stencil, K * e + i)
            put(out, v, vector(out, v) + (number(inverse_mass, v) * shared(factor, e)) * share_of(r, i, rows))

    return add


@cache
def scatter_correction(
    term: Term, dtype, scalar: bool, multipliers: bool = False, per_step: bool = False, cleared: bool = False
):
    """Kernel over elements: adds factorₑ Δxᵢ [m] of each element to out, and factorₑ Δλ to λ.

    If ``cleared``, one thread loops over all elements and skips those whose vertex has moved less than ``clear``; one that was
    not skipped once never is again.
    """
    vec3, _ = types(dtype)
    rest_type, lambda_type = wp.types.vector(term.parameters, dtype), multiplier_type(term, dtype, scalar)
    add = add_correction(term, dtype, scalar, multipliers, per_step)
    number, vector, vertex, put = load(dtype), load(vec3), load(wp.int32, 2), store(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        inverse_mass: wp.array(dtype=dtype),
        factor: wp.array(dtype=dtype),
        clear: wp.array(dtype=dtype),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        h: dtype,
        sweeps: int,
        # in and out
        lambdas: wp.array(dtype=lambda_type),
        out: wp.array(dtype=vec3),
    ):
        if wp.static(cleared):
            for e in range(stencil.shape[0]):
                if not is_clear(number(clear, e), vector(d, vertex(stencil, e))):
                    put(clear, e, dtype(0.0))
                    add(e, stencil, stiffness, rest, inverse_mass, factor, x, d, h, sweeps, lambdas, out)
        else:
            add(wp.tid(), stencil, stiffness, rest, inverse_mass, factor, x, d, h, sweeps, lambdas, out)

    return scatter


@cache
def apply_correction(dtype):
    """Kernel over vertices: d += scaleᵢ Σ Δx, then resets the sum; scaleᵢ is 1, or 1/(nᵢ + α) for nᵢ constraints."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def apply(
        # elements
        scale: wp.array(dtype=dtype),
        # in and out
        total: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        correction[i] = correction[i] + scale[i] * total[i]
        total[i] = vec3()

    return apply
