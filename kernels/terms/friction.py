"""Friction of a vertex on a collider: U = Σ kA H(‖u‖), u = (I − nnᵀ)(y − a), k in Pa/m.

H is the Huber function, H = ½u² for u < ε and εu − ½ε² beyond, with ε = μN/(kA): a spring to the anchor a with a force of at
most μN (Cundall and Strack 1979, *A discrete numerical model for granular assemblies*). The anchor, the normal n and N are
constant in a step.

Stencil (x₀), y = x₀, measure A. Rest state: a, n, ε [m] and A. With ε = 0, energy and force are 0.
"""

from typing import Any

import numpy as np
import warp as wp

from ..term import Term
from .attachment import weight


def rest_state(points, stencil, areas=1.0):
    """Rest states (E, 8) of the vertices ``stencil`` (E, 1) without contact."""
    rest = np.zeros((len(stencil), 8))
    rest[:, 7] = areas
    return rest


@wp.func
def measure(rest: Any):
    return rest[7]


@wp.func
def idle(y: Any, rest: Any, margin: Any):
    """Whether the vertex has no friction in the step, at any position."""
    return wp.where(rest[6] > y.dtype(0.0), wp.int32(0), wp.int32(1))


@wp.func
def clearance(y: Any, rest: Any):
    """0 if the vertex has friction in the step, else infinite."""
    return wp.where(rest[6] > y.dtype(0.0), y.dtype(0.0), y.dtype(wp.inf))


@wp.func
def slip(y: Any, rest: Any):
    """u."""
    n = wp.vector(rest[3], rest[4], rest[5])
    away = y[0] - wp.vector(rest[0], rest[1], rest[2])
    return away - wp.dot(n, away) * n


@wp.func
def energy(y: Any, rest: Any):
    l = wp.length(slip(y, rest))
    least = wp.min(l, rest[6])
    return least * (l - y.dtype(0.5) * least)


@wp.func
def gradient(y: Any, rest: Any):
    g = wp.matrix(shape=(1, 3), dtype=y.dtype)
    if rest[6] > y.dtype(0.0):
        u = slip(y, rest)
        l = wp.length(u)
        g[0] = wp.where(l > rest[6], rest[6] / wp.max(l, rest[6]), y.dtype(1.0)) * u
    return g


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    n = wp.vector(rest[3], rest[4], rest[5])
    u = slip(y, rest)
    l = wp.length(u)
    H = wp.matrix(shape=(3, 3), dtype=y.dtype)
    if rest[6] > y.dtype(0.0):
        H = wp.identity(n=3, dtype=y.dtype) - wp.outer(n, n)
        if l > rest[6]:
            H = rest[6] / l * (H - wp.outer(u, u) / (l * l))
    return H


@wp.func
def secant(y: Any, rest: Any):
    """ε/‖u‖ for a sliding vertex, else 1: the gradient is this times u."""
    l = wp.length(slip(y, rest))
    share = y.dtype(1.0)
    if l > rest[6] and rest[6] > y.dtype(0.0):
        share = rest[6] / l
    return share


@wp.func
def project(y: Any, rest: Any):
    """y minus the gradient of the energy."""
    return y - gradient(y, rest)


@wp.func
def prox(v: Any, rest: Any, compliance: Any):
    """v moved towards the anchor by the fraction c/(1 + c) of u, at most by cε."""
    u = slip(v, rest)
    l = wp.length(u)
    part = v.dtype(1.0) - v.dtype(1.0) / (v.dtype(1.0) + compliance)
    if part * l > compliance * rest[6]:
        part = compliance * rest[6] / l
    p = v
    p[0] = v[0] - part * u
    return p


@wp.func
def bounded_hessian(y: Any, rest: Any, negative: Any):
    """0, as the bounded Hessian of contact includes that of friction."""
    return wp.matrix(shape=(3, 3), dtype=y.dtype)


BOUNDED_FRICTION = Term("Friction", 1, 1, 8, rest_state, weight, measure, energy, gradient, bounded_hessian)

FRICTION = Term(
    name="Friction",
    vertices=1,
    rows=1,
    parameters=8,
    rest_state=rest_state,
    weight=weight,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    dead_zone=True,
    project=project,
    prox=prox,
    idle=idle,
    clearance=clearance,
    secant=secant,
    bounded=BOUNDED_FRICTION,
)
