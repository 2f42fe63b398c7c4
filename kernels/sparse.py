"""Factories of the kernels of terms whose elements have any number of vertices: cells in compressed rows, with weights.

Cell c has the vertices stencil[e], e from offsets[c] to offsets[c+1], with the weights w[e] (M,): y = Σₑ w[e] ⊗ x[stencil[e]].
Its u and ∂u/∂y are evaluated once for the cell; each vertex of it is then an element of its own, the :func:`share` of it.
"""

from functools import cache
from typing import Any

import warp as wp

from .term import Term
from .terms.attachment import weight
from .vectors import types


def _rest_state(points, stencil):
    raise NotImplementedError  # only cells have one


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
def share_hessian(y: Any, rest: Any, policy: int):
    return wp.matrix(shape=(3, 3), dtype=rest.dtype)


@cache
def share(name):
    """The :class:`.term.Term` of one vertex of a cell: its rest state is what the cell gives it, A∂u/∂x (3) and Au.

    The first vertex of a cell has all of the energy. The Hessian, which is not that of one vertex, is that of :func:`blocks`.
    """
    return Term(name, 1, 1, 4, _rest_state, weight, measure, share_energy, share_gradient, share_hessian, cells=True)


@cache
def cell_coordinate(term: Term, dtype, corrected: bool):
    """The device function (first, last, stencil, weights, x, d) → y of a cell at x, or with ``corrected`` at x + d."""
    vec3, _ = types(dtype)
    M, weights_type, y_type = wp.constant(term.rows), wp.types.vector(term.rows, dtype), wp.types.matrix((term.rows, 3), dtype)

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
                y[m] = y[m] + weights[e][m] * x[stencil[e, 0]]
        if wp.static(corrected):
            for e in range(first, last):
                for m in range(M):
                    y[m] = y[m] + weights[e][m] * d[stencil[e, 0]]
        return y

    return y_of


@cache
def evaluate(term: Term, dtype, corrected: bool):
    """Kernel over cells: the rest states of the shares of their vertices."""
    vec3, _ = types(dtype)
    M, weights_type = wp.constant(term.rows), wp.types.vector(term.rows, dtype)
    rest_type, share_type = wp.types.vector(term.parameters, dtype), wp.types.vector(4, dtype)
    y_of, u, gradient, area = cell_coordinate(term, dtype, corrected), term.energy, term.gradient, term.measure

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
        first, last, r = offsets[c], offsets[c + 1], rest[c]
        y = y_of(first, last, stencil, weights, x, d)
        g = area(r) * gradient(y, r)
        left = area(r) * u(y, r)
        for e in range(first, last):
            force = vec3()
            for m in range(M):
                force += weights[e][m] * g[m]
            shares[e] = share_type(force[0], force[1], force[2], left)
            left = dtype(0.0)

    return evaluate_cells


@cache
def blocks(term: Term, dtype, corrected: bool):
    """Kernel over cells of n vertices: out[starts[c] + n·i + j] = k A ∂²u/∂xᵢ∂xⱼ [N/m], under the policy of the cell's copy."""
    vec3, mat33 = types(dtype)
    M, weights_type, rest_type = (
        wp.constant(term.rows),
        wp.types.vector(term.rows, dtype),
        wp.types.vector(term.parameters, dtype),
    )
    y_of, hessian, area = cell_coordinate(term, dtype, corrected), term.hessian, term.measure

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
        policy: wp.array(dtype=wp.int32),
        # out
        out: wp.array(dtype=mat33),
    ):
        c = wp.tid()
        first, last, r = offsets[c], offsets[c + 1], rest[c]
        y = y_of(first, last, stencil, weights, x, d)
        h = (stiffness[first] * area(r)) * hessian(y, r, policy[c // cells_per_copy])
        for i in range(first, last):
            for j in range(first, last):
                block = mat33()
                for m in range(M):
                    for n in range(M):
                        w = weights[i][m] * weights[j][n]
                        for row in range(3):
                            for column in range(3):
                                block[row, column] = block[row, column] + w * h[3 * m + row, 3 * n + column]
                out[starts[c] + (last - first) * (i - first) + j - first] = block

    return blocks_of_cells
