"""Kernels of terms whose elements are cells with any number of vertices, in compressed rows with weights.

Cell c has the vertices stencil[e], e from offsets[c] to offsets[c+1], with weights w[e] (M,): y = Σₑ w[e] ⊗ x[stencil[e]]. It
is evaluated once; each of its vertices is an element of one vertex.
"""

from functools import cache
from typing import Any

import warp as wp

from .project import nth_of_thread, spread_compliance, sweep_turn
from .term import Term
from .terms.attachment import weight
from .transpose import add_outer, to_block
from .vectors import types


def _rest_state(points, stencil):
    raise NotImplementedError  # only cells have rest states


@wp.func
def measure(rest: Any):
    return rest.dtype(1.0)


@wp.func
def share_energy(y: Any, rest: Any):
    return rest[3]


@wp.func
def share_gradient(y: Any, rest: Any):
    return wp.matrix_from_rows(wp.vector(rest[0], rest[1], rest[2]))


@wp.func
def share_hessian(y: Any, rest: Any, negative: Any):
    return wp.matrix(shape=(3, 3), dtype=rest.dtype)


@cache
def share(term: Term):
    """The :class:`.term.Term` of one vertex of a cell, with A∂u/∂x (3) and Au as rest state.

    The first vertex has the energy, the others its rounding; :func:`blocks` has the Hessian.
    """
    given = _rest_state, weight, measure, share_energy, share_gradient, share_hessian
    return Term(term.name, 1, 1, 4, *given, cells=True, cell=term)


@cache
def cell_coordinate(term: Term, dtype, corrected: bool, precision=None):
    """Device function (first, last, stencil, weights, x, d) → y of a cell at x (``corrected``: x + d), in the ``precision``."""
    vec3, _ = types(dtype)
    number = precision or dtype
    wide, y_type = types(number)[0], wp.types.matrix((term.rows, 3), number)
    M, weights_type = wp.constant(term.rows), wp.types.vector(term.rows, dtype)

    @wp.func
    def y_of(
        first: int,
        last: int,
        stencil: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=weights_type),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
    ):
        y = y_type()
        for e in range(first, last):
            for m in range(M):
                y[m] = y[m] + number(weights[e][m]) * wide(x[stencil[e, 0]])
        if wp.static(corrected):
            for e in range(first, last):
                for m in range(M):
                    y[m] = y[m] + number(weights[e][m]) * wide(d[stencil[e, 0]])
        return y

    return y_of


@cache
def evaluate(term: Term, dtype, corrected: bool):
    """Kernel over cells: rest states of their vertices' elements; in float64 if ``corrected``."""
    vec3, _ = types(dtype)
    precision = wp.float64 if corrected else dtype
    M, weights_type, wide = wp.constant(term.rows), wp.types.vector(term.rows, dtype), types(precision)[0]
    rest_type, share_type = wp.types.vector(term.parameters, dtype), wp.types.vector(4, dtype)
    exact_rest = wp.types.vector(term.parameters, precision)
    y_of, u, gradient, area = cell_coordinate(term, dtype, corrected, precision), term.energy, term.gradient, term.measure

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate_cells(
        # elements
        offsets: wp.array(dtype=wp.int32),
        stencil: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=weights_type),
        rest: wp.array(dtype=rest_type),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # out
        shares: wp.array(dtype=share_type),
    ):
        c = wp.tid()
        first, last, r = offsets[c], offsets[c + 1], exact_rest(rest[c])
        y = y_of(first, last, stencil, weights, x, d)
        g = area(r) * gradient(y, r)
        left = area(r) * u(y, r)
        for e in range(first, last):
            force = wide()
            for m in range(M):
                force += precision(weights[e][m]) * g[m]
            shares[e] = share_type(dtype(force[0]), dtype(force[1]), dtype(force[2]), dtype(left))
            left = left - precision(dtype(left))

    return evaluate_cells


@cache
def _hessian_of_cell(term: Term, dtype, corrected: bool):
    """Device function (c, first, last, stencil, weights, stiffness, rest, x, d, negative) → k A ∂²u/∂y² of cell c."""
    vec3, _ = types(dtype)
    weights_type, rest_type = wp.types.vector(term.rows, dtype), wp.types.vector(term.parameters, dtype)
    y_of, hessian, area = cell_coordinate(term, dtype, corrected), term.hessian, term.measure

    @wp.func
    def hessian_of(
        c: int,
        first: int,
        last: int,
        stencil: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=weights_type),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        negative: dtype,
    ):
        r = rest[c]
        y = y_of(first, last, stencil, weights, x, d)
        return (stiffness[first] * area(r)) * hessian(y, r, negative)

    return hessian_of


@cache
def blocks(term: Term, dtype, corrected: bool):
    """Kernel over cells: out[starts[c] + n·i + j] = k A ∂²u/∂xᵢ∂xⱼ [N/m] for n vertices, with the copy's policy."""
    vec3, mat33 = types(dtype)
    weights_type, rest_type = wp.types.vector(term.rows, dtype), wp.types.vector(term.parameters, dtype)
    hessian_of, block_of = _hessian_of_cell(term, dtype, corrected), to_block(term.rows, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def blocks_of_cells(
        # elements
        offsets: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        stencil: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=weights_type),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        cells_per_copy: int,
        policy: wp.array(dtype=wp.float64),
        # out
        out: wp.array(dtype=mat33),
    ):
        c = wp.tid()
        first, last, start = offsets[c], offsets[c + 1], starts[c]
        h = hessian_of(c, first, last, stencil, weights, stiffness, rest, x, d, dtype(policy[c // cells_per_copy]))
        for i in range(first, last):
            for j in range(first, last):
                out[start + (last - first) * (i - first) + j - first] = block_of(weights[i], weights[j], h)

    return blocks_of_cells


@cache
def scatter_blocks(term: Term, dtype, corrected: bool):
    """Kernel over cells: adds block q of :func:`blocks` to values[slots[q]]."""
    vec3, mat33 = types(dtype)
    weights_type, rest_type = wp.types.vector(term.rows, dtype), wp.types.vector(term.parameters, dtype)
    hessian_of, put = _hessian_of_cell(term, dtype, corrected), add_outer(term.rows, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_cells(
        # elements
        offsets: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        stencil: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=weights_type),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        slots: wp.array(dtype=wp.int32),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        cells_per_copy: int,
        policy: wp.array(dtype=wp.float64),
        # in and out
        values: wp.array(dtype=mat33),
    ):
        c = wp.tid()
        first, last, start = offsets[c], offsets[c + 1], starts[c]
        h = hessian_of(c, first, last, stencil, weights, stiffness, rest, x, d, dtype(policy[c // cells_per_copy]))
        n = last - first
        for i in range(n):
            for j in range(i, n):
                t = wp.where(i < j, slots[start + n * j + i], -1)
                put(weights[first + i], weights[first + j], h, slots[start + n * i + j], t, values)

    return scatter_cells


@cache
def constant_blocks(term: Term, dtype):
    """Kernel over cells of n vertices: out[starts[c] + n·i + j] = k A wᵢ·wⱼ [N/m], in float64."""
    M, weights_type, rest_type = (
        wp.constant(term.rows),
        wp.types.vector(term.rows, dtype),
        wp.types.vector(term.parameters, dtype),
    )
    area = term.measure

    @wp.kernel(module="unique", enable_backward=False)
    def constant_blocks_of_cells(
        # elements
        offsets: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=weights_type),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        # out
        out: wp.array(dtype=wp.float64),
    ):
        c = wp.tid()
        first, last = offsets[c], offsets[c + 1]
        scale = wp.float64(stiffness[first]) * wp.float64(area(rest[c]))
        for i in range(first, last):
            for j in range(first, last):
                total = wp.float64(0.0)
                for m in range(M):
                    total += wp.float64(weights[i][m]) * wp.float64(weights[j][m])
                out[starts[c] + (last - first) * (i - first) + j - first] = scale * total

    return constant_blocks_of_cells


@cache
def correct_cells(term: Term, dtype, multipliers: bool, per_step: bool, axes: bool = False):
    """Kernel of a Gauss–Seidel sweep over cells of a quadratic energy.

    Each row of y is a constraint, in order: Δλ = −(y + α̃λ)/(Σ wᵢ²/mᵢ + α̃).
    """
    vec3, _ = types(dtype)
    M, weights_type = wp.constant(term.rows), wp.types.vector(term.rows, dtype)
    rest_type, lambda_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    spread, area, mass_type = spread_compliance(dtype), term.measure, vec3 if axes else dtype

    @wp.func
    def by_axis(inverse_mass: mass_type):
        if wp.static(axes):
            return inverse_mass
        else:
            return vec3(inverse_mass, inverse_mass, inverse_mass)

    @wp.kernel(module="unique", enable_backward=False)
    def correct(
        # elements
        offsets: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=weights_type),
        cell_rest: wp.array(dtype=rest_type),
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        # state in
        inverse_mass: wp.array(dtype=mass_type),
        x: wp.array(dtype=vec3),
        # parameters
        turn: sweep_turn(dtype),
        # in and out
        lambdas: wp.array(dtype=lambda_type),
        d: wp.array(dtype=vec3),
    ):
        for k in range(wp.abs(turn.each)):
            c = nth_of_thread(turn.first, turn.each, wp.tid(), k)
            first, last = offsets[c], offsets[c + 1]
            compliance = dtype(1.0) / (stiffness[first] * area(cell_rest[c]) * turn.h * turn.h)
            for n in range(M):
                m = n
                if turn.each < 0:
                    m = M - 1 - n
                y = vec3()
                total = vec3()
                for e in range(first, last):
                    w = weights[e][m]
                    y += w * x[stencil[e, 0]]
                    total += (w * w) * by_axis(inverse_mass[stencil[e, 0]])
                for e in range(first, last):
                    y += weights[e][m] * d[stencil[e, 0]]
                if wp.static(multipliers):
                    y += compliance * lambdas[c][m]
                more = vec3()
                for axis in range(3):
                    if total[axis] > dtype(0.0) and wp.isfinite(compliance):
                        own = compliance
                        if wp.static(per_step):
                            own = spread(total[axis], compliance, turn.sweeps)
                        more[axis] = -turn.relaxation * y[axis] / (total[axis] + own)
                if wp.static(multipliers):
                    after = lambdas[c]
                    after[m] = after[m] + more
                    lambdas[c] = after
                for e in range(first, last):
                    v = stencil[e, 0]
                    mobility = by_axis(inverse_mass[v])
                    if wp.max(mobility) > dtype(0.0):
                        d[v] = d[v] + weights[e][m] * wp.cw_mul(mobility, more)

    return correct
