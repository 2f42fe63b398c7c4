"""Strain limit of triangles: U = Σ ½kA‖F − p(F)‖², k in N/m, p(F) the nearest F with σ_min ≤ σᵢ ≤ σ_max (Thomaszewski,
Pabst and Straßer 2009, *Continuum-based strain limiting*).

F (3×2) is the deformation gradient of a triangle (:mod:`..membrane`), with singular values σᵢ, which p clamps; a collapsed F
takes the smallest rotation. Inside the range there is no energy; an infinite k makes it a hard constraint.
"""

from typing import Any

import numpy as np
import warp as wp

from ..membrane import edge_max_lengths, inverse_edges, measure, range_energy, range_gradient, range_hessian, weight
from ..term import Term


def rest_state(points, stencil, least=-np.inf, most=np.inf):
    """Inverse rest edges [1/m] of the triangles ``stencil`` (E, 3), σ_min and σ_max (one or E each), as an array (E, 5)."""
    E = len(stencil)
    return np.column_stack([inverse_edges(points, stencil), np.broadcast_to(least, E), np.broadcast_to(most, E)])


def max_lengths(points, stencil, rest):
    """Returns the edges, no longer than σ_max times their length at rest."""
    return edge_max_lengths(points, stencil, rest[:, 4])


@wp.func
def energy(y: Any, rest: Any):
    return range_energy(y, rest[3], rest[4])


@wp.func
def gradient(y: Any, rest: Any):
    return range_gradient(y, rest[3], rest[4])


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    return range_hessian(y, rest[3], rest[4], negative)


@wp.func
def project(y: Any, rest: Any):
    return y - gradient(y, rest)


STRAIN_LIMIT = Term(
    name="StrainLimit",
    vertices=3,
    rows=2,
    parameters=5,
    rest_state=rest_state,
    weight=weight,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    dead_zone=True,
    max_lengths=max_lengths,
    project=project,
)
