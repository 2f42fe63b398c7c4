"""Kernels of J and Jᵀ, the Jacobian of constraint rows (:mod:`.constraint_rows`).

Their key is (term, dtype, scalar, curved).
"""

from functools import cache

import warp as wp

from .constraint_rows import RowLayout, covector_row, first_row, row_count, slope_type
from .local import local_coordinate
from .memory import add_to
from .reduce import stands_aside
from .term import Term
from .transpose import LocalSource, gather, scatter, to_corner
from .vectors import types


@cache
def apply_rows(term: Term, dtype, scalar: bool, curved: bool):
    """Kernel over elements: rows += J v in active copies."""
    vec3, _ = types(dtype)
    M, Q = wp.constant(term.rows), wp.constant(row_count(term, scalar, curved))
    rest_type, slope = wp.types.vector(term.parameters, dtype), slope_type(term, dtype, scalar, curved)
    y_of = local_coordinate(term, dtype, False)

    @wp.kernel(module="unique", enable_backward=False)
    def apply(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        slopes: wp.array(dtype=slope),
        # state in
        v: wp.array(dtype=vec3),
        # parameters
        layout: RowLayout,
        active: wp.array(dtype=wp.int32),
        # in and out
        rows: wp.array(dtype=dtype),
    ):
        e = wp.tid()
        if stands_aside(active, e // layout.per_copy):
            return
        s = first_row(e, layout, Q)
        y = y_of(stencil, e, rest[e], v, v)
        if wp.static(scalar):
            for j in range(Q):
                total = rows[s + j]
                for m in range(M):
                    for a in range(3):
                        total += slopes[e][j, 3 * m + a] * y[m, a]
                rows[s + j] = total
        else:
            for m in range(M):
                for a in range(3):
                    rows[s + 3 * m + a] = rows[s + 3 * m + a] + slopes[e] * y[m, a]

    return apply


@cache
def held_rows(term: Term, dtype, scalar: bool, curved: bool):
    """Struct of the forces of rows: slopes, λ, and the active copies."""
    slope = slope_type(term, dtype, scalar, curved)

    @wp.struct
    class HeldRows:
        slopes: wp.array(dtype=slope)
        multipliers: wp.array(dtype=dtype)
        layout: RowLayout
        active: wp.array(dtype=wp.int32)

    return HeldRows


@cache
def pulls(term: Term, dtype, scalar: bool, curved: bool):
    """:class:`.transpose.LocalSource` of the force of an element's rows on y (M, 3)."""
    M, Q = wp.constant(term.rows), wp.constant(row_count(term, scalar, curved))
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    data = held_rows(term, dtype, scalar, curved)

    @wp.func
    def of_constraint(rows: data, e: int, rest: rest_type):
        z = y_type()
        s = first_row(e, rows.layout, Q)
        for j in range(Q):
            for m in range(M):
                for a in range(3):
                    z[m, a] = z[m, a] + rows.slopes[e][j, 3 * m + a] * rows.multipliers[s + j]
        return z

    @wp.func
    def of_projection(rows: data, e: int, rest: rest_type):
        z = y_type()
        s = first_row(e, rows.layout, Q)
        for m in range(M):
            for a in range(3):
                z[m, a] = rows.slopes[e] * rows.multipliers[s + 3 * m + a]
        return z

    @wp.func
    def of_inactive_copy(rows: data, e: int):
        return stands_aside(rows.active, e // rows.layout.per_copy)

    return LocalSource(data, of_constraint if scalar else of_projection, of_inactive_copy)


def scatter_rows(term: Term, dtype, scalar: bool, curved: bool):
    """Kernel over elements: out += Jᵀλ in active copies."""
    return scatter(term, dtype, pulls(term, dtype, scalar, curved))


def gather_rows(term: Term, dtype, scalar: bool, curved: bool):
    return gather(term, dtype, pulls(term, dtype, scalar, curved))


@cache
def rows_in_full(term: Term, dtype, scalar: bool, curved: bool):
    """Kernel over elements: out[e, rows·i + j] = ∂(row j)/∂xᵢ, in float64, for the host."""
    K, M, Q = wp.constant(term.vertices), wp.constant(term.rows), wp.constant(row_count(term, scalar, curved))
    rest_type, slope = wp.types.vector(term.parameters, dtype), slope_type(term, dtype, scalar, curved)
    weight = term.weight

    @wp.kernel(module="unique", enable_backward=False)
    def expand(
        # elements
        rest: wp.array(dtype=rest_type),
        slopes: wp.array(dtype=slope),
        # out
        out: wp.array2d(dtype=wp.vec3d),
    ):
        e = wp.tid()
        r = rest[e]
        for i in range(K):
            w = weight(r, i)
            for j in range(Q):
                row = wp.vec3d()
                if wp.static(scalar):
                    for m in range(M):
                        for a in range(3):
                            row[a] = row[a] + wp.float64(w[m]) * wp.float64(slopes[e][j, 3 * m + a])
                else:
                    row[j % 3] = wp.float64(w[j // 3]) * wp.float64(slopes[e])
                out[e, Q * i + j] = row

    return expand


@cache
def product_of_corners(term: Term, dtype, scalar: bool, curved: bool):
    """Device function (i, j, rest, slopes, penalties, s) → block (i, j) of JᵀDJ, D the ``penalties``, J the rows from s on of
    an element.
    """
    _, mat33 = types(dtype)
    M, Q = wp.constant(term.rows), wp.constant(row_count(term, scalar, curved))
    rest_type, slope = wp.types.vector(term.parameters, dtype), slope_type(term, dtype, scalar, curved)
    weight, share_of, row_of = term.weight, to_corner(term, dtype), covector_row(term, dtype, scalar, curved)

    @wp.func
    def of_constraint(i: int, j: int, rest: rest_type, slopes: slope, penalties: wp.array(dtype=dtype), s: int):
        block = mat33()
        for q in range(Q):
            row = row_of(slopes, q)
            block += penalties[s + q] * wp.outer(share_of(rest, i, row), share_of(rest, j, row))
        return block

    @wp.func
    def of_projection(i: int, j: int, rest: rest_type, slopes: slope, penalties: wp.array(dtype=dtype), s: int):
        block = mat33()
        wi, wj = weight(rest, i), weight(rest, j)
        for m in range(M):
            w = slopes * wi[m] * wj[m]
            for a in range(3):
                block[a, a] = block[a, a] + w * penalties[s + 3 * m + a]
        return block

    return of_constraint if scalar else of_projection


@cache
def product_blocks(term: Term, dtype, scalar: bool, curved: bool):
    """Kernel over elements: out[e, K·i + j] = block (i, j) of JᵀDJ."""
    _, mat33 = types(dtype)
    K, Q = wp.constant(term.vertices), wp.constant(row_count(term, scalar, curved))
    rest_type, slope = wp.types.vector(term.parameters, dtype), slope_type(term, dtype, scalar, curved)
    product = product_of_corners(term, dtype, scalar, curved)

    @wp.kernel(module="unique", enable_backward=False)
    def blocks_of_elements(
        # elements
        rest: wp.array(dtype=rest_type),
        slopes: wp.array(dtype=slope),
        # state in
        penalties: wp.array(dtype=dtype),
        # parameters
        layout: RowLayout,
        # out
        out: wp.array2d(dtype=mat33),
    ):
        e = wp.tid()
        s = first_row(e, layout, Q)
        corners = out.shape[1] // K  # K, but not a constant: the compiler would take seconds to unroll the loops
        for i in range(corners):
            for j in range(corners):
                out[e, K * i + j] = product(i, j, rest[e], slopes[e], penalties, s)

    return blocks_of_elements


@cache
def scatter_products(term: Term, dtype, scalar: bool, curved: bool):
    """Kernel over elements: adds block q = K·i + j of :func:`product_blocks` to values[slots[K²e + q]] if that slot is ≥ 0.

    Block (j, i) is the transpose of (i, j).
    """
    _, mat33 = types(dtype)
    K, Q = wp.constant(term.vertices), wp.constant(row_count(term, scalar, curved))
    rest_type, slope = wp.types.vector(term.parameters, dtype), slope_type(term, dtype, scalar, curved)
    product = product_of_corners(term, dtype, scalar, curved)
    put, put_transposed = add_to(mat33), add_to(mat33, transposed=True)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_blocks(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        slopes: wp.array(dtype=slope),
        slots: wp.array(dtype=wp.int32),
        # state in
        penalties: wp.array(dtype=dtype),
        # parameters
        layout: RowLayout,
        # in and out
        values: wp.array(dtype=mat33),
    ):
        e = wp.tid()
        s, first = first_row(e, layout, Q), K * K * e
        corners = stencil.shape[1]  # K, but not a constant: the compiler would take seconds to unroll the loops
        for i in range(corners):
            for j in range(i, corners):
                at = slots[first + K * i + j]
                if at >= 0:
                    block = product(i, j, rest[e], slopes[e], penalties, s)
                    put(values, at, block)
                    if i < j:
                        put_transposed(values, slots[first + K * j + i], block)

    return scatter_blocks
