"""Factories of the local projections: one Jacobi sweep over the elements of a term.

With ``assemble`` the only kernels that know stencils; none of them knows a material. The step of one element is

    Δλ = (G W Gᵀ + α̃ I)⁻¹ (p(y) − y),   Δxᵢ = wᵢ-weighted rows of Δλ / mᵢ,   α̃ = 1/(k A h²)

with G the weights of y and W the inverse masses; with an infinite stiffness α̃ = 0 and, for springs, this is the projection of
Müller et al. 2006 (*Position based dynamics*). Terms without ``project`` use their scalar constraint,
Δλ = −C/(Σ wᵢ‖∇C‖² + α̃). A stencil of pins alone has nothing to move and gives 0.
"""

from functools import cache

import warp as wp

from .assemble import local_coordinate, types
from .term import Term


@cache
def multiplier(term: Term, dtype):
    """The device function (element data, x̃, d, h) → rows (M, 3) such that Δxᵢ = W_i Σ_m wᵢ[m] rows[m]."""
    vec3, _ = types(dtype)
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    square = wp.types.matrix((term.rows, term.rows), dtype)
    y_of, weight, measure = local_coordinate(term, dtype, True), term.weight, term.measure
    project, constraint, constraint_gradient = term.project, term.constraint, term.constraint_gradient

    if project is not None:

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
            y = y_of(stencil, e, r, x, d)
            system = square()
            for i in range(K):
                w = weight(r, i)
                system += inverse_mass[stencil[e, i]] * wp.outer(w, w)
            compliance = dtype(1.0) / (stiffness * measure(r) * h * h)
            for m in range(M):
                system[m, m] = system[m, m] + compliance
            result = y_type()
            if wp.trace(system) != dtype(0.0):
                if wp.static(term.rows == 1):
                    result = (project(y, r) - y) / system[0, 0]
                else:
                    result = wp.inverse(system) * (project(y, r) - y)
            return result

    else:

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
            y = y_of(stencil, e, r, x, d)
            g = constraint_gradient(y, r)
            total = dtype(1.0) / (stiffness * measure(r) * h * h)
            for i in range(K):
                w = weight(r, i)
                direction = vec3()
                for m in range(M):
                    direction += w[m] * g[m]
                total += inverse_mass[stencil[e, i]] * wp.dot(direction, direction)
            if total == dtype(0.0):
                total = dtype(1.0)
            return g * (-constraint(y, r) / total)

    return rows


@cache
def scatter_correction(term: Term, dtype):
    """Kernel over elements: adds Δxᵢ [m] of every element to out. For the CPU, where it runs in order."""
    vec3, _ = types(dtype)
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type = wp.types.vector(term.parameters, dtype)
    rows, weight = multiplier(term, dtype), term.weight

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
    rows, weight = multiplier(term, dtype), term.weight

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
