"""Orthotropic St. Venant–Kirchhoff membrane: U = Σ ½A εᵀCε, ε = (E₁₁, E₂₂, 2E₁₂), E = ½(FᵀF − I) the Green strain.

F (3×2) is the deformation gradient of a triangle (:mod:`..membrane`), A its rest area. The stiffness is E₁t in N/m, Young's
modulus along the warp times thickness. The rest state holds C/E₁t in the axes of F.

A polynomial that gives way when crushed, as :mod:`.stvk_membrane`. Its Hessian BᵀCB + S⊗I is semi-definite if and only if the
stress S is.
"""

from typing import Any

import numpy as np
import warp as wp

from ..membrane import covector, green_strain, inverse_edges, measure, scaled_negative_part, side_axes, weight
from ..term import Term
from .membrane_damping import DISSIPATION


def rest_state(points, stencil, warp=(1.0, 0.0, 0.0), weft_ratio=1.0, poisson_ratio=0.0, shear_ratio=0.5):
    """Inverse rest edges [1/m] of triangles ``stencil`` (E, 3), and C₀₀, C₁₁, C₂₂, C₀₁, C₀₂, C₁₂ over E₁t [1], (E, 9).

    Of ``warp`` (3,) or (E, 3) the part in the triangle's plane counts. E₂/E₁, ν₁₂ and G/E₁ are one or (E,).
    """
    weft, ratio, shear = (np.broadcast_to(values, len(stencil)) for values in (weft_ratio, poisson_ratio, shear_ratio))
    C = np.zeros((len(stencil), 3, 3))  # along warp and weft
    C[:, 0, 0] = 1.0 / (1.0 - ratio**2 * weft)
    C[:, 0, 1] = C[:, 1, 0] = ratio * weft * C[:, 0, 0]
    C[:, 1, 1], C[:, 2, 2] = weft * C[:, 0, 0], shear
    along = np.einsum("eai,ei->ae", side_axes(points, stencil), np.broadcast_to(warp, (len(stencil), 3)))
    c, s = along / np.linalg.norm(along, axis=0)
    turn = np.stack([c * c, s * s, c * s, s * s, c * c, -c * s, -2.0 * c * s, 2.0 * c * s, c * c - s * s], axis=1)
    turn = turn.reshape(-1, 3, 3)  # ε along warp and weft from that in the axes of the triangle
    C = turn.transpose(0, 2, 1) @ C @ turn
    return np.column_stack([inverse_edges(points, stencil), C[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]])


@wp.func
def stress(y: Any, rest: Any):
    """S₀₀, S₁₁, S₀₁ of S = Cε, the second Piola–Kirchhoff stress over E₁t."""
    E = green_strain(y)
    shear = y.dtype(2.0) * E[2]
    return wp.vector(
        rest[3] * E[0] + rest[6] * E[1] + rest[7] * shear,
        rest[6] * E[0] + rest[4] * E[1] + rest[8] * shear,
        rest[7] * E[0] + rest[8] * E[1] + rest[5] * shear,
    )


@wp.func
def energy(y: Any, rest: Any):
    E = green_strain(y)
    S = stress(y, rest)
    return y.dtype(0.5) * (S[0] * E[0] + S[1] * E[1]) + S[2] * E[2]


@wp.func
def gradient(y: Any, rest: Any):
    S = stress(y, rest)
    return wp.matrix_from_rows(S[0] * y[0] + S[2] * y[1], S[2] * y[0] + S[1] * y[1])


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    zero = y[0] * y.dtype(0.0)
    a = covector(y[0], zero)
    b = covector(zero, y[1])
    c = covector(y[1], y[0])
    h = wp.outer(a, rest[3] * a + rest[6] * b + rest[7] * c)
    h += wp.outer(b, rest[6] * a + rest[4] * b + rest[8] * c)
    h += wp.outer(c, rest[7] * a + rest[8] * b + rest[5] * c)
    S = stress(y, rest)
    both = wp.matrix(shape=(2, 2), dtype=y.dtype)
    both[0, 0] = S[0]
    both[1, 1] = S[1]
    both[0, 1] = S[2]
    both[1, 0] = S[2]
    both = scaled_negative_part(both, negative)
    for m in range(2):
        for n in range(2):
            for row in range(3):
                h[3 * m + row, 3 * n + row] = h[3 * m + row, 3 * n + row] + both[m, n]
    return h


ORTHOTROPIC_MEMBRANE = Term(
    name="OrthotropicMembrane",
    vertices=3,
    rows=2,
    parameters=9,
    rest_state=rest_state,
    weight=weight,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    dissipation=DISSIPATION,
)
