"""Rates between two deformation gradients F̂: the velocity gradient, and rates of measures."""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from .deformation import angle_of_threads, column, inverse_beside, lengths, surface_part, undefined
from .rotation import epsilon, svd3x2
from .vectors import types

MIDPOINT, FORWARD, LOGARITHM = (wp.constant(k) for k in range(3))

# Padé approximant of log(I + X) as partial fractions, accurate to float64 for ‖X‖ ≤ 0.264 (Higham 2008, Functions of Matrices,
# §11.4): Gauss–Legendre nodes and weights on [0, 1].
_nodes, _weights = np.polynomial.legendre.leggauss(7)
NODES, WEIGHTS = (wp.constant(wp.types.vector(7, wp.float64)(v)) for v in (0.5 * (_nodes + 1.0), 0.5 * _weights))


@wp.func
def square_root(A: Any):
    """Principal square root, by the scaled Denman–Beavers iteration (Higham 2008, §6.3)."""
    one = A.dtype(1.0)
    half = A.dtype(0.5)
    I = wp.identity(n=3, dtype=A.dtype)
    X = A
    M = A
    change = one
    for _ in range(24):
        if change > A.dtype(4.0) * epsilon(change):
            mu = one
            if change > A.dtype(0.01):
                mu = wp.pow(wp.abs(wp.determinant(M)), A.dtype(-0.16666666666666666))
            scaled = mu * mu * M
            inverse = inverse_beside(scaled, lengths(scaled))
            X = half * mu * X * (I + inverse)
            M = half * (I + half * (scaled + inverse))
            rest = M - I
            change = wp.sqrt(wp.ddot(rest, rest))
    if not (change <= A.dtype(1.0e-3)):  # not converged: a negative eigenvalue, such as of half a turn
        X[0, 0] = undefined(change)
    return X


@wp.func
def logarithm(A: Any):
    """Principal logarithm, by inverse scaling and squaring (Higham 2008, §11.5), or NaN."""
    I = wp.identity(n=3, dtype=A.dtype)
    X = A
    factor = A.dtype(1.0)
    for _ in range(12):
        rest = X - I
        if wp.ddot(rest, rest) > A.dtype(0.0625):  # 0.25²
            X = square_root(X)
            factor *= A.dtype(2.0)
    rest = X - I
    L = A * A.dtype(0.0)
    for k in range(7):
        B = I + A.dtype(NODES[k]) * rest
        L += A.dtype(WEIGHTS[k]) * (inverse_beside(B, lengths(B)) * rest)
    return factor * L


@wp.func
def rate_of(before: Any, after: Any, dt: Any, method: int):
    """ẏ/y of a positive number y with two values ``dt`` apart."""
    change = after - before
    if method == MIDPOINT:
        r = type(dt)(2.0) * change / (after + before)
    elif method == FORWARD:
        r = change / before
    else:
        r = wp.log(after / before)
    return r / dt


@cache
def rate_measures(dtype):
    """Struct of the outputs of :func:`measure_rates`, (E,), named as the measures."""
    vec3, mat33 = types(dtype)
    vec2 = wp.types.vector(2, dtype)

    @wp.struct
    class RateMeasures:
        velocity_gradient: wp.array(dtype=mat33)
        rate_of_strain: wp.array(dtype=mat33)
        spin: wp.array(dtype=mat33)
        stretch_rate: wp.array(dtype=vec2)
        rest_direction_rate: wp.array(dtype=dtype)
        direction_rate: wp.array(dtype=vec3)
        length_rate: wp.array(dtype=vec2)
        angle_rate: wp.array(dtype=dtype)

    return RateMeasures


@cache
def measure_rates(dtype):
    """Kernel over elements: the velocity gradient L = ḞF⁻¹ = D + Ω and other rates between F̂₀ and F̂₁.

    Methods: midpoint, L = 2(F̂₁ − F̂₀)(F̂₁ + F̂₀)⁻¹/dt; forward, L = (F̂₁ − F̂₀)F̂₀⁻¹/dt; logarithm, L = log(F̂₁F̂₀⁻¹)/dt. D =
    P ½(L + Lᵀ) P, P the projection to the plane of F̂₁ + F̂₀ (forward: of F̂₀). Ω = ½(L − Lᵀ). Stretches and lengths use the
    same method, angles differences. ``rounding`` [m] is that of points, ``sizes`` [m] the widths at rest.
    """
    vec3, mat33 = types(dtype)
    vec2, mat22 = wp.types.vector(2, dtype), wp.types.matrix((2, 2), dtype)
    outputs = rate_measures(dtype)

    @wp.func
    def turn(a0: vec2, a1: vec2, b0: vec3, b1: vec3, dt: dtype):
        """Angular velocities of the smallest rotation of a line: in the frame from a0 to a1, and in space from b0 to b1."""
        s = a0[0] * a1[1] - a0[1] * a1[0]
        c = wp.dot(a0, a1)
        if c < dtype(0.0):
            s = -s
            c = -c
        axis = wp.cross(b0, b1)
        cos = wp.dot(b0, b1)
        if cos < dtype(0.0):
            axis = -axis
            cos = -cos
        sin = wp.length(axis)
        factor = dtype(1.0)
        if sin > dtype(0.0):
            factor = wp.atan2(sin, cos) / sin
        return wp.atan2(s, c) / dt, (factor / dt) * axis

    @wp.kernel(module="unique", enable_backward=False)
    def measure(
        # elements
        materials: wp.array(dtype=mat22),
        sizes: wp.array(dtype=dtype),
        # state in
        before: wp.array(dtype=mat33),
        after: wp.array(dtype=mat33),
        # parameters
        dt: dtype,
        method: int,
        rounding: dtype,
        # out
        out: outputs,
    ):
        e = wp.tid()
        half = dtype(0.5)
        F0 = before[e]
        F1 = after[e]
        if out.velocity_gradient or out.rate_of_strain or out.spin:
            mean = half * (F0 + F1)
            size = half * (lengths(F0) + lengths(F1))
            L = F0
            if method == MIDPOINT:
                L = (F1 - F0) * inverse_beside(mean, size)
            else:
                inverse = inverse_beside(F0, lengths(F0))
                if method == FORWARD:
                    mean = F0
                    L = (F1 - F0) * inverse
                else:
                    L = logarithm(F1 * inverse)
            L = (dtype(1.0) / dt) * L
            if out.velocity_gradient:
                out.velocity_gradient[e] = L
            if out.rate_of_strain:
                n = wp.cross(column(mean, 0), column(mean, 1))
                n = (dtype(1.0) / wp.length(n)) * n
                D = half * (L + wp.transpose(L))
                Dn = D * n
                # P D P, P = I − nnᵀ
                out.rate_of_strain[e] = D - wp.outer(Dn, n) - wp.outer(n, Dn) + wp.dot(n, Dn) * wp.outer(n, n)
            if out.spin:
                out.spin[e] = half * (L - wp.transpose(L))
        if out.stretch_rate or out.rest_direction_rate or out.direction_rate:
            U0, S0, V0 = svd3x2(surface_part(F0))
            U1, S1, V1 = svd3x2(surface_part(F1))
            if out.stretch_rate:
                out.stretch_rate[e] = vec2(rate_of(S0[0], S1[0], dt, method), rate_of(S0[1], S1[1], dt, method))
            if out.rest_direction_rate or out.direction_rate:
                a0 = wp.vector(V0[0, 0], V0[1, 0])
                a1 = wp.vector(V1[0, 0], V1[1, 0])
                in_frame, in_space = turn(a0, a1, column(U0, 0), column(U1, 0), dt)
                # For equal stretches every direction is principal; for stretches that differ by rounding, rounding decides.
                tiny = dtype(16.0) * epsilon(dt) + dtype(4.0) * rounding / sizes[e]
                if not (S0[0] - S0[1] > tiny * S0[0] and S1[0] - S1[1] > tiny * S1[0]):
                    in_frame = dtype(wp.NAN)
                    in_space = in_frame * vec3(dtype(1.0), dtype(1.0), dtype(1.0))
                if out.rest_direction_rate:
                    out.rest_direction_rate[e] = in_frame
                if out.direction_rate:
                    out.direction_rate[e] = in_space
        if materials:
            f0 = surface_part(F0)
            f1 = surface_part(F1)
            A0 = f0 * materials[e]
            A1 = f1 * materials[e]
            if out.length_rate:
                l0 = vec2(wp.length(column(A0, 0)), wp.length(column(A0, 1)))
                l1 = vec2(wp.length(column(A1, 0)), wp.length(column(A1, 1)))
                out.length_rate[e] = vec2(rate_of(l0[0], l1[0], dt, method), rate_of(l0[1], l1[1], dt, method))
            if out.angle_rate:
                out.angle_rate[e] = (angle_of_threads(f1, A1) - angle_of_threads(f0, A0)) / dt

    return measure
