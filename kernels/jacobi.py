"""Kernels of a Jacobi sweep: local steps of elements at the old positions, then, after Dᵀz, vertex moves.

The key is that of :mod:`.project`.
"""

from functools import cache

import warp as wp

from .memory import load, load_shared, store
from .project import element_change, multiplier_type
from .term import Term
from .transpose import gather, scatter, stored
from .vectors import types


@cache
def local_steps(term: Term, dtype, scalar: bool, multipliers: bool = False, per_step: bool = False, axes: bool = False):
    """Kernel over elements at x̃ + d: z = factorₑ · rows of :func:`.project.multiplier`, λ += factorₑ Δλ."""
    vec3, _ = types(dtype)
    rest_type, lambda_type = wp.types.vector(term.parameters, dtype), multiplier_type(term, dtype, scalar)
    y_type, change = wp.types.matrix((term.rows, 3), dtype), element_change(term, dtype, scalar, per_step, axes)
    shared, rest_of, put = load_shared(dtype), load(rest_type), store(y_type)
    mass_type = vec3 if axes else dtype

    @wp.kernel(module="unique", enable_backward=False)
    def correct(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        inverse_mass: wp.array(dtype=mass_type),
        factor: wp.array(dtype=dtype),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        h: dtype,
        sweeps: int,
        # in and out
        lambdas: wp.array(dtype=lambda_type),
        # out
        z: wp.array(dtype=y_type),
    ):
        e = wp.tid()
        before = lambda_type(dtype(0.0))
        if wp.static(multipliers):
            before = lambdas[e]
        more, rows = change(stencil, e, shared(stiffness, e), rest_of(rest, e), inverse_mass, x, d, h, before, sweeps)
        if wp.static(multipliers):
            lambdas[e] = before + shared(factor, e) * more
        put(z, e, shared(factor, e) * rows)

    return correct


def scatter_moves(term: Term, dtype):
    return scatter(term, dtype, stored(term, dtype))


def gather_moves(term: Term, dtype):
    return gather(term, dtype, stored(term, dtype))


@cache
def move_vertices(dtype):
    """Kernel over vertices: d += scaleᵢ/mᵢ Σ Dᵀz; resets the sum to 0.

    scaleᵢ is 1, or 1/(nᵢ + α) for nᵢ constraints of the vertex.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def move(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        scale: wp.array(dtype=dtype),
        # in and out
        total: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        d[i] = d[i] + scale[i] * (inverse_mass[i] * total[i])
        total[i] = vec3()

    return move
