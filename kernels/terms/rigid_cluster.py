"""Rigid cluster: U = Σ_cells (κ/2) Σᵢ mᵢ‖xᵢ − (c + R qᵢ)‖², κ in 1/s² (Müller et al. 2005, *Meshless deformations based on
shape matching*; Chao et al. 2010 for the energy).

A cell is a rigid body. c is the centre of mass of its vertices, qᵢ their rest positions about it, and R the rotation nearest to
Σ mᵢ(xᵢ − c)qᵢᵀ (Kabsch 1976). They minimise U, so ∂U/∂xᵢ = κmᵢ(xᵢ − c − R qᵢ). Each vertex of a cell is an element, (x₀), y =
x₀. Its rest state is the displacement to its target, t = c + R q − x₀ [m], and mᵢ [kg], the measure; :mod:`..clusters` sets t
before each evaluation.

The Hessian is bounded by κM, which is used here.
"""

from typing import Any

import numpy as np
import warp as wp

from ..term import Term
from .attachment import hessian, weight


def rest_state(points, stencil, masses=1.0):
    """Returns t = 0 [m] and the masses (one or E) [kg] of the vertices ``stencil`` (E, 1), as an array (E, 4)."""
    return np.column_stack([np.zeros((len(stencil), 3)), np.broadcast_to(masses, len(stencil))])


@wp.func
def measure(rest: Any):
    return rest[3]


@wp.func
def target(rest: Any):
    """Returns t as a matrix of the shape of y."""
    return wp.matrix_from_rows(wp.vector(rest[0], rest[1], rest[2]))


@wp.func
def project(y: Any, rest: Any):
    return y + target(rest)


@wp.func
def gradient(y: Any, rest: Any):
    return -target(rest)


@wp.func
def energy(y: Any, rest: Any):
    t = target(rest)
    return y.dtype(0.5) * wp.ddot(t, t)


RIGID_CLUSTER = Term(
    name="RigidCluster",
    vertices=1,
    rows=1,
    parameters=4,
    rest_state=rest_state,
    weight=weight,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    cells=True,
    project=project,
)
