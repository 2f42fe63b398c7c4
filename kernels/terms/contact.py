"""Contact of a vertex with a collider: U = Σ kA φ(d), k in Pa/m, A the area of the vertex and d its distance to the surface.

With the contact distance r and τ = r/2 (the two stages of Chen et al. 2025, *Offset geometric contact*):

    φ = ½(r − d)²  for τ ≤ d < r,   ½τ² + τ² ln(τ/d)  for d < τ,   0  for d ≥ r

φ is C² at τ and C¹ at r. The force is a pressure: a load p leaves a gap of r − p/k, or τ²k/p if that is below τ. Below δ =
r/1000 φ is its Taylor polynomial of second degree, which pushes a vertex inside out.

Stencil (x₀), y = x₀, measure A. Rest state: the pose of the collider (position, quaternion x, y, z, w), the half sizes and the
radius of its :class:`Solid`, r and A. Infinite half sizes are the half-space below y = 0. Clamping drops φ′∂²d, which is ⪯ 0 if
the shape is convex.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from ..rotation import epsilon
from ..term import Term
from .attachment import weight

# δ/r: below δ φ is a parabola, and no vertex ends a step below δ.
FLOOR = 1e-3
DELTA = wp.constant(FLOOR)
# Offsets in the rest state.
POSE, CORE, RADIUS, DISTANCE, AREA, PARAMETERS = 0, 7, 10, 11, 12, 13
STANDING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def rest_state(points, stencil, pose=STANDING, core=(0.0, 0.0, 0.0), radius=0.0, distance=1e-3, areas=1.0):
    """Rest states (E, 13) of the vertices ``stencil`` (E, 1)."""
    rest = np.empty((len(stencil), PARAMETERS))
    rest[:, POSE:CORE], rest[:, CORE:RADIUS] = pose, core
    rest[:, RADIUS], rest[:, DISTANCE], rest[:, AREA] = radius, distance, areas
    return rest


@wp.func
def measure(rest: Any):
    return rest[12]


@wp.func
def turned(u: Any, w: Any, v: Any):
    """v rotated by the quaternion (u, w)."""
    t = type(w)(2.0) * wp.cross(u, v)
    return v + w * t + wp.cross(u, t)


@wp.func
def rounded_box(X: Any, half: Any, radius: Any):
    """The points at most a radius from a box; the box of a sphere is a point, that of a capsule a segment."""
    zero = type(radius)(0.0)
    away = X - wp.min(wp.max(X, -half), half)
    l = wp.length(away)
    d = l - radius
    n = wp.vector(zero, zero, zero)
    if l > zero:
        n = away / l
    else:
        axis = wp.int32(0)
        for i in range(1, 3):
            if half[i] - wp.abs(X[i]) < half[axis] - wp.abs(X[axis]):
                axis = i
        d = wp.abs(X[axis]) - half[axis] - radius
        n[axis] = wp.where(X[axis] < zero, type(radius)(-1.0), type(radius)(1.0))
    return d, n


@wp.func
def rounded_box_curvature(X: Any, half: Any, radius: Any):
    """That of the distance to a point, a line or a plane, according to the region of X."""
    H = wp.matrix(shape=(3, 3), dtype=X.dtype)
    away = X - wp.min(wp.max(X, -half), half)
    l = wp.length(away)
    if l > X.dtype(0.0):
        H -= wp.outer(away / l, away / l) / l
        for i in range(3):
            if away[i] != X.dtype(0.0):
                H[i, i] += X.dtype(1.0) / l
    return H


class Solid(NamedTuple):
    """A shape of colliders: all points with d ≤ 0.

    Attributes:
        gap: Device function (X, half, radius) → the signed distance d of a point X and ∇d, in the frame of the collider; the
            shape is within ``radius`` of the box with half sizes ``half``.
        convex: Whether the shape is convex.
        curvature: Device function (X, half, radius) → ∂²d; None to find it by differences of ∇d.
    """

    gap: Any
    convex: bool = True
    curvature: Any = None


ROUNDED_BOX = Solid(rounded_box, curvature=rounded_box_curvature)


@cache
def gap_to(solid: Solid):
    """Device function (X, half, radius) → d and ∇d to a shape, or to the half-space below y = 0 if ``half`` is infinite."""
    gap_of_solid = solid.gap

    @wp.func
    def gap(X: Any, half: Any, radius: Any):
        d = X[1]
        n = wp.vector(type(radius)(0.0), type(radius)(1.0), type(radius)(0.0))
        if wp.isfinite(half[0]):
            d, n = gap_of_solid(X, half, radius)
        return d, n

    return gap


@wp.func
def potential(d: Any, r: Any):
    """φ."""
    half = type(r)(0.5)
    tau = half * r
    delta = type(r)(DELTA) * r
    phi = type(r)(0.0)
    if d < tau:
        e = wp.max(d, delta)
        phi = tau * tau * (half + wp.log(tau / e))
        more = wp.min(d - delta, type(r)(0.0)) / delta
        phi += tau * tau * (half * more * more - more)
    elif d < r:
        phi = half * (r - d) * (r - d)
    return phi


@wp.func
def slope(d: Any, r: Any):
    """φ′."""
    tau = type(r)(0.5) * r
    delta = type(r)(DELTA) * r
    found = type(r)(0.0)
    if d < delta:
        found = tau / delta * (tau * (d - delta) / delta - tau)
    elif d < tau:
        found = -tau * tau / d
    elif d < r:
        found = d - r
    return found


@wp.func
def bounded_slope(d: Any, r: Any):
    """φ′ of the quadratic stage alone, which explicit steps take."""
    return wp.min(d - r, type(r)(0.0))


@wp.func
def bend(d: Any, r: Any):
    """φ″; at r its limit from below."""
    tau = type(r)(0.5) * r
    found = type(r)(0.0)
    if d < tau:
        ratio = tau / wp.max(d, type(r)(DELTA) * r)
        found = ratio * ratio
    elif d <= r:
        found = type(r)(1.0)
    return found


@wp.func
def idle(y: Any, rest: Any, margin: Any):
    """Whether a vertex is farther than r + margin from the half-space, or from a bounding ball of the collider."""
    away = y[0] - wp.vector(rest[0], rest[1], rest[2])
    found = wp.bool(False)
    if wp.isfinite(rest[7]):
        size = rest[7] + rest[8] + rest[9] + rest[10] + (rest[11] + margin)
        found = wp.dot(away, away) > y.dtype(1.0001) * size * wp.abs(size)
    else:  # faster than the gap
        u = wp.vector(rest[3], rest[4], rest[5])
        w = rest[6]
        two = y.dtype(2.0)
        n = wp.vector(
            two * (u[0] * u[1] - w * u[2]), y.dtype(1.0) - two * (u[0] * u[0] + u[2] * u[2]), two * (u[1] * u[2] + w * u[0])
        )
        found = wp.dot(n, away) > y.dtype(1.01) * (rest[11] + margin)
    return wp.where(found, wp.int32(1), wp.int32(0))


@wp.func
def gap_after(d: Any, r: Any, compliance: Any):
    """The distance d* with (d* − d)/c = −φ′(d*), in closed form in each stage; r for an infinite compliance c."""
    half = type(r)(0.5)
    tau = half * r
    after = d
    if d < r:
        after = r - (r - d) / (type(r)(1.0) + compliance)
        if after < tau:
            c = compliance * tau * tau
            root = wp.sqrt(half * half * d * d + c)
            if d > type(r)(0.0):
                after = half * d + root
            else:  # a form without cancellation
                after = c / (root - half * d)
            delta = type(r)(DELTA) * r
            if after < delta:
                after = (d + type(r)(2.0) * c / delta) / (type(r)(1.0) + c / (delta * delta))
    return after


@wp.func
def constraint_slope(d: Any, r: Any):
    """C′ = φ′/C."""
    found = type(r)(0.0)
    if d < type(r)(0.5) * r:
        found = -slope(d, r) / wp.sqrt(type(r)(2.0) * potential(d, r))
    elif d < r:
        found = type(r)(1.0)
    return found


@wp.func
def constraint_bend(d: Any, r: Any):
    """C″ = (φ″ − C′²)/C, 0 or less."""
    found = type(r)(0.0)
    if d < type(r)(0.5) * r:
        steep = constraint_slope(d, r)
        found = wp.min((steep * steep - bend(d, r)) / wp.sqrt(type(r)(2.0) * potential(d, r)), found)
    return found


@wp.func
def bounded_hessian(y: Any, rest: Any, negative: Any):
    """I: the Hessian of contact with friction, and a bound of that of contact."""
    return wp.identity(n=3, dtype=y.dtype)


@cache
def contact(solid: Solid):
    local_gap, curvature_of = gap_to(solid), solid.curvature

    @wp.func
    def gap(y: Any, rest: Any):
        u = wp.vector(rest[3], rest[4], rest[5])
        X = turned(-u, rest[6], y[0] - wp.vector(rest[0], rest[1], rest[2]))
        d, n = local_gap(X, wp.vector(rest[7], rest[8], rest[9]), rest[10])
        return d, turned(u, rest[6], n)

    @wp.func
    def curvature(y: Any, rest: Any):
        u = wp.vector(rest[3], rest[4], rest[5])
        half = wp.vector(rest[7], rest[8], rest[9])
        H = wp.matrix(shape=(3, 3), dtype=y.dtype)
        if wp.isfinite(rest[7]):
            X = turned(-u, rest[6], y[0] - wp.vector(rest[0], rest[1], rest[2]))
            if wp.static(solid.curvature is not None):
                H = curvature_of(X, half, rest[10])
            else:
                e = wp.cbrt(epsilon(rest[11])) * rest[11]
                for i in range(3):
                    step = wp.vector(y.dtype(0.0), y.dtype(0.0), y.dtype(0.0))
                    step[i] = e
                    _ahead, n_ahead = local_gap(X + step, half, rest[10])
                    _behind, n_behind = local_gap(X - step, half, rest[10])
                    H[i] = (n_ahead - n_behind) / (e + e)
            for _side in range(2):  # to R H Rᵀ
                for i in range(3):
                    H[i] = turned(u, rest[6], H[i])
                H = wp.transpose(H)
        return H

    @wp.func
    def clearance(y: Any, rest: Any):
        d, _n = gap(y, rest)
        return y.dtype(0.999) * (d - rest[11])

    @wp.func
    def energy(y: Any, rest: Any):
        u = y.dtype(0.0)
        if idle(y, rest, y.dtype(0.0)) == 0:
            d, _n = gap(y, rest)
            u = potential(d, rest[11])
        return u

    @wp.func
    def gradient(y: Any, rest: Any):
        g = wp.matrix(shape=(1, 3), dtype=y.dtype)
        if idle(y, rest, y.dtype(0.0)) == 0:
            d, n = gap(y, rest)
            g[0] = slope(d, rest[11]) * n
        return g

    @wp.func
    def hessian(y: Any, rest: Any, negative: Any):
        d, n = gap(y, rest)
        H = bend(d, rest[11]) * wp.outer(n, n)
        factor = negative
        if wp.static(not solid.convex):  # the part may have both signs
            factor = wp.max(negative, y.dtype(0.0))
        if factor != y.dtype(0.0) and d < rest[11]:
            H += factor * slope(d, rest[11]) * curvature(y, rest)
        return H

    @wp.func
    def prox_from(y: Any, v: Any, rest: Any, compliance: Any):
        d, n = gap(y, rest)
        d += wp.dot(n, v[0] - y[0])
        p = v
        p[0] = v[0] + (gap_after(d, rest[11], compliance) - d) * n
        return p

    @wp.func
    def prox(v: Any, rest: Any, compliance: Any):
        return prox_from(v, v, rest, compliance)

    @wp.func
    def constraint(y: Any, rest: Any):
        """C = −√(2φ), which is d − r for d ≥ τ."""
        d, _n = gap(y, rest)
        return -wp.sqrt(y.dtype(2.0) * potential(d, rest[11]))

    @wp.func
    def constraint_gradient(y: Any, rest: Any):
        d, n = gap(y, rest)
        return wp.matrix_from_rows(constraint_slope(d, rest[11]) * n)

    @wp.func
    def constraint_hessian(y: Any, rest: Any):
        d, n = gap(y, rest)
        return constraint_bend(d, rest[11]) * wp.outer(n, n) + constraint_slope(d, rest[11]) * curvature(y, rest)

    @wp.func
    def stiffening(y: Any, rest: Any, tension: Any):
        """For tension < 0 (pressure) the stiffness along n, without the collider's curvature."""
        d, n = gap(y, rest)
        return wp.matrix_from_rows(wp.sqrt(wp.max(tension * constraint_bend(d, rest[11]), y.dtype(0.0))) * n)

    @wp.func
    def bounded_energy(y: Any, rest: Any):
        d, _n = gap(y, rest)
        depth = bounded_slope(d, rest[11])
        return y.dtype(0.5) * depth * depth

    @wp.func
    def bounded_gradient(y: Any, rest: Any):
        d, n = gap(y, rest)
        return wp.matrix_from_rows(bounded_slope(d, rest[11]) * n)

    bounded = Term("Contact", 1, 1, PARAMETERS, rest_state, weight, measure, bounded_energy, bounded_gradient, bounded_hessian)
    return Term(
        name="Contact",
        vertices=1,
        rows=1,
        parameters=PARAMETERS,
        rest_state=rest_state,
        weight=weight,
        measure=measure,
        energy=energy,
        gradient=gradient,
        hessian=hessian,
        prox=prox,
        prox_from=prox_from,
        idle=idle,
        clearance=clearance,
        gap=gap,
        constraint=constraint,
        constraint_gradient=constraint_gradient,
        constraint_hessian=constraint_hessian,
        stiffening=stiffening,
        stiffening_rows=1,
        bounded=bounded,
    )


CONTACT = contact(ROUNDED_BOX)
