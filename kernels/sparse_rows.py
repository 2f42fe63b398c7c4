"""Constraint rows of cells with an energy ½‖y‖²: the 3M rows y = Σ wₑ ⊗ xₑ, linear in x.

A cell without stiffness is inactive: rows, values and λ are 0, the compliance 1.
"""

from functools import cache

import warp as wp

from .constraint_rows import RowLayout, first_row, row_values, set_projected_row
from .term import Term
from .vectors import types


@cache
def linearise_cells(term: Term, dtype):
    """Kernel over cells: as :func:`.constraint_rows.linearise`."""
    vec3, _ = types(dtype)
    M, weights_type = wp.constant(term.rows), wp.types.vector(term.rows, dtype)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    area, Q, set_row = term.measure, wp.constant(3 * term.rows), set_projected_row(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def linearise(
        # elements
        offsets: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=weights_type),
        rest: wp.array(dtype=rest_type),
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        inverse_mass: wp.array(dtype=dtype),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        h: dtype,
        least: dtype,
        layout: RowLayout,
        # out, and the multipliers in and out
        rows: row_values(dtype),
    ):
        c = wp.tid()
        first, last = offsets[c], offsets[c + 1]
        s = first_row(c, layout, Q)
        o = x[stencil[first, 0]]
        alpha = dtype(1.0) / (stiffness[first] * area(rest[c]) * h * h)
        active = wp.isfinite(alpha)
        if not active:
            alpha = dtype(1.0)
        y = y_type()
        size = dtype(0.0)
        for e in range(first, last):
            v = stencil[e, 0]
            size += wp.length(weights[e]) * (wp.length(x[v] - o) + wp.length(d[v]))
            if active:
                for m in range(M):
                    y[m] = y[m] + weights[e][m] * ((x[v] - o) + d[v])
        for m in range(M):
            total = dtype(0.0)
            most = dtype(0.0)
            if active:
                for e in range(first, last):
                    w = wp.abs(weights[e][m])
                    total += inverse_mass[stencil[e, 0]] * w * w
                    most = wp.max(most, inverse_mass[stencil[e, 0]] * w)
            set_row(s + 3 * m, y[m], total, most, size, alpha, least, active, rows)

    return linearise


@cache
def apply_cell_rows(term: Term, dtype):
    """Kernel over cells: rows += J v."""
    vec3, _ = types(dtype)
    M, weights_type, Q = wp.constant(term.rows), wp.types.vector(term.rows, dtype), wp.constant(3 * term.rows)

    @wp.kernel(module="unique", enable_backward=False)
    def apply(
        # elements
        offsets: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=weights_type),
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        # state in
        v: wp.array(dtype=vec3),
        # parameters
        layout: RowLayout,
        # in and out
        rows: wp.array(dtype=dtype),
    ):
        c = wp.tid()
        if stiffness[offsets[c]] == dtype(0.0):
            return
        s = first_row(c, layout, Q)
        for m in range(M):
            total = vec3()
            for e in range(offsets[c], offsets[c + 1]):
                total += weights[e][m] * v[stencil[e, 0]]
            for a in range(3):
                rows[s + 3 * m + a] = rows[s + 3 * m + a] + total[a]

    return apply


@cache
def gather_cell_rows(term: Term, dtype):
    """Kernel over vertices: out += Jᵀλ, in a fixed order."""
    vec3, _ = types(dtype)
    M, weights_type, Q = wp.constant(term.rows), wp.types.vector(term.rows, dtype), wp.constant(3 * term.rows)

    @wp.kernel(module="unique", enable_backward=False)
    def gather(
        # elements
        offsets: wp.array(dtype=wp.int32),
        codes: wp.array(dtype=wp.int32),
        cells: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=weights_type),
        stiffness: wp.array(dtype=dtype),
        # state in
        lambdas: wp.array(dtype=dtype),
        # parameters
        layout: RowLayout,
        # in and out
        out: wp.array(dtype=vec3),
    ):
        v = wp.tid()
        total = vec3()
        for n in range(offsets[v], offsets[v + 1]):
            e = codes[n]
            if stiffness[e] != dtype(0.0):
                s = first_row(cells[e], layout, Q)
                for m in range(M):
                    j = s + 3 * m
                    total += weights[e][m] * vec3(lambdas[j], lambdas[j + 1], lambdas[j + 2])
        out[v] = out[v] + total

    return gather
