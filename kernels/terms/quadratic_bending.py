"""Quadratic bending: U = Σ ½D‖y‖²/(A₁ + A₂), D the plate's bending stiffness in N·m (Bergou et al. 2006, *A quadratic
bending model for inextensible surfaces*).

Stencil: a hinge (x₀, x₁ the edge, x₂ and x₃ the opposite vertices). y = Σ cᵢxᵢ [m] with cotangent weights taken from the
rest shape, so that ‖y‖ = |e|·θ for a small angle θ; Aᵢ are the rest areas of the two triangles. The Hessian is constant.
The paper's factor is 3 where this has 1: with 1 an equilateral sheet that is rolled up has the energy ½Dκ² per area, with 3
three times that.

The rest shape counts as flat: of a curved one only the lengths are used. Exact for isometric motion of a flat sheet; a sheet
stretched in its plane by x → x + εx² costs ½D(2ε)² per area here and nothing with dihedral angles.
"""

from typing import Any

import numpy as np
import warp as wp

from ..term import Term


def rest_state(points, stencil):
    """Cotangent weights (4) [1] and the measure 1/(A₁ + A₂) [1/m²] of the hinges ``stencil`` (E, 4), as an array (E, 5)."""
    x0, x1, x2, x3 = (points[stencil[:, i]] for i in range(4))

    def cotangent(apex, b, c):
        return np.einsum("ij,ij->i", b - apex, c - apex) / np.linalg.norm(np.cross(b - apex, c - apex), axis=1)

    at0 = cotangent(x0, x1, x2), cotangent(x0, x1, x3)
    at1 = cotangent(x1, x0, x2), cotangent(x1, x0, x3)
    areas = 0.5 * (np.linalg.norm(np.cross(x1 - x0, x2 - x0), axis=1) + np.linalg.norm(np.cross(x1 - x0, x3 - x0), axis=1))
    return np.stack(
        [at1[0] + at1[1], at0[0] + at0[1], -at0[0] - at1[0], -at0[1] - at1[1], 1.0 / areas],
        axis=1,
    )


@wp.func
def weight(rest: Any, i: int):
    w = wp.vector(length=1, dtype=rest.dtype)
    w[0] = rest[i]
    return w


@wp.func
def measure(rest: Any):
    return rest[4]


@wp.func
def energy(y: Any, rest: Any):
    return y.dtype(0.5) * wp.dot(y[0], y[0])


@wp.func
def gradient(y: Any, rest: Any):
    return y


@wp.func
def hessian(y: Any, rest: Any, policy: int):
    return wp.identity(n=3, dtype=y.dtype)


@wp.func
def project(y: Any, rest: Any):
    return y * y.dtype(0.0)


QUADRATIC_BENDING = Term(
    name="QuadraticBending",
    vertices=4,
    rows=1,
    parameters=5,
    rest_state=rest_state,
    weight=weight,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    project=project,
)
