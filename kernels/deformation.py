"""Factories of kernels that measure how a surface deforms: gradients of triangles and neighbourhoods, strains, stresses, rates.

A gradient is F̂ (3×3) in the tangent frame T = [t₁, t₂, N] of its element in the reference: its first two columns are the
deformation gradient F (3×2) of the surface, F̂ Tᵀ maps reference to current vectors. Of a triangle the third column is the unit
normal n, so that F̂ has an inverse; of a neighbourhood it is the least-squares image of N. An element without a reference, as a
triangle flatter than :data:`FLATTEST`, has a gradient of NaN; one without a current normal has NaN in the last column alone.
No fourth power of a length is taken: of 1e10 m or 1e-12 m it is no number of float32.

An output that is None is not computed.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from .assemble import types
from .rotation import complement, epsilon, nearest_rotation, scaled3, svd3, svd3x2

# A float32 coordinate is rounded by 6e-8 of its size, so a triangle flatter than this has an area made of rounding.
FLATTEST = 1e-7

MIDPOINT, FORWARD, LOGARITHM = (wp.constant(k) for k in range(3))

# Padé's approximant of log(I + X) as a sum of fractions, good to float64 for ‖X‖ ≤ 0.264 (Higham 2008, Functions of Matrices,
# §11.4): Gauss–Legendre's nodes and weights on [0, 1].
_nodes, _weights = np.polynomial.legendre.leggauss(7)
NODES, WEIGHTS = (wp.constant(wp.types.vector(7, wp.float64)(v)) for v in (0.5 * (_nodes + 1.0), 0.5 * _weights))


@wp.func
def column(A: Any, k: int):
    return wp.vector(A[0, k], A[1, k], A[2, k])


@wp.func
def surface_part(F: Any):
    """The first two columns of F̂, (3×2)."""
    return wp.matrix_from_cols(column(F, 0), column(F, 1))


@wp.func
def undefined(x: Any):
    return type(x)(wp.NAN)


@wp.func
def angle_of(R: Any):
    """Angle of a rotation [rad], 0 to π, as precise near both ends."""
    axial = wp.vector(R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    return wp.atan2(wp.length(axial), wp.trace(R) - R.dtype(1.0))


@wp.func
def angle_between(a: Any, b: Any):
    """Angle of two vectors [rad], 0 to π."""
    return wp.atan2(wp.length(wp.cross(a, b)), wp.dot(a, b))


@wp.func
def angle_of_threads(F: Any, A: Any):
    """Angle between the columns of A = F a (3×2), NaN where one is made of rounding beside F."""
    a = column(A, 0)
    b = column(A, 1)
    found = angle_between(a, b)
    if not (wp.min(wp.length(a), wp.length(b)) > F.dtype(4.0) * epsilon(found) * wp.sqrt(wp.ddot(F, F))):
        found = undefined(found)
    return found


@wp.func
def inverse_beside(A: Any, size: Any):
    """A⁻¹, or NaN where det A is made of rounding beside that of matrices whose columns are as long as ``size``."""
    a = column(A, 0)
    b = column(A, 1)
    c = column(A, 2)
    n = wp.cross(b, c)
    determinant = wp.dot(a, n)
    if not (wp.abs(determinant) > A.dtype(8.0) * epsilon(determinant) * size[0] * size[1] * size[2]):
        determinant = undefined(determinant)
    one = A.dtype(1.0)
    return (one / determinant) * wp.matrix_from_rows(n, wp.cross(c, a), wp.cross(a, b))


@wp.func
def lengths(A: Any):
    return wp.vector(wp.length(column(A, 0)), wp.length(column(A, 1)), wp.length(column(A, 2)))


@wp.func
def square_root(A: Any):
    """The principal square root, by the product form of Denman and Beavers' iteration, scaled (Higham 2008, §6.3)."""
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
    if not (change <= A.dtype(1.0e-3)):  # an eigenvalue that is negative, half a turn
        X[0, 0] = undefined(change)
    return X


@wp.func
def logarithm(A: Any):
    """The principal logarithm, by inverse scaling and squaring (Higham 2008, §11.5); NaN where there is none."""
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


@cache
def frame_triangles(dtype):
    """Kernel over triangles: their frames T in the reference X, Dm⁻¹ = [[r₀, r₁], [0, r₂]] [1/m] and the shortest altitude [m].

    Dm are the edges [X₁ − X₀, X₂ − X₀] in t₁, t₂, with t₁ along the first. Of a triangle whose altitude may be made of what the
    points are rounded by, ``rounding`` [m] each, all are NaN.
    """
    vec3, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def set_frames(
        triangles: wp.array2d(dtype=wp.int32),
        X: wp.array(dtype=vec3),
        # parameters
        rounding: dtype,
        # out
        frames: wp.array(dtype=mat33),
        inverse_edges: wp.array(dtype=vec3),
        sizes: wp.array(dtype=dtype),
    ):
        t = wp.tid()
        a = X[triangles[t, 1]] - X[triangles[t, 0]]
        b = X[triangles[t, 2]] - X[triangles[t, 0]]
        c = b - a
        length = wp.length(a)
        longest = wp.max(wp.max(length, wp.length(b)), wp.length(c))
        first = (dtype(1.0) / length) * a
        normal = wp.cross(first, b)
        altitude = wp.length(normal)
        shortest = altitude * (length / longest)
        if not (shortest > wp.max(dtype(FLATTEST) * longest, dtype(2.0) * rounding)):
            length, altitude, shortest = dtype(wp.NAN), dtype(wp.NAN), dtype(wp.NAN)
        normal = (dtype(1.0) / altitude) * normal
        frames[t] = wp.matrix_from_cols(first, wp.cross(normal, first), normal)
        inverse_edges[t] = vec3(dtype(1.0) / length, -wp.dot(b, first) / (length * altitude), dtype(1.0) / altitude)
        sizes[t] = shortest

    return set_frames


@cache
def triangle_gradients(dtype):
    """Kernel over triangles: F̂ = [F, n], F = [x₁ − x₀, x₂ − x₀] Dm⁻¹ and n its unit normal."""
    vec3, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def find_gradients(
        triangles: wp.array2d(dtype=wp.int32),
        inverse_edges: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        # out
        gradients: wp.array(dtype=mat33),
    ):
        t = wp.tid()
        a = x[triangles[t, 1]] - x[triangles[t, 0]]
        b = x[triangles[t, 2]] - x[triangles[t, 0]]
        r = inverse_edges[t]
        f1 = r[0] * a
        f2 = r[1] * a + r[2] * b
        normal = wp.cross(f1, f2)
        J = wp.length(normal)
        if not (J > dtype(4.0) * epsilon(J) * (wp.length_sq(f1) + wp.length_sq(f2))):
            J = dtype(wp.NAN)
        gradients[t] = wp.matrix_from_cols(f1, f2, (dtype(1.0) / J) * normal)

    return find_gradients


@cache
def unit_directions(dtype):
    """Kernel over triangles: two material directions, columns of edge coefficients α, as unit vectors in the frame of Dm."""
    vec3, _ = types(dtype)
    mat22 = wp.types.matrix((2, 2), dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def set_directions(
        coefficients: wp.array(dtype=mat22),
        inverse_edges: wp.array(dtype=vec3),
        # out
        directions: wp.array(dtype=mat22),
    ):
        t = wp.tid()
        r = inverse_edges[t]
        m0 = dtype(1.0) / r[0]
        m2 = dtype(1.0) / r[2]
        Dm = mat22(m0, -r[1] * m0 * m2, dtype(0.0), m2)
        A = Dm * coefficients[t]
        p = wp.normalize(wp.vector(A[0, 0], A[1, 0]))
        q = wp.normalize(wp.vector(A[0, 1], A[1, 1]))
        directions[t] = wp.matrix_from_cols(p, q)

    return set_directions


@cache
def measure_triangles(dtype):
    """Kernel over triangles: what follows from F = F̂'s first two columns, F = R U = W diag(λ) Vᵀ.

    Outputs: R = W Vᵀ (3×2), U = V diag(λ) Vᵀ and C = FᵀF and E = ½(C − I) (2×2), λ₁ ≥ λ₂, the directions T V and W as
    rows (2×3), the angle of the rotation [r₁, r₂, r₁×r₂] Tᵀ, J = ‖f₁×f₂‖, the stretches ‖F a‖ of material directions and the
    angle between them.
    """
    _, mat33 = types(dtype)
    vec2, mat22 = wp.types.vector(2, dtype), wp.types.matrix((2, 2), dtype)
    mat32, mat23 = wp.types.matrix((3, 2), dtype), wp.types.matrix((2, 3), dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def measure(
        gradients: wp.array(dtype=mat33),
        frames: wp.array(dtype=mat33),
        materials: wp.array(dtype=mat22),
        # out
        gradient: wp.array(dtype=mat32),
        rotation: wp.array(dtype=mat32),
        right_stretch: wp.array(dtype=mat22),
        right_cauchy_green: wp.array(dtype=mat22),
        green_strain: wp.array(dtype=mat22),
        stretch: wp.array(dtype=vec2),
        rest_directions: wp.array(dtype=mat23),
        directions: wp.array(dtype=mat23),
        rotation_angle: wp.array(dtype=dtype),
        area_ratio: wp.array(dtype=dtype),
        length_ratio: wp.array(dtype=vec2),
        angle: wp.array(dtype=dtype),
    ):
        t = wp.tid()
        half = dtype(0.5)
        one = dtype(1.0)
        F = surface_part(gradients[t])
        T = frames[t]
        C = wp.transpose(F) * F
        U, S, V = svd3x2(F)
        R = U * wp.transpose(V)
        if wp.isnan(gradients[t][0, 2]):  # a line or a point has more than one
            R = undefined(R[0, 0]) * R
        f1 = column(F, 0)
        f2 = column(F, 1)
        if gradient:
            gradient[t] = F
        if rotation:
            rotation[t] = R
        if right_stretch:
            P = V * wp.diag(S) * wp.transpose(V)
            mean = half * (P[0, 1] + P[1, 0])
            right_stretch[t] = mat22(P[0, 0], mean, mean, P[1, 1])
        if right_cauchy_green:
            right_cauchy_green[t] = C
        if green_strain:
            # (‖f‖ − 1)(‖f‖ + 1) does not cancel.
            a = wp.length(f1)
            b = wp.length(f2)
            green_strain[t] = half * mat22((a - one) * (a + one), C[0, 1], C[1, 0], (b - one) * (b + one))
        if stretch:
            stretch[t] = S
        if rest_directions:
            rest_directions[t] = wp.transpose(surface_part(T) * V)
        if directions:
            directions[t] = wp.transpose(U)
        if rotation_angle:
            r1 = column(R, 0)
            r2 = column(R, 1)
            rotation_angle[t] = angle_of(wp.matrix_from_cols(r1, r2, wp.cross(r1, r2)) * wp.transpose(T))
        if area_ratio:
            area_ratio[t] = wp.length(wp.cross(f1, f2))
        if materials:
            A = F * materials[t]
            a1 = column(A, 0)
            a2 = column(A, 1)
            if length_ratio:
                length_ratio[t] = vec2(wp.length(a1), wp.length(a2))
            if angle:
                angle[t] = angle_of_threads(F, A)

    return measure


@cache
def measure_stress(dtype, term):
    """Kernel over triangles: ku, P = k∂u/∂F (3×2) and σ = P Fᵀ/J (3×3) of a membrane :class:`..term.Term`, J = ‖f₁×f₂‖."""
    _, mat33 = types(dtype)
    mat32 = wp.types.matrix((3, 2), dtype)
    parameters = wp.types.vector(term.parameters, dtype)
    energy_of, gradient_of = term.energy, term.gradient

    @wp.kernel(module="unique", enable_backward=False)
    def measure(
        gradients: wp.array(dtype=mat33),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=parameters),
        # out
        energy_density: wp.array(dtype=dtype),
        first_piola_stress: wp.array(dtype=mat32),
        cauchy_stress: wp.array(dtype=mat33),
    ):
        t = wp.tid()
        F = surface_part(gradients[t])
        y = wp.transpose(F)
        k = stiffness[t]
        if energy_density:
            energy_density[t] = k * energy_of(y, rest[t])
        P = k * wp.transpose(gradient_of(y, rest[t]))
        if first_piola_stress:
            first_piola_stress[t] = P
        if cauchy_stress:
            n = wp.cross(column(F, 0), column(F, 1))
            J = wp.length(n)
            if not (J > dtype(4.0) * epsilon(J) * wp.ddot(F, F)):
                J = dtype(wp.NAN)
            sigma = (dtype(1.0) / J) * (P * y)
            cauchy_stress[t] = dtype(0.5) * sigma + dtype(0.5) * wp.transpose(sigma)

    return measure


@wp.func
def rate_of(before: Any, after: Any, dt: Any, method: int):
    """ẏ/y of a positive number that goes from one value to another."""
    change = after - before
    if method == MIDPOINT:
        r = type(dt)(2.0) * change / (after + before)
    elif method == FORWARD:
        r = change / before
    else:
        r = wp.log(after / before)
    return r / dt


@cache
def measure_rates(dtype):
    """Kernel over elements: the velocity gradient L = ḞF⁻¹ = D + W and other rates between the gradients F̂₀ and F̂₁.

    L is 2(F̂₁ − F̂₀)(F̂₁ + F̂₀)⁻¹/dt by midpoint, (F̂₁ − F̂₀)F̂₀⁻¹/dt forward, log(F̂₁F̂₀⁻¹)/dt by logarithm. D = P ½(L + Lᵀ) P with
    P the projection to the plane of F̂₁ + F̂₀ (forward: of F̂₀), for the stretch of the normal is not measured; W = ½(L − Lᵀ).
    Rates of stretches and of lengths are of the numbers themselves by the same method; of angles, differences. Points are
    rounded by ``rounding`` [m], and elements in the reference as wide as ``sizes`` [m].
    """
    vec3, mat33 = types(dtype)
    vec2, mat22 = wp.types.vector(2, dtype), wp.types.matrix((2, 2), dtype)

    @wp.func
    def turn(a0: vec2, a1: vec2, b0: vec3, b1: vec3, dt: dtype):
        """Rates of the least turn of a line in the frame, and of one in space."""
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
        before: wp.array(dtype=mat33),
        after: wp.array(dtype=mat33),
        materials: wp.array(dtype=mat22),
        sizes: wp.array(dtype=dtype),
        # parameters
        dt: dtype,
        method: int,
        rounding: dtype,
        # out
        velocity_gradient: wp.array(dtype=mat33),
        rate_of_strain: wp.array(dtype=mat33),
        spin: wp.array(dtype=mat33),
        stretch_rate: wp.array(dtype=vec2),
        rest_direction_rate: wp.array(dtype=dtype),
        direction_rate: wp.array(dtype=vec3),
        length_rate: wp.array(dtype=vec2),
        angle_rate: wp.array(dtype=dtype),
    ):
        e = wp.tid()
        half = dtype(0.5)
        F0 = before[e]
        F1 = after[e]
        if velocity_gradient or rate_of_strain or spin:
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
            if velocity_gradient:
                velocity_gradient[e] = L
            if rate_of_strain:
                n = wp.cross(column(mean, 0), column(mean, 1))
                n = (dtype(1.0) / wp.length(n)) * n
                D = half * (L + wp.transpose(L))
                Dn = D * n
                # P D P, P = I − nnᵀ
                rate_of_strain[e] = D - wp.outer(Dn, n) - wp.outer(n, Dn) + wp.dot(n, Dn) * wp.outer(n, n)
            if spin:
                spin[e] = half * (L - wp.transpose(L))
        if stretch_rate or rest_direction_rate or direction_rate:
            U0, S0, V0 = svd3x2(surface_part(F0))
            U1, S1, V1 = svd3x2(surface_part(F1))
            if stretch_rate:
                stretch_rate[e] = vec2(rate_of(S0[0], S1[0], dt, method), rate_of(S0[1], S1[1], dt, method))
            if rest_direction_rate or direction_rate:
                a0 = wp.vector(V0[0, 0], V0[1, 0])
                a1 = wp.vector(V1[0, 0], V1[1, 0])
                in_frame, in_space = turn(a0, a1, column(U0, 0), column(U1, 0), dt)
                # Of equal stretches every direction is principal, and of those that differ by rounding one is made of it.
                tiny = dtype(16.0) * epsilon(dt) + dtype(4.0) * rounding / sizes[e]
                if not (S0[0] - S0[1] > tiny * S0[0] and S1[0] - S1[1] > tiny * S1[0]):
                    in_frame = dtype(wp.NAN)
                    in_space = in_frame * vec3(dtype(1.0), dtype(1.0), dtype(1.0))
                if rest_direction_rate:
                    rest_direction_rate[e] = in_frame
                if direction_rate:
                    direction_rate[e] = in_space
        if materials:
            f0 = surface_part(F0)
            f1 = surface_part(F1)
            A0 = f0 * materials[e]
            A1 = f1 * materials[e]
            if length_rate:
                l0 = vec2(wp.length(column(A0, 0)), wp.length(column(A0, 1)))
                l1 = vec2(wp.length(column(A1, 0)), wp.length(column(A1, 1)))
                length_rate[e] = vec2(rate_of(l0[0], l1[0], dt, method), rate_of(l0[1], l1[1], dt, method))
            if angle_rate:
                angle_rate[e] = (angle_of_threads(f1, A1) - angle_of_threads(f0, A0)) / dt

    return measure


@cache
def vertex_normals(dtype):
    """Kernel over vertices: unit normals, those of their triangles weighted by area; NaN where these are none or cancel."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def find_normals(
        offsets: wp.array(dtype=wp.int32),
        incident: wp.array(dtype=wp.int32),
        triangles: wp.array2d(dtype=wp.int32),
        x: wp.array(dtype=vec3),
        # out
        normals: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        total = vec3()
        size = dtype(0.0)
        for k in range(offsets[i], offsets[i + 1]):
            t = incident[k]
            o = x[triangles[t, 0]]
            a = x[triangles[t, 1]] - o
            width = wp.length(a)
            if width != dtype(0.0):
                normal = wp.cross((dtype(1.0) / width) * a, x[triangles[t, 2]] - o)
                total += width * normal
                size += width * wp.length(normal)
        total = (dtype(1.0) / size) * total
        length = wp.length(total)
        if not (length > dtype(16.0) * epsilon(size)):
            length = dtype(wp.NAN)
        normals[i] = (dtype(1.0) / length) * total

    return find_normals


@wp.func
def only_rotation(R: Any, B: Any):
    """R, or NaN where B has other nearest rotations: of the singular values of B, two with the sign of det B cancel.

    RᵀB has these, and tr(RᵀB) − RᵀB their sums of two as its eigenvalues.
    """
    C, size = scaled3(B)
    P = wp.transpose(R) * C
    least = wp.determinant(wp.trace(P) * wp.identity(n=3, dtype=B.dtype) - P)
    found = R
    if not (least > B.dtype(16.0) * epsilon(least) and size > B.dtype(0.0)):
        found = undefined(least) * R
    return found


@cache
def neighbourhood_gradients(dtype):
    """Kernel over vertices: fits of the map of a set of points to p = X − X̄ and q = x − x̄, X̄ and x̄ their centroids.

    F = (Σ q pᵀ + l̄² n Nᵀ)(Σ p pᵀ + l̄² N Nᵀ)⁻¹, l̄² the mean of ‖p‖², the least squares of Σ‖q − Fp‖² (Müller et al.
    2005, *Meshless deformations based on shape matching*) with one pair more, (l̄N, l̄n): a set may be planar, and its stretch
    along the normal is then prescribed, to 1. Where p may lie on a line but for what points are rounded by, ``rounding`` [m],
    F is NaN. The outputs are F̂ = F T with T = [t₁, t₂, N], T, the rotation R with the largest tr(RᵀΣqpᵀ) (Kabsch 1976), NaN
    where others have as large a one, the residual √(mean ‖q − Rp‖²) [m], and H = Σ p qᵀ [m²].
    """
    vec3, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def fit(
        offsets: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        reference_normals: wp.array(dtype=vec3),
        X: wp.array(dtype=vec3),
        normals: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        # parameters
        rounding: dtype,
        # out
        gradients: wp.array(dtype=mat33),
        frames: wp.array(dtype=mat33),
        rotations: wp.array(dtype=mat33),
        residuals: wp.array(dtype=dtype),
        cross_covariances: wp.array(dtype=mat33),
    ):
        i = wp.tid()
        first, last = offsets[i], offsets[i + 1]
        share = dtype(1.0) / dtype(wp.max(last - first, 1))
        if last == first:
            share = dtype(wp.NAN)
        Xo, xo = X[i], x[i]
        Xm, xm = vec3(), vec3()
        for k in range(first, last):
            Xm += share * (X[members[k]] - Xo)
            xm += share * (x[members[k]] - xo)
        A, B = mat33(), mat33()
        for k in range(first, last):
            p = X[members[k]] - Xo - Xm
            q = x[members[k]] - xo - xm
            A += share * wp.outer(p, p)
            B += share * wp.outer(q, p)
        if gradients:
            N = reference_normals[i]
            t1, t2 = complement(N)
            T = wp.matrix_from_cols(t1, t2, N)
            one = dtype(1.0)
            scale = one / wp.trace(A)  # l̄⁻²; no cube of a length underflows
            weights = scale * A + share * wp.outer(N, N)
            inverse = inverse_beside(weights, vec3(one, one, one))
            # Of a set in a plane det/share is the lesser of its two variances, over their sum.
            narrow = dtype(2.0) * rounding
            if not (wp.determinant(weights) > share * scale * narrow * narrow):
                inverse = undefined(one) * inverse
            gradients[i] = (scale * B + share * wp.outer(normals[i], N)) * inverse * T
            if frames:
                frames[i] = T
        if cross_covariances:
            cross_covariances[i] = (dtype(1.0) / share) * wp.transpose(B)
        if rotations or residuals:
            R = nearest_rotation(B)
            if rotations:
                rotations[i] = only_rotation(R, B)
            if residuals:
                total = dtype(0.0)
                for k in range(first, last):
                    total += wp.length_sq(x[members[k]] - xo - xm - R * (X[members[k]] - Xo - Xm))
                residuals[i] = wp.sqrt(share * total)

    return fit


@cache
def measure_neighbourhoods(dtype):
    """Kernel over vertices: F = F̂ Tᵀ (3×3), its singular values, those directions as rows (3×3) in the current frame, and the
    angle of R."""
    vec3, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def measure(
        gradients: wp.array(dtype=mat33),
        frames: wp.array(dtype=mat33),
        rotations: wp.array(dtype=mat33),
        # out
        gradient: wp.array(dtype=mat33),
        stretch: wp.array(dtype=vec3),
        directions: wp.array(dtype=mat33),
        rotation_angle: wp.array(dtype=dtype),
    ):
        i = wp.tid()
        if gradient:
            gradient[i] = gradients[i] * wp.transpose(frames[i])
        if stretch or directions:
            U, S, _V = svd3(gradients[i])
            if stretch:
                stretch[i] = S
            if directions:
                directions[i] = wp.transpose(U)
        if rotation_angle:
            rotation_angle[i] = angle_of(rotations[i])

    return measure
