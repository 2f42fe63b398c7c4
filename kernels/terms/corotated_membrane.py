"""Corotated membrane: U = Σ ½kA‖F − R‖², k = 2μ = Et in N/m, Poisson's ratio 0 (Sorkine and Alexa 2007; Chao et al. 2010, *A
simple geometric model for elastic deformation*).

F (3×2) is the deformation gradient of a triangle (:mod:`..membrane`), A its rest area, R the nearest matrix with RᵀR = I; where
not unique, the smallest rotation, so that a collapsed triangle has a force. The energy per area is μΣ(σᵢ − 1)².
"""

from typing import Any

import numpy as np
import warp as wp

from ..membrane import edge_max_lengths, inverse_edges, measure, range_energy, range_gradient, range_hessian, weight
from ..term import Term
from .membrane_damping import DISSIPATION


def rest_state(points, stencil):
    """Inverse rest edges [1/m] of the triangles ``stencil`` (E, 3) as an array (E, 3)."""
    return inverse_edges(points, stencil)


def max_lengths(points, stencil, rest):
    """Returns the edges, no longer than at rest."""
    return edge_max_lengths(points, stencil, np.ones(len(stencil)))


@wp.func
def energy(y: Any, rest: Any):
    return range_energy(y, y.dtype(1.0), y.dtype(1.0))


@wp.func
def gradient(y: Any, rest: Any):
    return range_gradient(y, y.dtype(1.0), y.dtype(1.0))


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    return range_hessian(y, y.dtype(1.0), y.dtype(1.0), negative)


@wp.func
def project(y: Any, rest: Any):
    return y - gradient(y, rest)


COROTATED_MEMBRANE = Term(
    name="CorotatedMembrane",
    vertices=3,
    rows=2,
    parameters=3,
    rest_state=rest_state,
    weight=weight,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    max_lengths=max_lengths,
    project=project,
    dissipation=DISSIPATION,
)
