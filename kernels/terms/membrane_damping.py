"""Damping of all membranes: D = Σ (Aβ/2hₑ)‖E − Ẽ‖², E = ½(FᵀF − I) the Green strain, β in N·s/m.

F (3×2) is the deformation gradient of a triangle (:mod:`..membrane`), A its rest area, Ẽ the strain at the start of a step. βĖ
is the stress of a Kelvin–Voigt solid, zero in rigid motion (Baraff and Witkin 1998, *Large steps in cloth simulation*,
likewise).
"""

from typing import Any

import numpy as np
import warp as wp

from ..membrane import covector, green_strain, inverse_edges, measure, scaled_negative_part, weight
from ..term import Dissipation, Term


def rest_state(points, stencil):
    """Returns inverse rest edges [1/m] of triangles ``stencil`` (E, 3) and Ẽ = 0, (E, 6)."""
    return np.column_stack([inverse_edges(points, stencil), np.zeros((len(stencil), 3))])


@wp.func
def change(y: Any, rest: Any):
    """E − Ẽ (2×2)."""
    E = green_strain(y)
    S = wp.matrix(shape=(2, 2), dtype=y.dtype)
    S[0, 0] = E[0] - rest[3]
    S[1, 1] = E[1] - rest[4]
    S[0, 1] = E[2] - rest[5]
    S[1, 0] = S[0, 1]
    return S


@wp.func
def energy(y: Any, rest: Any):
    S = change(y, rest)
    return y.dtype(0.5) * wp.ddot(S, S)


@wp.func
def gradient(y: Any, rest: Any):
    return change(y, rest) * y  # F S, the columns of F as rows


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    """Returns ∂E∂Eᵀ + (E − Ẽ)∂²E; only the second part can be negative."""
    zero = y[0] * y.dtype(0.0)
    a = covector(y[0], zero)
    b = covector(zero, y[1])
    c = covector(y[1], y[0])
    h = wp.outer(a, a) + wp.outer(b, b) + wp.outer(y.dtype(0.5) * c, c)
    S = scaled_negative_part(change(y, rest), negative)
    for m in range(2):
        for n in range(2):
            for row in range(3):
                h[3 * m + row, 3 * n + row] = h[3 * m + row, 3 * n + row] + S[m, n]
    return h


@wp.func
def strain_change(y: Any, other: Any, rest: Any):
    return green_strain(other) - green_strain(y)


@wp.func
def damped_rest(y: Any, change: Any, rest: Any, share: Any):
    """Takes the rest state of any membrane, which begins with the inverse rest edges."""
    E = green_strain(y) + change
    r = wp.vector(length=6, dtype=rest.dtype)
    for i in range(3):
        r[i] = rest[i]
        r[3 + i] = E[i]
    return r


MEMBRANE_DAMPING = Term(
    name="MembraneDamping",
    vertices=3,
    rows=2,
    parameters=6,
    rest_state=rest_state,
    weight=weight,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
)

DISSIPATION = Dissipation(change=strain_change, rest=damped_rest, merges=False, term=MEMBRANE_DAMPING)
