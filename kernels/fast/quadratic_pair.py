"""Pairs of a quadratic energy: U = Σ ½k‖x₁ − x₀‖², k in N/m of either sign.

Stencil (x₀, x₁), y = x₁ − x₀, measure 1; the one number of the rest state is not read. If weights of elements sum to 0, so do
rows of the matrix Q, and ½xᵀQx is the sum over pairs i < j with k = −Qᵢⱼ. Scenes cannot declare this term.
"""

from dataclasses import replace

import numpy as np

from ..terms import spring
from ..terms.quadratic_bending import QUADRATIC_BENDING


def rest_state(points, stencil):
    """Zeros (E, 1)."""
    return np.zeros((len(stencil), 1))


QUADRATIC_PAIR = replace(
    QUADRATIC_BENDING,
    name="QuadraticPair",
    vertices=2,
    parameters=1,
    rest_state=rest_state,
    weight=spring.weight,
    measure=spring.measure,
    dissipation=None,
)
