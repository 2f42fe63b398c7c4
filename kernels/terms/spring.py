"""Spring: U = Σ ½k(‖x₁ − x₀‖ − L)², k in N/m (Provot 1995, *Deformation constraints in a mass-spring model*).

Stencil (x₀, x₁), y = x₁ − x₀, l = ‖y‖, rest state L [m], measure 1. The Hessian k[ŷŷᵀ + (1 − L/l)(I − ŷŷᵀ)] has the eigenvalue
k(1 − L/l) < 0 in compression (Choi and Ko 2002, *Stable but responsive cloth*), which clamping sets to 0.

A collapsed spring, l ≤ 1e-12 L, has the gradient 0, the Hessian I and the projection y.
"""

from typing import Any

import numpy as np
import warp as wp

from ..columns import columns_of, length
from ..term import Dissipation, Term


def rest_state(points, stencil):
    """Rest lengths [m] of the pairs ``stencil`` (E, 2) as an array (E, 1)."""
    x0, x1 = columns_of(points, *stencil.T)
    return length(x1 - x0)[:, None]


def max_lengths(points, stencil, rest):
    """Returns the pairs, no longer than L."""
    return stencil, rest[:, -1], np.ones(len(stencil))


@wp.func
def weight(rest: Any, i: int):
    # Built in one call, the vector changes the order of instructions, and an explicit step takes 1.05 times as long (H200).
    w = wp.vector(length=1, dtype=rest.dtype)
    w[0] = rest.dtype(2 * i - 1)
    return w


@wp.func
def measure(rest: Any):
    return rest.dtype(1.0)


@wp.func
def collapsed(length: Any, rest_length: Any):
    return length <= rest_length * type(rest_length)(1.0e-12)


@wp.func
def energy(y: Any, rest: Any):
    c = wp.length(y[0]) - rest[0]
    return y.dtype(0.5) * c * c


# L/l, but 1 for a collapsed spring, so that its force is 0. In kernels with fast math a reciprocal square root is one
# instruction; a square root, a division and a comparison take 1.07 times as long (H200, 512² vertices).
_QUOTIENT = """
#if defined(__USE_FAST_MATH__)
{0} quotient = length * rsqrt{1}(square);
#else
{0} quotient = length / wp::sqrt(square);
#endif
return quotient < 1.0e12{1} ? quotient : 1.0{1};
"""


@wp.func_native(_QUOTIENT.format("float", "f"))
def over_root(length: wp.float32, square: wp.float32) -> wp.float32: ...


@wp.func_native(_QUOTIENT.format("double", ""))
def over_root(length: wp.float64, square: wp.float64) -> wp.float64: ...  # noqa: F811


@wp.func
def gradient(y: Any, rest: Any):
    return (y.dtype(1.0) - over_root(rest[0], wp.length_sq(y[0]))) * y


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    length = wp.length(y[0])
    eye = wp.identity(n=3, dtype=y.dtype)
    if collapsed(length, rest[0]):
        return eye
    direction = y[0] / length
    transverse = y.dtype(1.0) - rest[0] / length
    if transverse < y.dtype(0.0):
        transverse *= negative
    along = wp.outer(direction, direction)
    return along + transverse * (eye - along)


@wp.func
def project(y: Any, rest: Any):
    length = wp.length(y[0])
    return wp.where(collapsed(length, rest[0]), y.dtype(1.0), rest[0] / length) * y


@wp.func
def constraint(y: Any, rest: Any):
    return wp.length(y[0]) - rest[0]


@wp.func
def constraint_gradient(y: Any, rest: Any):
    length = wp.length(y[0])
    return wp.where(collapsed(length, rest[0]), y.dtype(0.0), y.dtype(1.0) / length) * y


@wp.func
def constraint_hessian(y: Any, rest: Any):
    length = wp.length(y[0])
    h = wp.matrix(shape=(3, 3), dtype=y.dtype)
    if not collapsed(length, rest[0]):
        direction = y[0] / length
        h = (wp.identity(n=3, dtype=y.dtype) - wp.outer(direction, direction)) / length
    return h


@wp.func
def stiffening(y: Any, rest: Any, tension: Any):
    length = wp.length(y[0])
    rows = wp.matrix(shape=(3, 3), dtype=y.dtype)
    if tension > y.dtype(0.0) and not collapsed(length, rest[0]):
        direction = y[0] / length
        rows = wp.sqrt(tension / length) * (wp.identity(n=3, dtype=y.dtype) - wp.outer(direction, direction))
    return rows


@wp.func
def change(y: Any, other: Any, rest: Any):
    return wp.length(other[0]) - wp.length(y[0])


@wp.func
def damped_length(y: Any, change: Any, rest_length: Any, share: Any):
    """Returns L + share·(s̃ − L), see :class:`..term.Dissipation`, for s = l, and at least 0."""
    s = wp.length(y[0]) + change
    return wp.max(rest_length + share * (s - rest_length), y.dtype(0.0))


@wp.func
def damped_rest(y: Any, change: Any, rest: Any, share: Any):
    r = rest
    r[0] = damped_length(y, change, rest[0], share)
    return r


SPRING = Term(
    name="Spring",
    vertices=2,
    rows=1,
    parameters=1,
    rest_state=rest_state,
    weight=weight,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    max_lengths=max_lengths,
    project=project,
    constraint=constraint,
    constraint_gradient=constraint_gradient,
    constraint_hessian=constraint_hessian,
    stiffening=stiffening,
    stiffening_rows=3,
    dissipation=Dissipation(change=change, rest=damped_rest),
)
