"""Pairs of a quadratic energy: U = Σ ½k‖x₁ − x₀‖², k in N/m of either sign.

Stencil (x₀, x₁), y = x₁ − x₀, measure 1; the one number of the rest state is not read. Weights of an element that add up to 0
have a matrix Q whose rows do, so that ½xᵀQx is the sum over pairs i < j of k = −Qᵢⱼ. Nothing declares it.
"""

from typing import Any

import numpy as np
import warp as wp

from ..term import Term
from .quadratic_bending import energy, gradient, hessian, project
from .spring import weight


def rest_state(points, stencil):
    """Zeros (E, 1)."""
    return np.zeros((len(stencil), 1))


@wp.func
def measure(rest: Any):
    return rest.dtype(1.0)


QUADRATIC_PAIR = Term(
    name="QuadraticPair",
    vertices=2,
    rows=1,
    parameters=1,
    rest_state=rest_state,
    weight=weight,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    project=project,
    linear=True,
    quadratic=True,
)
