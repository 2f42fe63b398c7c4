"""Functions of the deformation gradient F of a triangle that membrane energies share.

Stencil: a triangle (x₀, x₁, x₂). F (3×2) = [x₁ − x₀, x₂ − x₀] Dm⁻¹, Dm the rest edges in the triangle's tangent frame, the
first along an axis; rows of y are columns of F. A rest state begins with Dm⁻¹: r₀ = Dm⁻¹₀₀, r₁ = Dm⁻¹₀₁, r₂ = Dm⁻¹₁₁ [1/m]. The
measure is the area ½ det Dm [m²].

An isotropic energy ψ(σ₁, σ₂) of the singular values of F = U diag(σ) Vᵀ, u₃ = u₁×u₂, has ∂ψ/∂F = Σ ψᵢ uᵢvᵢᵀ, and its Hessian
the eigenmatrices (Smith, De Goes and Kim 2019, *Analytic eigensystems for isotropic distortion energies*; here of 3×2)

    stretch     u₁v₁ᵀ and u₂v₂ᵀ, mixed by the 2×2 matrix ψᵢⱼ
    twist       (u₂v₁ᵀ − u₁v₂ᵀ)/√2     (ψ₁ + ψ₂)/(σ₁ + σ₂)
    flip        (u₂v₁ᵀ + u₁v₂ᵀ)/√2     (ψ₁ − ψ₂)/(σ₁ − σ₂)
    out of the plane    u₃vᵢᵀ           ψᵢ/σᵢ
"""

from typing import Any

import numpy as np
import warp as wp

from .rotation import svd3x2


def side_axes(points, triangles):
    """Two orthonormal axes in the plane of each triangle (T, 3), the first along its first side, (T, 2, 3)."""
    x = points[triangles]
    side, other = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
    side = side / np.linalg.norm(side, axis=1)[:, None]
    across = np.cross(np.cross(side, other), side)
    return np.stack([side, across / np.linalg.norm(across, axis=1)[:, None]], axis=1)


def inverse_edges(points, stencil):
    """r₀, r₁, r₂ [1/m] of the triangles ``stencil`` (E, 3), (E, 3)."""
    a, b = points[stencil[:, 1]] - points[stencil[:, 0]], points[stencil[:, 2]] - points[stencil[:, 0]]
    length = np.linalg.norm(a, axis=1)
    height = np.linalg.norm(np.cross(a, b), axis=1) / length
    along = np.einsum("ij,ij->i", a, b) / length
    return np.stack([1.0 / length, -along / (length * height), 1.0 / height], axis=1)


def material_state(points, stencil, poisson_ratio=0.0):
    """:func:`inverse_edges` of triangles (E, 3), μ/k = 1/(2(1 + ν)) and λ/k = ν/(1 − ν²) of Poisson's ratio ν (one or E), (E,
    5).
    """
    nu = np.broadcast_to(poisson_ratio, len(stencil))
    return np.column_stack([inverse_edges(points, stencil), 0.5 / (1.0 + nu), nu / (1.0 - nu**2)])


def edge_max_lengths(points, stencil, stretch):
    """``max_lengths`` of triangles (E, 3) with stretches up to ``stretch`` (E,): edges, each with a third of Σ kL² = 2A."""
    pairs = stencil[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    sides = points[pairs[:, 1]] - points[pairs[:, 0]]
    squares = np.einsum("ij,ij->i", sides, sides)
    normals = np.cross(sides[::3], sides[1::3])
    areas = 0.5 * np.linalg.norm(normals, axis=1)
    return pairs, np.repeat(stretch, 3) * np.sqrt(squares), np.repeat(2.0 / 3.0 * areas, 3) / squares


@wp.func
def weight(rest: Any, i: int):
    w = wp.vector(length=2, dtype=rest.dtype)
    if i == 0:
        w[0] = -rest[0]
        w[1] = -(rest[1] + rest[2])
    elif i == 1:
        w[0] = rest[0]
        w[1] = rest[1]
    else:
        w[1] = rest[2]
    return w


@wp.func
def measure(rest: Any):
    return rest.dtype(0.5) / (rest[0] * rest[2])


@wp.func
def green_strain(y: Any):
    """E₀₀, E₁₁, E₀₁ of E = ½(FᵀF − I)."""
    half = y.dtype(0.5)
    one = y.dtype(1.0)
    return wp.vector(half * (wp.dot(y[0], y[0]) - one), half * (wp.dot(y[1], y[1]) - one), half * wp.dot(y[0], y[1]))


@wp.func
def covector(a: Any, b: Any):
    """Rows a and b laid out as y is."""
    v = wp.vector(length=6, dtype=a.dtype)
    for row in range(3):
        v[row] = a[row]
        v[3 + row] = b[row]
    return v


@wp.func
def decompose(y: Any):
    """U (3×2), σ and V (2×2) of F."""
    return svd3x2(wp.transpose(y))


@wp.func
def dyad(u: Any, v: Any):
    """u vᵀ as a vector, laid out as y row by row."""
    a = wp.vector(length=6, dtype=u.dtype)
    for m in range(2):
        for row in range(3):
            a[3 * m + row] = v[m] * u[row]
    return a


@wp.func
def scaled_if_negative(value: Any, negative: Any):
    """An eigenvalue, times ``negative`` if it is below 0."""
    if value < type(value)(0.0):
        value = negative * value
    return value


@wp.func
def scaled_negative_part(B: Any, negative: Any):
    """A symmetric 2×2 matrix with its negative eigenvalues times ``negative``, without eigenvectors."""
    half = B.dtype(0.5)
    mean = half * (B[0, 0] + B[1, 1])
    difference = half * (B[0, 0] - B[1, 1])
    radius = wp.sqrt(difference * difference + B[0, 1] * B[0, 1])
    high = mean + radius
    low = mean - radius
    K = B
    if negative != B.dtype(1.0) and low < B.dtype(0.0):
        K = negative * B
        if high > B.dtype(0.0):  # eigenvalues of opposite signs are distinct
            K += ((B.dtype(1.0) - negative) * high / (high - low)) * (B - low * wp.identity(n=2, dtype=B.dtype))
    return K


@wp.func
def isotropic_hessian(U: Any, V: Any, stretch: Any, twist: Any, flip: Any, out1: Any, out2: Any, negative: Any):
    """∂²ψ/∂y² (6×6) from the 2×2 matrix and the four eigenvalues of the table."""
    u1 = wp.vector(U[0, 0], U[1, 0], U[2, 0])
    u2 = wp.vector(U[0, 1], U[1, 1], U[2, 1])
    u3 = wp.cross(u1, u2)
    v1 = wp.vector(V[0, 0], V[1, 0])
    v2 = wp.vector(V[0, 1], V[1, 1])
    B = scaled_negative_part(stretch, negative)
    half = U.dtype(0.5)
    a = dyad(u1, v1)
    b = dyad(u2, v2)
    c = dyad(u2, v1)
    d = dyad(u1, v2)
    H = wp.outer(a, B[0, 0] * a + B[0, 1] * b) + wp.outer(b, B[0, 1] * a + B[1, 1] * b)
    H += wp.outer((half * scaled_if_negative(twist, negative)) * (c - d), c - d)
    H += wp.outer((half * scaled_if_negative(flip, negative)) * (c + d), c + d)
    a = dyad(u3, v1)
    b = dyad(u3, v2)
    H += wp.outer(scaled_if_negative(out1, negative) * a, a)
    return H + wp.outer(scaled_if_negative(out2, negative) * b, b)


# --- the distance to the F whose singular values lie in a range, u = ½‖F − p‖² = ½Σ(σᵢ − cᵢ)², cᵢ = σᵢ clamped to it


@wp.func
def clamped(S: Any, sigma_min: Any, sigma_max: Any):
    return wp.vector(wp.min(wp.max(S[0], sigma_min), sigma_max), wp.min(wp.max(S[1], sigma_min), sigma_max))


@wp.func
def range_energy(y: Any, sigma_min: Any, sigma_max: Any):
    _U, S, _V = decompose(y)
    excess = S - clamped(S, sigma_min, sigma_max)
    return y.dtype(0.5) * wp.dot(excess, excess)


@wp.func
def range_gradient(y: Any, sigma_min: Any, sigma_max: Any):
    """F − p, exactly 0 inside the range. For σ = 0 the direction is that of U."""
    U, S, V = decompose(y)
    excess = S - clamped(S, sigma_min, sigma_max)
    return wp.transpose(U * wp.diag(excess) * wp.transpose(V))


@wp.func
def secant(excess: Any, size: Any, target: Any):
    """excess/size; 0 without excess; 1 if size ≤ 1e-12 target, that is, collapsed."""
    k = excess
    if excess != type(excess)(0.0):
        k = type(excess)(1.0)
        if not (size <= target * type(excess)(1.0e-12)):
            k = excess / size
    return k


@wp.func
def tangent(size: Any, sigma_min: Any, sigma_max: Any):
    """∂(σ − c)/∂σ: 1, and 0 inside the range."""
    k = type(size)(1.0)
    if size > sigma_min and size < sigma_max:
        k = type(size)(0.0)
    return k


@wp.func
def range_hessian(y: Any, sigma_min: Any, sigma_max: Any, negative: Any):
    """∂²u/∂y², at a bound of the range from outside; only twist and the last two eigenvalues can be negative."""
    U, S, V = decompose(y)
    c = clamped(S, sigma_min, sigma_max)
    excess = S - c
    stretch = wp.matrix(shape=(2, 2), dtype=y.dtype)
    stretch[0, 0] = tangent(S[0], sigma_min, sigma_max)
    stretch[1, 1] = tangent(S[1], sigma_min, sigma_max)
    flip = tangent(S[0], sigma_min, sigma_max)
    if S[0] > S[1]:
        flip = y.dtype(1.0) - (c[0] - c[1]) / (S[0] - S[1])
    twist = secant(excess[0] + excess[1], S[0] + S[1], c[0] + c[1])
    out1 = secant(excess[0], S[0], c[0])
    out2 = secant(excess[1], S[1], c[1])
    return isotropic_hessian(U, V, stretch, twist, flip, out1, out2, negative)
