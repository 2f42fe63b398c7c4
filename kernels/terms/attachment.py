"""Attachment: U = Σ ½k‖x − target‖², k in N/m: a spring of rest length 0 to a target.

Stencil (x₀), y = x₀, rest state the target (3,) [m], measure 1. The energy is not invariant to translation.
"""

from typing import Any

import warp as wp

from ..term import Dissipation, Term


def rest_state(points, stencil):
    """Targets [m] (E, 3): the positions of the vertices ``stencil`` (E, 1) in ``points``."""
    return points[stencil[:, 0]].copy()


@wp.func
def weight(rest: Any, i: int):
    return wp.vector(rest.dtype(1.0), length=1)


@wp.func
def measure(rest: Any):
    return rest.dtype(1.0)


@wp.func
def project(y: Any, rest: Any):
    return wp.matrix_from_rows(rest)


@wp.func
def gradient(y: Any, rest: Any):
    return y - project(y, rest)


@wp.func
def energy(y: Any, rest: Any):
    offset = y[0] - rest
    return y.dtype(0.5) * wp.dot(offset, offset)


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    return wp.identity(n=3, dtype=y.dtype)


@wp.func
def change(y: Any, other: Any, rest: Any):
    """The invariant is s = y: the target does not move with the cloth."""
    return other[0] - y[0]


@wp.func
def damped_rest(y: Any, change: Any, rest: Any, share: Any):
    return rest + share * (y[0] + change - rest)


ATTACHMENT = Term(
    name="Attachment",
    vertices=1,
    rows=1,
    parameters=3,
    rest_state=rest_state,
    weight=weight,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    project=project,
    linear=True,
    dissipation=Dissipation(change=change, rest=damped_rest),
)
