"""Quadratic bending: U = Σ ½D‖y‖²/(A₁ + A₂), D the plate's bending stiffness in N·m (Bergou et al. 2006, *A quadratic
bending model for inextensible surfaces*).

Stencil: a hinge (x₀, x₁ the edge, x₂ and x₃ the opposite vertices). y = Σ cᵢxᵢ [m] with cotangent weights taken from the rest
shape, so that ‖y‖ = |e|·θ for a small angle θ; Aᵢ are the rest areas of the two triangles. The Hessian is constant. The paper
has a factor 3 where this has 1, with which an equilateral sheet of curvature κ has the energy ½Dκ² per area.

The sheet is flat at rest: a curved rest shape gives edge lengths only. The energy is exact for isometric motion. Stretch in the
plane by x → x + εx² costs ½D(2ε)² per area, and nothing with dihedral angles.
"""

from typing import Any

import numpy as np
import warp as wp

from ..columns import columns_of, cross_length, dot
from ..term import Dissipation, Term
from . import spring


def rest_state(points, stencil):
    """Returns 4 cotangent weights [1] and the measure 1/(A₁ + A₂) [1/m²] of the hinges ``stencil`` (E, 4), (E, 5)."""
    x0, x1, x2, x3 = columns_of(points, *stencil.T)

    def cotangent(apex, b, c):
        sides = b - apex, c - apex
        double = cross_length(*sides)
        return dot(*sides) / double, double

    (at0, areas) = zip(cotangent(x0, x1, x2), cotangent(x0, x1, x3), strict=True)
    at1 = cotangent(x1, x0, x2)[0], cotangent(x1, x0, x3)[0]
    areas = 0.5 * (areas[0] + areas[1])
    return np.stack(
        [at1[0] + at1[1], at0[0] + at0[1], -at0[0] - at1[0], -at0[1] - at1[1], 1.0 / areas],
        axis=1,
    )


@wp.func
def weight(rest: Any, i: int):
    return wp.vector(rest[i], length=1)


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
def hessian(y: Any, rest: Any, negative: Any):
    return wp.identity(n=3, dtype=y.dtype)


@wp.func
def project(y: Any, rest: Any):
    return y * y.dtype(0.0)


# With damping, s = ‖y‖: the energy ½(‖y‖ − s̄)² of a spring of rest length s̄, the last number of the rest state.

spring_energy, spring_gradient, spring_hessian, spring_project = spring.energy, spring.gradient, spring.hessian, spring.project
damped_length = spring.damped_length


@wp.func
def length_of(rest: Any):
    """Returns s̄ as the rest state of a spring."""
    return wp.vector(rest[5], length=1)


@wp.func
def damped_energy(y: Any, rest: Any):
    return spring_energy(y, length_of(rest))


@wp.func
def damped_gradient(y: Any, rest: Any):
    return spring_gradient(y, length_of(rest))


@wp.func
def damped_hessian(y: Any, rest: Any, negative: Any):
    return spring_hessian(y, length_of(rest), negative)


@wp.func
def damped_project(y: Any, rest: Any):
    return spring_project(y, length_of(rest))


@wp.func
def damped_rest(y: Any, change: Any, rest: Any, share: Any):
    r = wp.vector(length=6, dtype=rest.dtype)
    for i in range(5):
        r[i] = rest[i]
    r[5] = damped_length(y, change, rest.dtype(0.0), share)
    return r


def damped_rest_state(points, stencil):
    """Returns :func:`rest_state` and s̄ = 0 [m], (E, 6)."""
    return np.column_stack([rest_state(points, stencil), np.zeros(len(stencil))])


DAMPED_QUADRATIC_BENDING = Term(
    name="DampedQuadraticBending",
    vertices=4,
    rows=1,
    parameters=6,
    rest_state=damped_rest_state,
    weight=weight,
    measure=measure,
    energy=damped_energy,
    gradient=damped_gradient,
    hessian=damped_hessian,
    project=damped_project,
)

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
    linear=True,
    quadratic=True,
    dissipation=Dissipation(change=spring.change, rest=damped_rest, term=DAMPED_QUADRATIC_BENDING),
)
