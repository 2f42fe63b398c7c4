"""Rotations and singular values of 3×3, 3×2 and 2×2 matrices, in float32 and float64, without iteration.

A = U diag(S) Vᵀ, S descending. One singular pair is split off; the remaining 2×2 block has a closed form:

1. The eigenvalues of AᵀA, shifted by their mean and scaled, are the roots of x³ − 3x = 2r with |r| ≤ 1 (Smith 1961,
*Eigenvalues
   of a symmetric 3×3 matrix*). The largest for r ≥ 0, and the smallest for r < 0, is at least √3 from both others. It and its
   eigenvector v, a column of an adjugate, are well conditioned for every A (Eberly 2014, *A robust eigensolver for 3×3
   symmetric matrices*).
2. For the largest, u = Av/‖Av‖. For the smallest, u = cof(A)v/‖cof(A)v‖, which avoids division by a small singular value and
has
   the orientation of UVᵀ.
3. In the right-handed frames (v, v₁, v₂) and (u, u₁, u₂) (Duff et al. 2017, *Building an orthonormal basis, revisited*), A is
   σ ⊕ B up to rounding. B is a multiple of a rotation by atan2(B₁₀ − B₀₁, B₀₀ + B₁₁), plus a multiple of a reflection.

The error is a few ε of the largest singular value, at any scale of A. NaN or infinity in A makes all results NaN.

The "rotation" convention has det U = det V = 1, and S[2] < 0 if det A < 0. UVᵀ is then the rotation R nearest to A, which
maximises tr(RᵀA); for A = Σ w q pᵀ it is that of Kabsch 1976, which rotates p to q. The plain convention has S ≥ 0, det U = ±1.

If S[1] + S[2] is below 3ε S[0], as for rank 1, the result is the smallest rotation that takes v to u, or the identity for A =
0.
"""

from typing import Any

import warp as wp


@wp.func
def epsilon(x: wp.float32):
    """Machine epsilon of this precision."""
    return wp.float32(wp.static(2.0**-23))


@wp.func
def epsilon(x: wp.float64):  # noqa: F811 - Warp chooses by type
    return wp.float64(wp.static(2.0**-52))


@wp.func
def smallest(x: wp.float32):
    """The smallest positive normal number."""
    return wp.float32(wp.static(2.0**-126))


@wp.func
def smallest(x: wp.float64):  # noqa: F811 - likewise
    return wp.float64(wp.static(2.0**-1022))


@wp.func
def unit(c: Any, s: Any, least: Any, c_else: Any, s_else: Any):
    """(c, s) normalised if longer than ``least``; else (c_else, s_else), or (1, 0) if that is below ε² too."""
    length = wp.sqrt(c * c + s * s)
    if length <= least:
        c = c_else
        s = s_else
        length = wp.sqrt(c * c + s * s)
        if length <= epsilon(c) * epsilon(c):
            c = type(c)(1.0)
            s = type(c)(0.0)
            length = type(c)(1.0)
    inverse = type(c)(1.0) / length
    return inverse * c, inverse * s


@wp.func
def half_angle(c: Any, s: Any, length: Any, least: Any):
    """The unit vector at half the angle of (c, s), of length ``length``; (1, 0) if that is not above ``least``."""
    # tan(φ/2) has two forms; this takes the one without cancellation.
    x = length + c
    y = s
    if c < type(c)(0.0):
        x = s
        y = length - c
    return unit(x, y, least, type(c)(1.0), type(c)(0.0))


@wp.func
def complement(n: Any):
    """Unit vectors t₁, t₂ such that (n, t₁, t₂) is right-handed; the other axes for n = the first."""
    one = n.dtype(1.0)
    sign = wp.where(n[0] < n.dtype(0.0), -one, one)
    a = -one / (sign + n[0])
    b = n[1] * n[2] * a
    return (
        wp.vector(-sign * n[1], one + sign * n[1] * n[1] * a, sign * b),
        wp.vector(-n[2], b, sign + n[2] * n[2] * a),
    )


@wp.func
def separated_eigenvector(C: Any):
    """Unit eigenvector of a symmetric 3×3 C for the eigenvalue farthest from the others, and 1 if that is the largest, −1 if
    the smallest.
    """
    one = C.dtype(1.0)
    mean = C.dtype(0.3333333333333333) * wp.trace(C)
    d0 = C[0, 0] - mean
    d1 = C[1, 1] - mean
    d2 = C[2, 2] - mean
    e0 = C[1, 2]
    e1 = C[0, 2]
    e2 = C[0, 1]
    spread = d0 * d0 + d1 * d1 + d2 * d2 + C.dtype(2.0) * (e0 * e0 + e1 * e1 + e2 * e2)
    scale = C.dtype(2.449489742783178) / wp.sqrt(spread)  # √6 scales the roots
    # If the spread is far below rounding, C is isotropic, and the square of the spread could underflow.
    tiny = epsilon(mean) * epsilon(mean) * mean
    if spread <= tiny * tiny:
        scale = C.dtype(0.0)
    d0 *= scale
    d1 *= scale
    d2 *= scale
    e0 *= scale
    e1 *= scale
    e2 *= scale
    r = C.dtype(0.5) * (d0 * (d1 * d2 - e0 * e0) + e2 * (e0 * e1 - e2 * d2) + e1 * (e2 * e0 - d1 * e1))
    side = wp.where(r < C.dtype(0.0), -one, one)
    r = wp.min(wp.abs(r), one)
    # x = 2 cos(acos(r)/3): a cubic with an error of 8e-5, then two steps of Newton's method.
    x = C.dtype(1.732133) + r * (C.dtype(0.330661) + r * (C.dtype(-0.081382) + r * C.dtype(0.018639)))
    for _ in range(2):
        square = x * x
        x = C.dtype(2.0) * (x * square + r) / (C.dtype(3.0) * (square - one))
    d0 -= side * x
    d1 -= side * x
    d2 -= side * x
    # The adjugate is v vᵀ times a number from 6 to 9, so its longest column has the largest diagonal entry.
    a00 = d1 * d2 - e0 * e0
    a11 = d0 * d2 - e1 * e1
    a22 = d0 * d1 - e2 * e2
    a01 = e0 * e1 - e2 * d2
    a02 = e2 * e0 - e1 * d1
    a12 = e1 * e2 - e0 * d0
    v = wp.vector(a00, a01, a02)
    if a11 > wp.max(a00, a22):
        v = wp.vector(a01, a11, a12)
    elif a22 > a00:
        v = wp.vector(a02, a12, a22)
    return (one / wp.length(v)) * v, side


@wp.func
def scaled3(A: Any):
    """A 3×3 A divided by its largest entry, and that entry; the identity and 0 for A = 0."""
    size = wp.max(wp.max(wp.max(wp.abs(A[0]), wp.abs(A[1])), wp.abs(A[2])))
    scale = wp.max(size, smallest(size))  # has a finite inverse
    B = (A.dtype(1.0) / scale) * A
    if size == A.dtype(0.0):
        B = wp.identity(n=3, dtype=A.dtype) + A  # + A, for A may contain NaN, which max ignores
        scale = size
    return B, scale


@wp.func
def separated_pair(A: Any):
    """The singular pair u, v of a scaled 3×3 A to split off, its side, and ‖Av‖ or ‖cof(A)v‖."""
    v, side = separated_eigenvector(wp.transpose(A) * A)
    u = A * v
    if side < A.dtype(0.0):
        a0 = wp.vector(A[0, 0], A[1, 0], A[2, 0])
        a1 = wp.vector(A[0, 1], A[1, 1], A[2, 1])
        a2 = wp.vector(A[0, 2], A[1, 2], A[2, 2])
        u = v[0] * wp.cross(a1, a2) + v[1] * wp.cross(a2, a0) + v[2] * wp.cross(a0, a1)
    size = wp.length(u)
    return (A.dtype(1.0) / size) * u, v, side, size


@wp.func
def frame(n: Any, a: Any, b: Any, side: Any):
    """The matrix with right-handed columns (n, a, b), or (a, b, n) if n has the smallest value."""
    columns = wp.matrix_from_cols(n, a, b)
    if side < type(side)(0.0):
        columns = wp.matrix_from_cols(a, b, n)
    return columns


@wp.func
def plane_rotation(c: Any, s: Any, size: Any, u1: Any, u2: Any, v1: Any, v2: Any):
    """Cosine and sine of the rotation in the plane from (c, s), else of the smallest one between the frames."""
    least = type(c)(3.0) * epsilon(c) * size
    return unit(c, s, least, wp.dot(u1, v1) + wp.dot(u2, v2), wp.dot(u2, v1) - wp.dot(u1, v2))


@wp.func
def descending(s0: Any, s1: Any, s2: Any):
    """Three values in descending order despite rounding; the last keeps its sign."""
    high = wp.max(s0, s1)
    low = wp.min(s0, s1)
    last = wp.min(low, wp.abs(s2))
    middle = wp.max(low, wp.abs(s2))
    return wp.vector(wp.max(high, middle), wp.min(high, middle), wp.where(s2 < type(s2)(0.0), -last, last))


@wp.func
def nearest_rotation(A: Any):
    """The rotation R nearest to a 3×3 A, which maximises tr(RᵀA)."""
    B, _size = scaled3(A)
    u, v, _side, size = separated_pair(B)
    v1, v2 = complement(v)
    u1, u2 = complement(u)
    w1 = B * v1
    w2 = B * v2
    c, s = plane_rotation(wp.dot(u1, w1) + wp.dot(u2, w2), wp.dot(u2, w1) - wp.dot(u1, w2), size, u1, u2, v1, v2)
    return wp.outer(u, v) + wp.outer(c * u1 + s * u2, v1) + wp.outer(c * u2 - s * u1, v2)


@wp.func
def rotation_svd3(A: Any):
    """U, S, V of a 3×3 A with det U = det V = 1; S[2] has the sign of det A."""
    half = A.dtype(0.5)
    B, scale = scaled3(A)
    u, v, side, size = separated_pair(B)
    v1, v2 = complement(v)
    u1, u2 = complement(u)
    w1 = B * v1
    w2 = B * v2
    b00 = wp.dot(u1, w1)
    b01 = wp.dot(u1, w2)
    b10 = wp.dot(u2, w1)
    b11 = wp.dot(u2, w2)
    # The block is half the sum of the scaled rotation (p, q) and the scaled reflection (f, g).
    p = b00 + b11
    q = b10 - b01
    f = b00 - b11
    g = b10 + b01
    total = wp.sqrt(p * p + q * q)
    difference = wp.sqrt(f * f + g * g)
    c, s = plane_rotation(p, q, size, u1, u2, v1, v2)
    # The factor beside the rotation is symmetric; its axes are at half the angle between the two.
    cos, sin = half_angle(c * f + s * g, c * g - s * f, difference, epsilon(size) * epsilon(size) * size)
    x1 = c * u1 + s * u2
    x2 = c * u2 - s * u1
    U = frame(u, cos * x1 + sin * x2, cos * x2 - sin * x1, side)
    V = frame(v, cos * v1 + sin * v2, cos * v2 - sin * v1, side)
    high = half * (total + difference)
    low = half * (total - difference)
    S = descending(size, high, low)
    if side < A.dtype(0.0):
        S = descending(high, low, wp.dot(u, B * v))
    return U, scale * S, V


@wp.func
def svd3(A: Any):
    """U, S, V of a 3×3 A with S ≥ 0 and det V = 1; det U has the sign of det A."""
    U, S, V = rotation_svd3(A)
    if S[2] < A.dtype(0.0):
        S[2] = -S[2]
        for i in range(3):
            U[i, 2] = -U[i, 2]
    return U, S, V


@wp.func
def polar3(A: Any):
    """R, P of a 3×3 A = R P: R the nearest rotation, P symmetric; the smallest eigenvalue of P has the sign of det A."""
    R = nearest_rotation(A)
    P = wp.transpose(R) * A
    return R, A.dtype(0.5) * P + A.dtype(0.5) * wp.transpose(P)


@wp.func
def scaled2(A: Any):
    """:func:`scaled3` for a 2×2 A."""
    size = wp.max(wp.max(wp.abs(A[0]), wp.abs(A[1])))
    scale = wp.max(size, smallest(size))
    B = (A.dtype(1.0) / scale) * A
    if size == A.dtype(0.0):
        B = wp.identity(n=2, dtype=A.dtype) + A  # keeps NaN, as in scaled3
        scale = size
    return B, scale


@wp.func
def nearest_rotation2(A: Any):
    """The rotation R nearest to a 2×2 A; the identity if not unique."""
    one = A.dtype(1.0)
    B, _scale = scaled2(A)
    f = B[0, 0] - B[1, 1]
    g = B[1, 0] + B[0, 1]
    least = A.dtype(3.0) * epsilon(one) * wp.sqrt(f * f + g * g)
    c, s = unit(B[0, 0] + B[1, 1], B[1, 0] - B[0, 1], least, one, A.dtype(0.0))
    return wp.matrix_from_cols(wp.vector(c, s), wp.vector(-s, c))


@wp.func
def rotation_svd2(A: Any):
    """U, S, V of a 2×2 A with det U = det V = 1; S[1] has the sign of det A."""
    one = A.dtype(1.0)
    half = A.dtype(0.5)
    B, scale = scaled2(A)
    p = B[0, 0] + B[1, 1]
    q = B[1, 0] - B[0, 1]
    f = B[0, 0] - B[1, 1]
    g = B[1, 0] + B[0, 1]
    total = wp.sqrt(p * p + q * q)
    difference = wp.sqrt(f * f + g * g)
    c, s = unit(p, q, A.dtype(3.0) * epsilon(one) * difference, one, A.dtype(0.0))
    cos, sin = half_angle(c * f + s * g, c * g - s * f, difference, epsilon(one) * epsilon(one))
    V = wp.matrix_from_cols(wp.vector(cos, sin), wp.vector(-sin, cos))
    U = wp.matrix_from_cols(wp.vector(c, s), wp.vector(-s, c)) * V
    return U, scale * half * wp.vector(total + difference, total - difference), V


@wp.func
def svd2(A: Any):
    """U, S, V of a 2×2 A with S ≥ 0 and det V = 1; det U has the sign of det A."""
    U, S, V = rotation_svd2(A)
    if S[1] < A.dtype(0.0):
        S[1] = -S[1]
        for i in range(2):
            U[i, 1] = -U[i, 1]
    return U, S, V


@wp.func
def polar2(A: Any):
    """R, P of a 2×2 A = R P: R the nearest rotation, P symmetric; the smaller eigenvalue of P has the sign of det A."""
    R = nearest_rotation2(A)
    P = wp.transpose(R) * A
    return R, A.dtype(0.5) * P + A.dtype(0.5) * wp.transpose(P)


@wp.func
def svd3x2(A: Any):
    """U (3×2), S, V (2×2) of a 3×2 A with S ≥ 0, UᵀU = I and det V = 1.

    For rank 1, U Vᵀ has the first columns of the smallest rotation that takes v to u; for A = 0 the first axes.
    """
    zero = A.dtype(0.0)
    one = A.dtype(1.0)
    largest = wp.max(wp.max(wp.max(wp.abs(A[0]), wp.abs(A[1])), wp.abs(A[2])))
    scale = wp.max(largest, smallest(largest))
    a0 = (one / scale) * wp.vector(A[0, 0], A[1, 0], A[2, 0])
    a1 = (one / scale) * wp.vector(A[0, 1], A[1, 1], A[2, 1])
    if largest == zero:
        scale = zero
        a0 = wp.vector(one + A[0, 0], A[1, 0], A[2, 0])
        a1 = wp.vector(A[0, 1], one + A[1, 1], A[2, 1])
    f = wp.dot(a0, a0) - wp.dot(a1, a1)
    g = A.dtype(2.0) * wp.dot(a0, a1)
    cos, sin = half_angle(f, g, wp.sqrt(f * f + g * g), epsilon(one) * epsilon(one))
    u = cos * a0 + sin * a1
    size = wp.length(u)
    u = (one / size) * u
    w = cos * a1 - sin * a0
    u1, u2 = complement(u)
    p = wp.dot(u1, w)
    q = wp.dot(u2, w)
    # v = (cos, sin, 0) has the frame (−sin, cos, 0) and the third axis.
    c, s = plane_rotation(p, q, size, u1, u2, wp.vector(-sin, cos, zero), wp.vector(zero, zero, one))
    U = wp.matrix_from_cols(u, c * u1 + s * u2)
    V = wp.matrix_from_cols(wp.vector(cos, sin), wp.vector(-sin, cos))
    second = wp.sqrt(p * p + q * q)
    return U, scale * wp.vector(wp.max(size, second), wp.min(size, second)), V


@wp.func
def polar3x2(A: Any):
    """R (3×2), P (2×2) of a 3×2 A = R P with RᵀR = I, P symmetric and semi-definite."""
    U, _S, V = svd3x2(A)
    R = U * wp.transpose(V)
    P = wp.transpose(R) * A
    return R, A.dtype(0.5) * P + A.dtype(0.5) * wp.transpose(P)
