"""Factories of the local projections: one Jacobi sweep over the elements of a term.

With ``assemble`` the only kernels that know stencils; none of them knows a material. The step of one element is

    Δλ = (G W Gᵀ + α̃ I)⁻¹ (p(y) − y),   Δxᵢ = wᵢ-weighted rows of Δλ / mᵢ,   α̃ = 1/(k A h²)

with G the weights of y and W the inverse masses; with an infinite stiffness α̃ = 0 and, for springs, this is the projection of
Müller et al. 2006 (*Position based dynamics*). Terms without ``project`` use their scalar constraint,
Δλ = −C/(Σ wᵢ‖∇C‖² + α̃). A stencil of pins alone has nothing to move and gives 0; one with so few free vertices that the matrix
is singular moves y as near to p(y) as they can take it, by the pseudo-inverse.
"""

from functools import cache
from typing import Any

import warp as wp

from .assemble import local_coordinate, types
from .rotation import epsilon
from .term import Term


@wp.func
def pseudo_inverse2(A: Any):
    """A⁻¹ of a symmetric semi-definite 2×2 A, or that of its larger eigenvalue alone where the other is below 4ε of it.

    0 of an infinite A, which is that of no stiffness.
    """
    trace = wp.trace(A)
    if wp.isinf(trace):
        return A.dtype(0.0) * wp.identity(n=2, dtype=A.dtype)
    B = A / trace
    determinant = B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0]
    if determinant > A.dtype(4.0) * epsilon(trace):
        B = wp.matrix_from_rows(wp.vector(B[1, 1], -B[0, 1]), wp.vector(-B[1, 0], B[0, 0])) / determinant
    return B / trace


@cache
def multiplier(term: Term, dtype):
    """The device function (y, rest, inverse masses w of the corners, α̃) → rows (M, 3): Δxᵢ = wᵢ Σ_m weightᵢ[m] rows[m]."""
    vec3, _ = types(dtype)
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    square, corners = wp.types.matrix((term.rows, term.rows), dtype), wp.types.vector(term.vertices, dtype)
    weight, project = term.weight, term.project
    constraint, constraint_gradient = term.constraint, term.constraint_gradient
    if project is not None and term.rows > 2:
        raise NotImplementedError(f"{term.name} projects {term.rows} rows; two at most")

    @wp.func
    def onto_projection(y: y_type, r: rest_type, w: corners, compliance: dtype):
        system = square()
        for i in range(K):
            system += w[i] * wp.outer(weight(r, i), weight(r, i))
        for m in range(M):
            system[m, m] = system[m, m] + compliance
        rows = y_type()
        if wp.trace(system) != dtype(0.0):
            if wp.static(term.rows == 1):
                rows = (project(y, r) - y) / system[0, 0]
            else:
                rows = pseudo_inverse2(system) * (project(y, r) - y)
        return rows

    @wp.func
    def onto_constraint(y: y_type, r: rest_type, w: corners, compliance: dtype):
        g = constraint_gradient(y, r)
        total = compliance
        for i in range(K):
            direction = vec3()
            for m in range(M):
                direction += weight(r, i)[m] * g[m]
            total += w[i] * wp.dot(direction, direction)
        if total == dtype(0.0):
            total = dtype(1.0)
        return g * (-constraint(y, r) / total)

    return onto_constraint if project is None else onto_projection


@cache
def element_rows(term: Term, dtype):
    """The device function (element data, x̃, d, h) → rows of :func:`multiplier` for one element at x̃ + d."""
    vec3, _ = types(dtype)
    K = wp.constant(term.vertices)
    rest_type, corners = wp.types.vector(term.parameters, dtype), wp.types.vector(term.vertices, dtype)
    y_of, measure, rows_of = local_coordinate(term, dtype, True), term.measure, multiplier(term, dtype)

    @wp.func
    def rows(
        stencil: wp.array2d(dtype=wp.int32),
        e: int,
        stiffness: dtype,
        r: rest_type,
        inverse_mass: wp.array(dtype=dtype),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        h: dtype,
    ):
        w = corners()
        for i in range(K):
            w[i] = inverse_mass[stencil[e, i]]
        return rows_of(y_of(stencil, e, r, x, d), r, w, dtype(1.0) / (stiffness * measure(r) * h * h))

    return rows


@cache
def scatter_correction(term: Term, dtype):
    """Kernel over elements: adds Δxᵢ [m] of every element to out. For the CPU, where it runs in order."""
    vec3, _ = types(dtype)
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type = wp.types.vector(term.parameters, dtype)
    rows, weight = element_rows(term, dtype), term.weight

    @wp.kernel(module="unique", enable_backward=False)
    def scatter(
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        inverse_mass: wp.array(dtype=dtype),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        h: dtype,
        out: wp.array(dtype=vec3),
    ):
        e = wp.tid()
        r = rest[e]
        q = rows(stencil, e, stiffness[e], r, inverse_mass, x, d, h)
        for i in range(K):
            w = weight(r, i)
            move = vec3()
            for m in range(M):
                move += w[m] * q[m]
            wp.atomic_add(out, stencil[e, i], inverse_mass[stencil[e, i]] * move)

    return scatter


@cache
def gather_correction(term: Term, dtype):
    """Kernel over vertices: the same sum in a fixed order, through the incidences of :func:`assemble.gather_gradient`."""
    vec3, _ = types(dtype)
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type = wp.types.vector(term.parameters, dtype)
    rows, weight = element_rows(term, dtype), term.weight

    @wp.kernel(module="unique", enable_backward=False)
    def gather(
        offsets: wp.array(dtype=wp.int32),
        incidences: wp.array(dtype=wp.int32),
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        inverse_mass: wp.array(dtype=dtype),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        h: dtype,
        out: wp.array(dtype=vec3),
    ):
        v = wp.tid()
        total = vec3()
        for n in range(offsets[v], offsets[v + 1]):
            e = incidences[n] // K
            r = rest[e]
            q = rows(stencil, e, stiffness[e], r, inverse_mass, x, d, h)
            w = weight(r, incidences[n] - e * K)
            for m in range(M):
                total += w[m] * q[m]
        out[v] = out[v] + inverse_mass[v] * total

    return gather


@cache
def apply_correction(dtype):
    """Kernel over vertices: d += scaleᵢ Σ Δx, and the sum back to 0.

    scaleᵢ is the relaxation ω, or ω/(nᵢ + α) when averaged over the nᵢ constraints of the vertex.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def apply(
        scale: wp.array(dtype=dtype),
        # in and out
        total: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        correction[i] = correction[i] + scale[i] * total[i]
        total[i] = vec3()

    return apply
