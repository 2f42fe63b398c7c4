"""Spring limit: U = Σ ½k(l − c)², c = l clamped to [σ_min L, σ_max L], k in N/m (Provot 1995, *Deformation constraints in a
mass-spring model*).

Stencil (x₀, x₁), y = x₁ − x₀, l = ‖y‖, measure 1. Within the limits there is no energy; beyond them a :mod:`.spring` of that
length; an infinite k makes it a hard constraint.
"""

from typing import Any

import numpy as np
import warp as wp

from ..term import Term
from . import spring

spring_energy, spring_gradient, spring_hessian, spring_project = spring.energy, spring.gradient, spring.hessian, spring.project


def rest_state(points, stencil, least=-np.inf, most=np.inf):
    """Returns σ_min L and σ_max L [m] of the pairs ``stencil`` (E, 2), from σ_min and σ_max (one or E each), (E, 2)."""
    lengths = spring.rest_state(points, stencil)[:, 0]
    ratios = np.stack([np.broadcast_to(least, len(lengths)), np.broadcast_to(most, len(lengths))], axis=1).astype(np.float64)
    return np.multiply(ratios, lengths[:, None], out=ratios, where=np.isfinite(ratios))


@wp.func
def nearest_length(y: Any, rest: Any):
    """Returns c as the rest state of a spring."""
    return wp.vector(wp.min(wp.max(wp.length(y[0]), rest[0]), rest[1]), length=1)


@wp.func
def energy(y: Any, rest: Any):
    return spring_energy(y, nearest_length(y, rest))


@wp.func
def gradient(y: Any, rest: Any):
    nearest = nearest_length(y, rest)
    return wp.where(nearest[0] == wp.length(y[0]), y.dtype(0.0), y.dtype(1.0)) * spring_gradient(y, nearest)


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    """On a limit, this is the Hessian beyond it."""
    h = spring_hessian(y, nearest_length(y, rest), negative)
    length = wp.length(y[0])
    if length > rest[0] and length < rest[1]:
        h *= y.dtype(0.0)
    return h


@wp.func
def project(y: Any, rest: Any):
    return spring_project(y, nearest_length(y, rest))


SPRING_LIMIT = Term(
    name="SpringLimit",
    vertices=2,
    rows=1,
    parameters=2,
    rest_state=rest_state,
    weight=spring.weight,
    measure=spring.measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    dead_zone=True,
    max_lengths=spring.max_lengths,
    project=project,
)
