"""Friction of a vertex on a collider: U = Σ kA H(‖u‖), u = (I − nnᵀ)(y − a), k in Pa/m.

H and ε are those of a law, by default :mod:`..coulomb` with ε = μN/(kA): a spring to the anchor a with a force of at most μN.

Stencil (x₀), y = x₀, measure A. Rest state: a, n, ε [m] and A. With ε = 0, energy and force are 0.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from ..coulomb import COULOMB, Law
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
def bounded_hessian(y: Any, rest: Any, negative: Any):
    """0: the bounded Hessian of contact includes friction."""
    return wp.matrix(shape=(3, 3), dtype=y.dtype)


@cache
def friction(law: Law):
    energy_of, secant_of, bend_of, prox_of = law.energy, law.secant, law.bend, law.prox

    @wp.func
    def energy(y: Any, rest: Any):
        return energy_of(wp.length(slip(y, rest)), rest[6])

    @wp.func
    def gradient(y: Any, rest: Any):
        g = wp.matrix(shape=(1, 3), dtype=y.dtype)
        if rest[6] > y.dtype(0.0):
            u = slip(y, rest)
            g[0] = secant_of(wp.length(u), rest[6]) * u
        return g

    @wp.func
    def hessian(y: Any, rest: Any, negative: Any):
        n = wp.vector(rest[3], rest[4], rest[5])
        u = slip(y, rest)
        l = wp.length(u)
        H = wp.matrix(shape=(3, 3), dtype=y.dtype)
        if rest[6] > y.dtype(0.0):
            across = secant_of(l, rest[6])
            H = across * (wp.identity(n=3, dtype=y.dtype) - wp.outer(n, n))
            if l > rest[6]:
                H += (bend_of(l, rest[6]) - across) * wp.outer(u / l, u / l)
        return H

    @wp.func
    def secant(y: Any, rest: Any):
        """H′/‖u‖: the gradient is this times u."""
        share = y.dtype(1.0)
        if rest[6] > y.dtype(0.0):
            share = secant_of(wp.length(slip(y, rest)), rest[6])
        return share

    @wp.func
    def project(y: Any, rest: Any):
        return y - gradient(y, rest)

    @wp.func
    def prox(v: Any, rest: Any, compliance: Any):
        u = slip(v, rest)
        l = wp.length(u)
        p = v
        if l > v.dtype(0.0):
            p[0] = v[0] - prox_of(l, rest[6], compliance) * u
        return p

    bounded = Term("Friction", 1, 1, 8, rest_state, weight, measure, energy, gradient, bounded_hessian, law=law)
    return Term(
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
        bounded=bounded,
        law=law,
    )


FRICTION = friction(COULOMB)
