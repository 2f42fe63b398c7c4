"""Drag and lift of air on a triangle as a dissipation, frozen where a step begins.

The force is F = ½ρA(C_n|u_n|u_n n + C_t|u_t|u_t), u the wind less the velocity of the triangle, u_n and u_t its parts along the
normal n and across. Within a step it is

    F = ρκ_n n(n·(a − y)) + ρκ_t (I − n nᵀ)(a − y),   κ_n = AC_n|u_n|/2hₑ, κ_t = AC_t|u_t|/2hₑ,

the force of U = ½ρ(κ_n(n·(y − a))² + κ_t‖(I − n nᵀ)(y − a)‖²), y the centre of the triangle and a where the wind would take it:
(a − y)/hₑ is the wind less the velocity.

Stencil: a triangle, y = (x₀ + x₁ + x₂)/3, measure 1. The stiffness is the density ρ of air [kg/m³]. Rest state: a, n, κ_n, κ_t
[m²/s], which :func:`..frozen_air.set_air` writes, the wind [m/s], C_n and C_t.
"""

from typing import Any

import numpy as np
import warp as wp

from ..term import Term


def rest_state(points, stencil, wind=(0.0, 0.0, 0.0), normal_drag=1.2, tangential_drag=0.02):
    """Rest states (E, 13) of the triangles ``stencil`` (E, 3) without a force; wind is one or (E, 3), drag one or (E,)."""
    rest = np.zeros((len(stencil), 13))
    rest[:, 8:11], rest[:, 11], rest[:, 12] = wind, normal_drag, tangential_drag
    return rest


@wp.func
def weight(rest: Any, i: int):
    return wp.vector(rest.dtype(1.0) / rest.dtype(3.0), length=1)


@wp.func
def measure(rest: Any):
    return rest.dtype(1.0)


@wp.func
def parts(y: Any, rest: Any):
    """The parts of y − a along the normal and across."""
    away = y[0] - wp.vector(rest[0], rest[1], rest[2])
    n = wp.vector(rest[3], rest[4], rest[5])
    along = wp.dot(n, away) * n
    return along, away - along


@wp.func
def energy(y: Any, rest: Any):
    along, across = parts(y, rest)
    return y.dtype(0.5) * (rest[6] * wp.dot(along, along) + rest[7] * wp.dot(across, across))


@wp.func
def gradient(y: Any, rest: Any):
    along, across = parts(y, rest)
    g = wp.matrix(shape=(1, 3), dtype=y.dtype)
    g[0] = rest[6] * along + rest[7] * across
    return g


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    n = wp.vector(rest[3], rest[4], rest[5])
    return rest[7] * wp.identity(n=3, dtype=y.dtype) + (rest[6] - rest[7]) * wp.outer(n, n)


@wp.func
def prox(v: Any, rest: Any, compliance: Any):
    """v − a with its two parts divided by 1 + cκ."""
    one = v.dtype(1.0)
    along, across = parts(v, rest)
    p = v
    p[0] = v[0] - (one - one / (one + compliance * rest[6])) * along - (one - one / (one + compliance * rest[7])) * across
    return p


AIR = Term(
    name="Air",
    vertices=3,
    rows=1,
    parameters=13,
    rest_state=rest_state,
    weight=weight,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    prox=prox,
)
