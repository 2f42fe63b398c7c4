"""St. Venant–Kirchhoff membrane: U = Σ A(μ‖E‖² + ½λ(tr E)²), E = ½(FᵀF − I) the Green strain, in plane stress.

F (3×2) is the deformation gradient of a triangle (:mod:`..membrane`), A its rest area. The stiffness is k = Et in N/m, and with
Poisson's ratio ν μ = k/(2(1 + ν)), λ = kν/(1 − ν²).

The energy does not resist collapse: in compression the force is largest at σ = 1/√3 and 0 at σ = 0, where the triangle inverts.
"""

from typing import Any

import warp as wp

from ..membrane import decompose, green_strain, isotropic_hessian, material_state, measure, weight
from ..term import Term
from .membrane_damping import DISSIPATION


@wp.func
def energy(y: Any, rest: Any):
    E = green_strain(y)
    trace = E[0] + E[1]
    return rest[3] * (E[0] * E[0] + E[1] * E[1] + y.dtype(2.0) * E[2] * E[2]) + y.dtype(0.5) * rest[4] * trace * trace


@wp.func
def gradient(y: Any, rest: Any):
    E = green_strain(y)
    shear = y.dtype(2.0) * rest[3]
    pressure = rest[4] * (E[0] + E[1])
    return wp.matrix_from_rows(
        (shear * E[0] + pressure) * y[0] + (shear * E[2]) * y[1],
        (shear * E[2]) * y[0] + (shear * E[1] + pressure) * y[1],
    )


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    U, S, V = decompose(y)
    mu = rest[3]
    lam = rest[4]
    a = S[0] * S[0]
    b = S[1] * S[1]
    ab = S[0] * S[1]
    level = y.dtype(0.5) * lam * (a + b - y.dtype(2.0)) - mu
    # The second Piola–Kirchhoff stresses are level + μσᵢ², and ψᵢ is σᵢ times that, so that all quotients cancel.
    s1 = level + mu * a
    s2 = level + mu * b
    stretch = wp.matrix(shape=(2, 2), dtype=y.dtype)
    stretch[0, 0] = s1 + (y.dtype(2.0) * mu + lam) * a
    stretch[1, 1] = s2 + (y.dtype(2.0) * mu + lam) * b
    stretch[0, 1] = lam * ab
    stretch[1, 0] = lam * ab
    return isotropic_hessian(U, V, stretch, level + mu * (a - ab + b), level + mu * (a + ab + b), s1, s2, negative)


STVK_MEMBRANE = Term(
    name="StVKMembrane",
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
