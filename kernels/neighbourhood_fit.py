"""Kernels that fit linear maps to neighbourhoods of vertices, with F̂ and T of :mod:`.deformation`."""

from functools import cache
from typing import Any

import warp as wp

from .deformation import angle_of, inverse_beside, undefined
from .rotation import complement, epsilon, nearest_rotation, scaled3, svd3
from .vectors import types


@cache
def vertex_normals(dtype):
    """Kernel over vertices: unit normals, area-weighted means over triangles; NaN if they cancel."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def find_normals(
        # elements
        offsets: wp.array(dtype=wp.int32),
        incident: wp.array(dtype=wp.int32),
        triangles: wp.array2d(dtype=wp.int32),
        # state in
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
    """R, or NaN if the rotation nearest to B is not unique: its two smallest signed singular values then add to 0."""
    C, size = scaled3(B)
    P = wp.transpose(R) * C
    least = wp.determinant(wp.trace(P) * wp.identity(n=3, dtype=B.dtype) - P)
    found = R
    if not (least > B.dtype(16.0) * epsilon(least) and size > B.dtype(0.0)):
        found = undefined(least) * R
    return found


@cache
def neighbourhood_gradients(dtype):
    """Kernel over vertices: fits F to p = X − X̄ and q = x − x̄ of a set of points, X̄ and x̄ the centroids.

    F = (Σ q pᵀ + l̄² n Nᵀ)(Σ p pᵀ + l̄² N Nᵀ)⁻¹, l̄² the mean of ‖p‖², minimises Σ‖q − Fp‖² (Müller et al. 2005, *Meshless
    deformations based on shape matching*) with the pair (l̄N, l̄n), which makes a planar set unique. It is NaN if p may lie on
    a line within ``rounding`` [m].

    Outputs: F̂ = F T; T = [t₁, t₂, N]; the rotation R with the largest tr(RᵀΣqpᵀ) (Kabsch 1976), NaN if it is not unique; the
    residual √(mean ‖q − Rp‖²) [m]; and H = Σ p qᵀ [m²].
    """
    vec3, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def fit(
        # elements
        offsets: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        reference_normals: wp.array(dtype=vec3),
        X: wp.array(dtype=vec3),
        # state in
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
            scale = one / wp.trace(A)  # of order l̄⁻², so that determinants do not underflow
            weights = scale * A + share * wp.outer(N, N)
            inverse = inverse_beside(weights, vec3(one, one, one))
            # For a planar set det/share is the smaller of its two variances, over their sum.
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
def neighbourhood_measures(dtype):
    """Struct of the outputs of :func:`measure_neighbourhoods`, (N,), named as the measures."""
    vec3, mat33 = types(dtype)

    @wp.struct
    class NeighbourhoodMeasures:
        deformation_gradient: wp.array(dtype=mat33)
        stretch: wp.array(dtype=vec3)
        directions: wp.array(dtype=mat33)
        rotation_angle: wp.array(dtype=dtype)

    return NeighbourhoodMeasures


@cache
def measure_neighbourhoods(dtype):
    """Kernel over vertices: F = F̂ Tᵀ (3×3), singular values, their current directions as rows (3×3), and the angle of R."""
    _, mat33 = types(dtype)
    outputs = neighbourhood_measures(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def measure(
        # state in
        gradients: wp.array(dtype=mat33),
        frames: wp.array(dtype=mat33),
        rotations: wp.array(dtype=mat33),
        # out
        out: outputs,
    ):
        i = wp.tid()
        if out.deformation_gradient:
            out.deformation_gradient[i] = gradients[i] * wp.transpose(frames[i])
        if out.stretch or out.directions:
            U, S, _V = svd3(gradients[i])
            if out.stretch:
                out.stretch[i] = S
            if out.directions:
                out.directions[i] = wp.transpose(U)
        if out.rotation_angle:
            out.rotation_angle[i] = angle_of(rotations[i])

    return measure
