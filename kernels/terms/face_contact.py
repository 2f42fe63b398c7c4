"""Contact of a point of a triangle with a half-space: U = Σ kA φ(d), φ and k as in :mod:`.contact`, A at most its area.

The point and the half-space are those of a pair, of the triangle and a vertex of a mesh, or of one of its edges and an edge of
the mesh. The half-space touches the mesh; the pair is fixed where a step begins.

Stencil (x₀, x₁, x₂), y = Σ wᵢxᵢ, measure A. Rest state: that of :mod:`.contact` but for A, then w₀, w₁, w₂ and A.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from .contact import AREA, CONTACT
from .contact import rest_state as of_vertices

WEIGHTS, PARAMETERS = AREA, AREA + 4
PAIRS = 3  # of a triangle and a mesh, at most
# A bound of the sum of wᵢ over that of 1/3, which is the weight where limits of explicit steps are found.
STEEPEST = wp.constant(3.0)


def rest_state(points, stencil, areas=1.0, **shape):
    """Rest states (E, 16) of the middles of triangles ``stencil`` (E, 3); ``shape`` as for contact of vertices."""
    rest = np.empty((len(stencil), PARAMETERS))
    rest[:, :WEIGHTS] = of_vertices(points, stencil, **shape)[:, :AREA]
    rest[:, WEIGHTS:-1], rest[:, -1] = 1.0 / 3.0, areas
    return rest


@wp.func
def weight(rest: Any, i: int):
    return wp.vector(rest[12 + i], length=1)


@wp.func
def measure(rest: Any):
    return rest[15]


@wp.func
def any_weight(rest: Any, i: int):
    """Row i has the weight 1: the sum of all squares is a bound of that of y, whatever the weights."""
    w = wp.vector(rest.dtype(0.0), rest.dtype(0.0), rest.dtype(0.0))
    w[i] = rest.dtype(1.0)
    return w


@wp.func
def bounded_hessian(y: Any, rest: Any, negative: Any):
    return y.dtype(STEEPEST) * wp.identity(n=3, dtype=y.dtype)


_OF_TRIANGLES: dict[str, Any] = {
    "name": "FaceContact",
    "vertices": 3,
    "parameters": PARAMETERS,
    "rest_state": rest_state,
    "weight": weight,
    "measure": measure,
}
BOUNDED_FACE_CONTACT = replace(CONTACT.bounded, hessian=bounded_hessian, **_OF_TRIANGLES)

FACE_CONTACT = replace(
    CONTACT,
    **_OF_TRIANGLES,
    any_weight=any_weight,
    prox_from=None,
    idle=None,
    clearance=None,
    gap=None,
    bounded=BOUNDED_FACE_CONTACT,
)
