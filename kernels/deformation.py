"""Kernels that measure the deformation of triangles.

F̂ (3×3) is the deformation gradient in the tangent frame T = [t₁, t₂, N] of the reference: two columns F (3×2) of the surface,
and the unit normal n of a triangle or the least-squares image of N of a neighbourhood. F̂ Tᵀ maps reference to current vectors.
It is NaN if the element is degenerate in the reference (flatter than :data:`FLATTEST`), its third column without a current
normal.

Outputs may be None.
"""

from functools import cache
from typing import Any

import warp as wp

from .rotation import epsilon, svd3x2
from .vectors import types

# A float32 coordinate has a relative rounding of 6e-8, so the area of a flatter triangle is rounding error.
FLATTEST = 1e-7


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
    """Angle of a rotation [rad], from 0 to π, precise near both."""
    axial = wp.vector(R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    return wp.atan2(wp.length(axial), wp.trace(R) - R.dtype(1.0))


@wp.func
def angle_between(a: Any, b: Any):
    """Angle of two vectors [rad], 0 to π."""
    return wp.atan2(wp.length(wp.cross(a, b)), wp.dot(a, b))


@wp.func
def angle_of_threads(F: Any, A: Any):
    """Angle of the columns of A = F a (3×2); NaN if one is rounding error of F."""
    a = column(A, 0)
    b = column(A, 1)
    found = angle_between(a, b)
    if not (wp.min(wp.length(a), wp.length(b)) > F.dtype(4.0) * epsilon(found) * wp.sqrt(wp.ddot(F, F))):
        found = undefined(found)
    return found


@wp.func
def inverse_beside(A: Any, size: Any):
    """A⁻¹; NaN if det A is rounding error for columns of lengths ``size``."""
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


@cache
def frame_triangles(dtype):
    """Kernel over triangles: frames T in the reference X, Dm⁻¹ = [[r₀, r₁], [0, r₂]] [1/m] and the shortest altitude [m].

    Dm are the edges [X₁ − X₀, X₂ − X₀] in t₁, t₂, with t₁ along the first. All are NaN if the altitude may be rounding of
    points, ``rounding`` [m].
    """
    vec3, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def set_frames(
        # elements
        triangles: wp.array2d(dtype=wp.int32),
        # state in
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
    """Kernel over triangles: F̂ = [F, n], F = [x₁ − x₀, x₂ − x₀] Dm⁻¹ and n the unit normal."""
    vec3, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def find_gradients(
        # elements
        triangles: wp.array2d(dtype=wp.int32),
        inverse_edges: wp.array(dtype=vec3),
        # state in
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
        # elements
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
def triangle_measures(dtype):
    """Struct of the outputs of :func:`measure_triangles`, (E,), named as the measures."""
    vec2, mat22 = wp.types.vector(2, dtype), wp.types.matrix((2, 2), dtype)
    mat32, mat23 = wp.types.matrix((3, 2), dtype), wp.types.matrix((2, 3), dtype)

    @wp.struct
    class TriangleMeasures:
        deformation_gradient: wp.array(dtype=mat32)
        rotation: wp.array(dtype=mat32)
        right_stretch: wp.array(dtype=mat22)
        right_cauchy_green: wp.array(dtype=mat22)
        green_strain: wp.array(dtype=mat22)
        stretch: wp.array(dtype=vec2)
        rest_directions: wp.array(dtype=mat23)
        directions: wp.array(dtype=mat23)
        rotation_angle: wp.array(dtype=dtype)
        area_ratio: wp.array(dtype=dtype)
        length_ratio: wp.array(dtype=vec2)
        angle: wp.array(dtype=dtype)

    return TriangleMeasures


@cache
def measure_triangles(dtype):
    """Kernel over triangles: measures of F = R U = W diag(λ) Vᵀ, the first two columns of F̂.

    Outputs: R = W Vᵀ (3×2); U = V diag(λ) Vᵀ, C = FᵀF and E = ½(C − I) (2×2); λ₁ ≥ λ₂; the directions T V and W as rows (2×3);
    the angle of the rotation [r₁, r₂, r₁×r₂] Tᵀ; J = ‖f₁×f₂‖; the stretches ‖F a‖ of the material directions a, and the angle
    between the vectors F a.
    """
    _, mat33 = types(dtype)
    vec2, mat22 = wp.types.vector(2, dtype), wp.types.matrix((2, 2), dtype)
    outputs = triangle_measures(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def measure(
        # elements
        frames: wp.array(dtype=mat33),
        materials: wp.array(dtype=mat22),
        # state in
        gradients: wp.array(dtype=mat33),
        # out
        out: outputs,
    ):
        t = wp.tid()
        half = dtype(0.5)
        one = dtype(1.0)
        F = surface_part(gradients[t])
        T = frames[t]
        C = wp.transpose(F) * F
        U, S, V = svd3x2(F)
        R = U * wp.transpose(V)
        if wp.isnan(gradients[t][0, 2]):  # the rotation of a line or a point is not unique
            R = undefined(R[0, 0]) * R
        f1 = column(F, 0)
        f2 = column(F, 1)
        if out.deformation_gradient:
            out.deformation_gradient[t] = F
        if out.rotation:
            out.rotation[t] = R
        if out.right_stretch:
            P = V * wp.diag(S) * wp.transpose(V)
            mean = half * (P[0, 1] + P[1, 0])
            out.right_stretch[t] = mat22(P[0, 0], mean, mean, P[1, 1])
        if out.right_cauchy_green:
            out.right_cauchy_green[t] = C
        if out.green_strain:
            # ‖f‖² − 1 as (‖f‖ − 1)(‖f‖ + 1), which does not cancel.
            a = wp.length(f1)
            b = wp.length(f2)
            out.green_strain[t] = half * mat22((a - one) * (a + one), C[0, 1], C[1, 0], (b - one) * (b + one))
        if out.stretch:
            out.stretch[t] = S
        if out.rest_directions:
            out.rest_directions[t] = wp.transpose(surface_part(T) * V)
        if out.directions:
            out.directions[t] = wp.transpose(U)
        if out.rotation_angle:
            r1 = column(R, 0)
            r2 = column(R, 1)
            out.rotation_angle[t] = angle_of(wp.matrix_from_cols(r1, r2, wp.cross(r1, r2)) * wp.transpose(T))
        if out.area_ratio:
            out.area_ratio[t] = wp.length(wp.cross(f1, f2))
        if materials:
            A = F * materials[t]
            a1 = column(A, 0)
            a2 = column(A, 1)
            if out.length_ratio:
                out.length_ratio[t] = vec2(wp.length(a1), wp.length(a2))
            if out.angle:
                out.angle[t] = angle_of_threads(F, A)

    return measure


@cache
def stress_measures(dtype):
    """Struct of the outputs of :func:`measure_stress`, (T,), named as the measures."""
    _, mat33 = types(dtype)
    mat32 = wp.types.matrix((3, 2), dtype)

    @wp.struct
    class StressMeasures:
        energy_density: wp.array(dtype=dtype)
        first_piola_stress: wp.array(dtype=mat32)
        cauchy_stress: wp.array(dtype=mat33)

    return StressMeasures


@cache
def measure_stress(dtype, term):
    """Kernel over triangles: ku, P = k∂u/∂F (3×2) and σ = P Fᵀ/J (3×3) of a membrane :class:`..term.Term`, J = ‖f₁×f₂‖."""
    _, mat33 = types(dtype)
    outputs = stress_measures(dtype)
    parameters = wp.types.vector(term.parameters, dtype)
    energy_of, gradient_of = term.energy, term.gradient

    @wp.kernel(module="unique", enable_backward=False)
    def measure(
        # elements
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=parameters),
        # state in
        gradients: wp.array(dtype=mat33),
        # out
        out: outputs,
    ):
        t = wp.tid()
        F = surface_part(gradients[t])
        y = wp.transpose(F)
        k = stiffness[t]
        if out.energy_density:
            out.energy_density[t] = k * energy_of(y, rest[t])
        P = k * wp.transpose(gradient_of(y, rest[t]))
        if out.first_piola_stress:
            out.first_piola_stress[t] = P
        if out.cauchy_stress:
            n = wp.cross(column(F, 0), column(F, 1))
            J = wp.length(n)
            if not (J > dtype(4.0) * epsilon(J) * wp.ddot(F, F)):
                J = dtype(wp.NAN)
            sigma = (dtype(1.0) / J) * (P * y)
            out.cauchy_stress[t] = dtype(0.5) * sigma + dtype(0.5) * wp.transpose(sigma)

    return measure
