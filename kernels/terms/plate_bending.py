"""Bending of a plate: U = Σ ½A κᵀCκ over triangles, κ the second derivatives κ₁₁, κ₂₂, κ₁₂ of the positions, vectors [1/m].

The stiffness is D₁ in N·m. A cell has the vertices of a triangle and those around it, see :mod:`warpcloth.mesh.curvature`. The
weights include a square root of C/D₁, so that κᵀCκ = D₁‖y‖².
"""

from typing import Any

import warp as wp

from ..term import Term


@wp.func
def measure(rest: Any):
    return rest[0]


@wp.func
def energy(y: Any, rest: Any):
    return y.dtype(0.5) * wp.ddot(y, y)


@wp.func
def gradient(y: Any, rest: Any):
    return y


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    return wp.identity(n=9, dtype=y.dtype)


@wp.func
def project(y: Any, rest: Any):
    return y * y.dtype(0.0)


PLATE_BENDING = Term(
    name="PlateBending",
    vertices=0,
    rows=3,
    parameters=1,
    rest_state=None,
    weight=None,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    cells=True,
    project=project,
    linear=True,
    quadratic=True,
)
