"""Kernels of the constraint rows of a term: values and slopes, element by element.

A scalar constraint C has one row, with the covector ∂C/∂y. If ``curved``, it also has the rows of ``stiffening``, with value 0
and compliance 1: at tension −λ they add BᵀB ⪰ −λ∂²C to the masses. Other elements have 3M rows y − p(y) with p held, so their
Jacobian is the constant G of weights. Rows are ordered by copy, then by term.

A row is inactive without stiffness or gradient or within a limit: its covector, value and λ are 0, its compliance 1.

The key is (term, dtype, scalar, curved).
"""

from functools import cache
from typing import Any

import warp as wp

from .local import local_coordinate
from .rotation import epsilon
from .term import Term
from .transpose import to_corner
from .vectors import types

# The number of roundings of a row: of positions, of y, of C and of the force.
ROUNDINGS = wp.constant(4.0)


@wp.struct
class RowLayout:
    """Where the rows of a term are: a copy has ``rows_per_copy`` rows, those of the term begin at ``first``, for ``per_copy``
    elements.
    """

    per_copy: int
    first: int
    rows_per_copy: int


@wp.func
def first_row(e: int, layout: RowLayout, rows: int):
    """The first of the ``rows`` rows of element e."""
    copy = e // layout.per_copy
    return copy * layout.rows_per_copy + layout.first + (e - copy * layout.per_copy) * rows


@cache
def row_values(dtype):
    """Struct of the values of all rows at x̃ + d, see :func:`linearise`."""

    @wp.struct
    class RowValues:
        multipliers: wp.array(dtype=dtype)
        gap: wp.array(dtype=dtype)
        compliance: wp.array(dtype=dtype)
        inverse: wp.array(dtype=dtype)
        residual: wp.array(dtype=wp.float64)
        rounding: wp.array(dtype=wp.float64)
        carried: wp.array(dtype=wp.float64)

    return RowValues


def row_count(term: Term, scalar: bool, curved: bool):
    if not scalar:
        return 3 * term.rows
    return 1 + (term.stiffening_rows if curved else 0)


def slope_type(term: Term, dtype, scalar: bool, curved: bool):
    """Type of an element's Jacobian: covectors (rows, 3M), or a number (1 if active) if constant."""
    return wp.types.matrix((row_count(term, scalar, curved), 3 * term.rows), dtype) if scalar else dtype


@cache
def covector_row(term: Term, dtype, scalar: bool, curved: bool):
    """Device function (covectors, j) → covector j as y (M, 3), or None if constant."""
    M, y_type, slope = wp.constant(term.rows), wp.types.matrix((term.rows, 3), dtype), slope_type(term, dtype, scalar, curved)

    @wp.func
    def row_of(covectors: slope, j: int):
        z = y_type()
        for m in range(M):
            for a in range(3):
                z[m, a] = covectors[j, 3 * m + a]
        return z

    return row_of if scalar else None


@wp.func
def lowest_compliance(alpha: Any, least: Any):
    """The smallest α̃ over the diagonal of J W Jᵀ: ``least`` for hard rows (α̃ = 0), ε for soft ones."""
    return wp.where(alpha == type(alpha)(0.0), least, epsilon(least))


@cache
def set_projected_row(dtype):
    """Device function that sets the values of a vector c = y − p(y) from row j on, as :func:`linearise`.

    ``total`` is the diagonal of G W Gᵀ, ``most`` the largest |w|/m, and ``size`` bounds the summands of y.
    """
    vec3, _ = types(dtype)

    @wp.func
    def set_row(
        j: int,
        c: vec3,
        total: dtype,
        most: dtype,
        size: dtype,
        alpha: dtype,
        least: dtype,
        active: bool,
        rows: row_values(dtype),
    ):
        excess = wp.max(lowest_compliance(alpha, least) * total - alpha, dtype(0.0))
        diagonal = total + (alpha + excess)
        inverted = wp.where(diagonal == dtype(0.0), dtype(0.0), dtype(1.0) / diagonal)
        row = vec3()
        force = vec3()
        for a in range(3):
            if not active:
                rows.multipliers[j + a] = dtype(0.0)
            force[a] = rows.multipliers[j + a]
            row[a] = c[a] + (alpha + excess) * force[a]
            rows.gap[j + a] = row[a]
            rows.compliance[j + a] = alpha + excess
            rows.inverse[j + a] = inverted
        rows.carried[j] = wp.float64(most * excess * wp.length(force) * inverted)
        rows.residual[j] = wp.float64(most * wp.length(row) * inverted)
        lost = most * (size * inverted + wp.length(force))
        rows.rounding[j] = wp.float64(dtype(ROUNDINGS) * epsilon(lost) * lost)

    return set_row


@cache
def linearise(term: Term, dtype, scalar: bool, curved: bool):
    """Kernel over elements at x̃ + d: gap = C + α̃λ, the Jacobian, α̃ = 1/(kAh²), the inverse diagonal of J W Jᵀ + α̃.

    Hard rows have the fraction ``least`` of the diagonal of J W Jᵀ for α̃, as redundant rows leave λ undetermined. ``carried``
    [m] is the vertex displacement by which this leaves them open. ``residual`` [m] is the vertex displacement that closes this
    row's gap; |C| for a hard row without gradient. ``rounding`` [m] is the part of it that rounding explains.
    """
    vec3, _ = types(dtype)
    K, M, N = wp.constant(term.vertices), wp.constant(term.rows), wp.constant(term.stiffening_rows)
    Q = wp.constant(row_count(term, scalar, curved))
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    slope = slope_type(term, dtype, scalar, curved)
    y_of, weight, measure, dead_zone = local_coordinate(term, dtype, True), term.weight, term.measure, term.dead_zone
    gradient, constraint, constraint_gradient, secant = term.gradient, term.constraint, term.constraint_gradient, term.secant
    stiffening, share_of, row_of = term.stiffening, to_corner(term, dtype), covector_row(term, dtype, scalar, curved)
    set_row = set_projected_row(dtype)

    @wp.func
    def size_of(stencil: wp.array2d(dtype=wp.int32), e: int, r: rest_type, x: wp.array(dtype=vec3), d: wp.array(dtype=vec3)):
        """Sum of the norms of the summands of y, of which rounding is ε."""
        size = dtype(0.0)
        for i in range(K):
            away = x[stencil[e, i]]
            if wp.static(term.vertices > 1):
                away = away - x[stencil[e, 0]]
            size += wp.length(weight(r, i)) * (wp.length(away) + wp.length(d[stencil[e, i]]))
        return size

    @wp.kernel(module="unique", enable_backward=False)
    def linearise_constraints(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        inverse_mass: wp.array(dtype=dtype),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        h: dtype,
        least: dtype,
        layout: RowLayout,
        # out, and the multipliers in and out
        slopes: wp.array(dtype=slope),
        rows: row_values(dtype),
    ):
        e = wp.tid()
        s = first_row(e, layout, Q)
        r = rest[e]
        y = y_of(stencil, e, r, x, d)
        alpha = dtype(1.0) / (stiffness[e] * measure(r) * h * h)
        g = constraint_gradient(y, r)
        c = constraint(y, r)
        steep = wp.sqrt(wp.ddot(g, g))
        covectors = slope()
        held = rows.multipliers[s]
        left = wp.float64(0.0)
        if wp.isfinite(alpha) and steep == dtype(0.0):
            left = wp.where(alpha == dtype(0.0), wp.float64(wp.abs(c)), wp.float64(0.0))
        if not wp.isfinite(alpha) or steep == dtype(0.0):
            held = dtype(0.0)
            alpha = dtype(1.0)
            c = dtype(0.0)
        else:
            for m in range(M):
                for a in range(3):
                    covectors[0, 3 * m + a] = g[m, a]
            if wp.static(curved):
                more = stiffening(y, r, -held)
                for n in range(N):
                    covectors[1 + n] = more[n]
        for j in range(1, Q):
            rows.multipliers[s + j] = dtype(0.0)
            rows.gap[s + j] = dtype(0.0)
            rows.compliance[s + j] = dtype(1.0)
        slopes[e] = covectors
        lost = dtype(0.0)
        for j in range(Q):
            total = dtype(0.0)
            most = dtype(0.0)
            for i in range(K):
                direction = share_of(r, i, row_of(covectors, j))
                free = inverse_mass[stencil[e, i]]
                total += free * wp.dot(direction, direction)
                most = wp.max(most, free * wp.length(direction))
            if j == 0:
                excess = wp.max(lowest_compliance(alpha, least) * total - alpha, dtype(0.0))
                alpha += excess
                rows.multipliers[s] = held
                rows.gap[s] = c + alpha * held
                rows.compliance[s] = alpha
            total += rows.compliance[s + j]
            rows.inverse[s + j] = wp.where(total == dtype(0.0), dtype(0.0), dtype(1.0) / total)
            if j == 0:
                rows.carried[s] = wp.float64(most * excess * wp.abs(held) * rows.inverse[s])
                left += wp.float64(most * wp.abs(rows.gap[s]) * rows.inverse[s])
                lost = most * (steep * size_of(stencil, e, r, x, d) * rows.inverse[s] + wp.abs(held))
        rows.residual[s] = left
        rows.rounding[s] = wp.float64(dtype(ROUNDINGS) * epsilon(lost) * lost)

    @wp.kernel(module="unique", enable_backward=False)
    def linearise_projections(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        inverse_mass: wp.array(dtype=dtype),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        h: dtype,
        least: dtype,
        layout: RowLayout,
        # out, and the multipliers in and out
        slopes: wp.array(dtype=slope),
        rows: row_values(dtype),
    ):
        e = wp.tid()
        s = first_row(e, layout, Q)
        r = rest[e]
        y = y_of(stencil, e, r, x, d)
        c = gradient(y, r)  # y − p(y), as u = ½‖y − p(y)‖²
        alpha = dtype(1.0) / (stiffness[e] * measure(r) * h * h)
        if wp.static(secant is not None):  # the same force, as a softer spring to a farther point
            share = secant(y, r)
            c = c / share
            alpha = alpha / share
        active = wp.isfinite(alpha)
        if wp.static(dead_zone):
            active = active and wp.ddot(c, c) != dtype(0.0)
        slopes[e] = wp.where(active, dtype(1.0), dtype(0.0))
        if not active:
            alpha = dtype(1.0)
            c = y_type()
        size = size_of(stencil, e, r, x, d)
        for m in range(M):
            total = dtype(0.0)
            most = dtype(0.0)
            if active:
                for i in range(K):
                    w = wp.abs(weight(r, i)[m])
                    total += inverse_mass[stencil[e, i]] * w * w
                    most = wp.max(most, inverse_mass[stencil[e, i]] * w)
            set_row(s + 3 * m, c[m], total, most, size, alpha, least, active, rows)

    return linearise_constraints if scalar else linearise_projections
