"""Friction of a point of a triangle on a mesh: U = Σ kA H(‖u‖), H and u of :mod:`.friction`, with y = Σ wᵢxᵢ.

Stencil (x₀, x₁, x₂), measure A. Rest state: the anchor, n, ε [m], w₀, w₁, w₂ and A.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from ..coulomb import COULOMB, Law
from .face_contact import any_weight
from .friction import friction

PARAMETERS = 11


def rest_state(points, stencil, areas=1.0):
    """Rest states (E, 11) of the middles of triangles ``stencil`` (E, 3) without contact."""
    rest = np.zeros((len(stencil), PARAMETERS))
    rest[:, 7:10], rest[:, 10] = 1.0 / 3.0, areas
    return rest


@wp.func
def weight(rest: Any, i: int):
    return wp.vector(rest[7 + i], length=1)


@wp.func
def measure(rest: Any):
    return rest[10]


_OF_TRIANGLES: dict[str, Any] = {
    "name": "FaceFriction",
    "vertices": 3,
    "parameters": PARAMETERS,
    "rest_state": rest_state,
    "weight": weight,
    "measure": measure,
}


@cache
def face_friction(law: Law):
    """The :class:`..term.Term` of friction of triangles by a law."""
    term = friction(law)
    bounded = replace(term.bounded, **_OF_TRIANGLES)
    return replace(term, **_OF_TRIANGLES, any_weight=any_weight, idle=None, clearance=None, bounded=bounded)


FACE_FRICTION = face_friction(COULOMB)
