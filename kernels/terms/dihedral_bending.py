"""Dihedral bending: U = Σ ½D|e|²/(A₁ + A₂)(θ − θ̄)², D the plate's bending stiffness in N·m (Grinspun et al. 2003,
*Discrete shells*; Bridson et al. 2003).

Stencil: a hinge (x₀, x₁ the edge, x₂ and x₃ the opposite vertices). y = (e, a, b) = (x₁, x₂, x₃) − x₀. θ is the signed angle
about e from the normal e×a to the normal b×e, 0 when flat; θ̄, the edge |e| and the areas Aᵢ come from the rest shape. The
papers have a factor 3 where this has 1, with which an equilateral sheet of curvature κ has the energy ½Dκ² per area.

Derivatives (Tamstorf and Grinspun 2013, *Discrete bending forces and their Jacobians*) are a sum of products of two orthogonal
covectors, whose positive and negative halves have closed forms. The vector to the apex of a triangle is a = s e + h m, with m ⟂
e, normal n and t = e/|e|. A variation (δe, δa) moves the apex relative to its foot by d = δa − s δe and turns the edge by ε =
δe/|e|:

    δθ = −Σ n·d/h,        ½δ²θ = Σ (n·d/h)(m·d/h) + (n·ε)(t·d/h + ½m·ε)        over both triangles.

∂²u = ∂θ∂θᵀ + (θ − θ̄)∂²θ is semi-definite only for θ = θ̄.

A triangle of a height up to 1e-6 of its longest side has C = 0 and no force. θ − θ̄ is wrapped into (−π, π]. It jumps in the
fully folded state.
"""

from typing import Any

import numpy as np
import warp as wp

from ..term import Dissipation, Term


def rest_state(points, stencil):
    """Rest angles θ̄ [rad] and the measure |e|²/(A₁ + A₂) [1] of the hinges ``stencil`` (E, 4), as an array (E, 2)."""
    x0, x1, x2, x3 = (points[stencil[:, i]] for i in range(4))
    e = x1 - x0
    n1, n2 = np.cross(e, x2 - x0), np.cross(x3 - x0, e)
    length = np.linalg.norm(e, axis=1)
    sine = np.einsum("ij,ij->i", np.cross(n1, n2), e) / length
    angle = np.arctan2(sine, np.einsum("ij,ij->i", n1, n2))
    areas = 0.5 * (np.linalg.norm(n1, axis=1) + np.linalg.norm(n2, axis=1))
    return np.stack([angle, length**2 / areas], axis=1)


@wp.func
def weight(rest: Any, i: int):
    w = wp.vector(length=3, dtype=rest.dtype)
    if i == 0:
        w = -wp.vector(rest.dtype(1.0), rest.dtype(1.0), rest.dtype(1.0))
    else:
        w[i - 1] = rest.dtype(1.0)
    return w


@wp.func
def measure(rest: Any):
    return rest[1]


@wp.func
def has_no_normal(e: Any, a: Any):
    normal = wp.cross(e, a)
    longest = wp.max(wp.max(wp.dot(e, e), wp.dot(a, a)), wp.dot(a - e, a - e))
    return wp.length(normal) <= e.dtype(1.0e-6) * longest


@wp.func
def has_no_angle(y: Any):
    return has_no_normal(y[0], y[1]) or has_no_normal(y[0], y[2])


@wp.func
def wrap(angle: Any):
    """Wraps an angle in (−3π, 3π) into (−π, π]."""
    pi = type(angle)(wp.pi)
    turn = pi + pi  # a product of literals would be float32
    if angle > pi:
        angle -= turn
    if angle <= -pi:
        angle += turn
    return angle


@wp.func
def constraint(y: Any, rest: Any):
    c = wp.ddot(y, y * y.dtype(0.0))  # 0, and NaN where y is
    if not has_no_angle(y):
        # Not wp.normalize, which turns NaN into 0.
        n1 = wp.cross(y[0], y[1])
        n2 = wp.cross(y[2], y[0])
        n1 /= wp.length(n1)
        n2 /= wp.length(n2)
        c = wrap(wp.atan2(wp.dot(wp.cross(n1, n2), y[0]) / wp.length(y[0]), wp.dot(n1, n2)) - rest[0])
    return c


@wp.func
def apex_covector(direction: Any, foot: Any, corner: int):
    """Returns direction·d, d = δy[corner] − foot·δe, as a covector of the shape of y."""
    g = wp.matrix(shape=(3, 3), dtype=direction.dtype)
    g[0] = -foot * direction
    g[corner] = direction
    return g


@wp.func
def edge_covector(direction: Any):
    """Returns direction·δe as a covector of the shape of y."""
    g = wp.matrix(shape=(3, 3), dtype=direction.dtype)
    g[0] = direction
    return g


@wp.func
def constraint_gradient(y: Any, rest: Any):
    g = y * y.dtype(0.0)
    if not has_no_angle(y):
        e = y[0]
        for corner in range(1, 3):
            normal = wp.cross(e, y[corner])
            if corner == 2:
                normal = -normal
            g -= apex_covector(normal * (wp.length(e) / wp.dot(normal, normal)), wp.dot(y[corner], e) / wp.dot(e, e), corner)
    return g


@wp.func
def flatten(g: Any):
    v = wp.vector(length=9, dtype=g.dtype)
    for i in range(3):
        for j in range(3):
            v[3 * i + j] = g[i, j]
    return v


@wp.func
def positive_half(g: Any, h: Any, ratio: Any, scale: Any):
    """Returns w, w wᵀ the positive half of scale·(g hᵀ + h gᵀ); g ⟂ h, ratio = |h|/|g|."""
    u = flatten(g) * wp.sqrt(ratio)
    v = flatten(h) / wp.sqrt(ratio)
    return wp.sqrt(wp.abs(scale) * scale.dtype(0.5)) * (u + wp.sign(scale) * v)


@wp.func
def product(g: Any, h: Any, ratio: Any, scale: Any, negative: Any):
    """Returns scale·(g hᵀ + h gᵀ), negative half times ``negative``; g ⟂ h, ratio = |h|/|g|."""
    w = positive_half(g, h, ratio, scale)
    half = (scale.dtype(1.0) - negative) * wp.outer(w, w)
    if negative == scale.dtype(0.0):
        return half
    return half + (negative * scale) * (wp.outer(flatten(g), flatten(h)) + wp.outer(flatten(h), flatten(g)))


@wp.func
def factors(y: Any, corner: int):
    """Returns g, h, g', h' and |h'|/|g'| of one triangle: ∂²θ = Σ g hᵀ + h gᵀ + g'h'ᵀ + h'g'ᵀ over both triangles."""
    e = y[0]
    length = wp.length(e)
    t = e / length
    one = y.dtype(1.0)
    normal = wp.cross(e, y[corner])
    if corner == 2:
        normal = -normal
    height = wp.length(normal) / length
    foot = wp.dot(y[corner], e) / (length * length)
    n = normal / wp.length(normal)
    m = (y[corner] - foot * e) / height
    # Lengths of the covectors as functions of all four vertices, so that the split does not depend on which is x₀.
    apex = wp.sqrt(one + foot * foot + (one - foot) * (one - foot)) / height
    edge = wp.sqrt(y.dtype(2.0)) / length
    sigma = apex_covector(t / height, foot, corner) + edge_covector(m * (y.dtype(0.5) / length))
    ratio = wp.sqrt(apex * apex + y.dtype(0.25) * edge * edge) / edge
    return (
        apex_covector(n / height, foot, corner),
        apex_covector(m / height, foot, corner),
        edge_covector(n / length),
        sigma,
        ratio,
    )


@wp.func
def curvature(y: Any, scale: Any, negative: Any):
    """Returns scale·∂²θ, the negative halves of its products times ``negative``."""
    h = wp.matrix(shape=(9, 9), dtype=y.dtype)
    if has_no_angle(y):
        return h
    for corner in range(1, 3):
        g, around, turn, sigma, ratio = factors(y, corner)
        h += product(g, around, y.dtype(1.0), scale, negative)
        h += product(turn, sigma, ratio, scale, negative)
    return h


@wp.func
def stiffening(y: Any, rest: Any, tension: Any):
    rows = wp.matrix(shape=(4, 9), dtype=y.dtype)
    if not has_no_angle(y):
        for corner in range(1, 3):
            g, around, turn, sigma, ratio = factors(y, corner)
            rows[2 * corner - 2] = positive_half(g, around, y.dtype(1.0), tension)
            rows[2 * corner - 1] = positive_half(turn, sigma, ratio, tension)
    return rows


@wp.func
def constraint_hessian(y: Any, rest: Any):
    return curvature(y, y.dtype(1.0), y.dtype(1.0))


@wp.func
def energy(y: Any, rest: Any):
    c = constraint(y, rest)
    return y.dtype(0.5) * c * c


@wp.func
def gradient(y: Any, rest: Any):
    return constraint(y, rest) * constraint_gradient(y, rest)


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    g = flatten(constraint_gradient(y, rest))
    return wp.outer(g, g) + curvature(y, constraint(y, rest), negative)


@wp.func
def change(y: Any, other: Any, rest: Any):
    return wrap(constraint(other, rest) - constraint(y, rest))


@wp.func
def damped_rest(y: Any, change: Any, rest: Any, share: Any):
    r = rest
    r[0] = wrap(rest[0] + share * wrap(constraint(y, rest) + change))
    return r


DIHEDRAL_BENDING = Term(
    name="DihedralBending",
    vertices=4,
    rows=3,
    parameters=2,
    rest_state=rest_state,
    weight=weight,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    constraint=constraint,
    constraint_gradient=constraint_gradient,
    constraint_hessian=constraint_hessian,
    stiffening=stiffening,
    stiffening_rows=4,
    dissipation=Dissipation(change=change, rest=damped_rest),
)
