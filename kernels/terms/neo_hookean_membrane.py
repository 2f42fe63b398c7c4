"""Stable Neo-Hookean membrane: U = Σ A(½μ(‖F‖² − 2) − μ(J − 1) + ½(λ + μ)(J − 1)²), J = ‖f₁×f₂‖ (Smith, De Goes and Kim 2018,
*Stable Neo-Hookean flesh simulation*, here in two dimensions and without the logarithm).

F (3×2) = [f₁, f₂] is the deformation gradient of a triangle (:mod:`..membrane`), A its rest area. The stiffness is k = Et in
N/m, μ = k/(2(1 + ν)) and λ = kν/(1 − ν²) with Poisson's ratio ν. It is computed as ½μ(σ₁ − σ₂)² + ½(λ + μ)(J − 1)², without
cancellation near rest.

The rest shape is its only minimum, up to rigid motion. A crushed triangle, J ≤ 4ε‖F‖², has ∂J = 0.
"""

from typing import Any

import warp as wp

from ..membrane import decompose, isotropic_hessian, material_state, measure, weight
from ..rotation import epsilon
from ..term import Term
from .membrane_damping import DISSIPATION


@wp.func
def crushed(y: Any, J: Any):
    return J <= y.dtype(4.0) * epsilon(J) * wp.ddot(y, y)


@wp.func
def slope(J: Any, rest: Any):
    """Returns the derivative of −μ(J − 1) + ½(λ + μ)(J − 1)² with respect to J."""
    return (rest[3] + rest[4]) * (J - rest.dtype(1.0)) - rest[3]


@wp.func
def energy(y: Any, rest: Any):
    J = wp.length(wp.cross(y[0], y[1]))
    # (σ₁ − σ₂)² = (σ₁² − σ₂²)²/(σ₁ + σ₂)².
    a = wp.dot(y[0], y[0]) - wp.dot(y[1], y[1])
    b = y.dtype(2.0) * wp.dot(y[0], y[1])
    unlike = a * a + b * b
    total = wp.ddot(y, y) + y.dtype(2.0) * J
    if total != y.dtype(0.0):
        unlike /= total
    change = J - y.dtype(1.0)
    return y.dtype(0.5) * (rest[3] * unlike + (rest[3] + rest[4]) * change * change)


@wp.func
def gradient(y: Any, rest: Any):
    g = rest[3] * y
    normal = wp.cross(y[0], y[1])
    J = wp.length(normal)
    if not crushed(y, J):
        n = (slope(J, rest) / J) * normal
        g += wp.matrix_from_rows(wp.cross(y[1], n), wp.cross(n, y[0]))
    return g


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    U, S, V = decompose(y)
    mu = rest[3]
    J = wp.length(wp.cross(y[0], y[1]))
    stretch = mu * wp.identity(n=2, dtype=y.dtype)
    twist = mu
    flip = mu
    out1 = mu
    out2 = mu
    if not crushed(y, J):
        s = slope(J, rest)
        c = mu + rest[4]
        stretch[0, 0] += c * S[1] * S[1]
        stretch[1, 1] += c * S[0] * S[0]
        stretch[0, 1] = s + c * J
        stretch[1, 0] = s + c * J
        twist += s
        flip -= s
        out1 += s * (S[1] / S[0])
        out2 += s * (S[0] / S[1])
    return isotropic_hessian(U, V, stretch, twist, flip, out1, out2, negative)


NEO_HOOKEAN_MEMBRANE = Term(
    name="NeoHookeanMembrane",
    vertices=3,
    rows=2,
    parameters=5,
    rest_state=material_state,
    weight=weight,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    dissipation=DISSIPATION,
)
