"""Factories of the constraint rows of pairs, for each :class:`..term.PairTerm`.

Each copy has rows for all slots; those of other copies, or without a pair, are inactive, see :mod:`..constraint_rows`. With
``curved``, pairs of a term with one row have a second one, which adds the stiffness −λC″. λ is found anew, as −C/α and the
``fixed`` force, for pairs may have other slots than in the last rows.
"""

from functools import cache

import warp as wp

from ..constraint_rows import ROUNDINGS, RowLayout, lowest_compliance, row_values
from ..pairs import Pairs
from ..rotation import epsilon
from ..term import PairTerm
from ..vectors import types
from .self_gaps import ONE, ZERO

FIXED = wp.constant(wp.float64(1e20))  # compliance of a row whose force is given


@wp.struct
class PairSlopes:
    """Weights w of pairs, and ∂C/∂y of their first and second rows; 0 for inactive rows."""

    weights: wp.array(dtype=wp.vec4d)
    first: wp.array(dtype=wp.vec3d)
    second: wp.array(dtype=wp.vec3d)


@wp.func
def row_of_pair(copy: int, e: int, ranks: wp.array(dtype=wp.int32), layout: RowLayout, rows: int):
    """The first row of the pair in slot e. Rows are in the order of ``ranks``, or of slots if that is None."""
    rank = e
    if ranks:
        rank = ranks[e]
    return copy * layout.rows_per_copy + layout.first + rank * rows


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def count_first_corners(
    # elements
    pairs: Pairs,
    # out
    counts: wp.array(dtype=wp.int32),
):
    """Kernel over vertices: the number of pairs of which the vertex is corner 0."""
    i = wp.tid()
    found = wp.int32(0)
    for k in range(pairs.first[i], pairs.first[i + 1]):
        found += wp.where(pairs.corners[k] % 4 == 0, 1, 0)
    counts[i] = found


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def rank_pairs(
    # elements
    pairs: Pairs,
    starts: wp.array(dtype=wp.int32),
    # out
    ranks: wp.array(dtype=wp.int32),
):
    """Kernel over vertices: numbers the pairs of which the vertex is corner 0, by their keys, from ``starts`` [i] on."""
    i = wp.tid()
    rank = starts[i]
    for k in range(pairs.first[i], pairs.first[i + 1]):
        if pairs.corners[k] % 4 == 0:
            ranks[pairs.corners[k] // 4] = rank
            rank += 1


@cache
def linearise_pair_rows(term: PairTerm, dtype, curved: bool):
    """Kernel over copies and pairs at x̃ + d: rows as in :func:`..constraint_rows.linearise`."""
    vec3, _ = types(dtype)
    row_of = term.row
    Q = wp.constant(2 if curved else term.rows)

    @wp.kernel(module="unique", enable_backward=False)
    def linearise_each_pair(
        # elements
        pairs: Pairs,
        inverse_mass: wp.array(dtype=dtype),
        # state in
        data: term.data,
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        h: wp.float64,
        least: wp.float64,
        layout: RowLayout,
        ranks: wp.array(dtype=wp.int32),
        # out, and the multipliers in and out
        slopes: PairSlopes,
        rows: row_values(dtype),
    ):
        copy, e = wp.tid()
        empty = e >= pairs.number[0]
        start = copy * layout.rows_per_copy + layout.first + e * Q
        if not empty:
            start = row_of_pair(copy, e, ranks, layout, Q)
        for j in range(Q):
            rows.multipliers[start + j] = dtype(0.0)
            rows.gap[start + j] = dtype(0.0)
            rows.compliance[start + j] = dtype(1.0)
            rows.inverse[start + j] = dtype(1.0)
            rows.residual[start + j] = ZERO
            rows.rounding[start + j] = ZERO
            rows.carried[start + j] = ZERO
        if empty:
            slopes.first[e] = wp.vec3d()
            return
        s = pairs.stencils[e]
        if s[0] // pairs.layout.per_copy != copy:
            return
        slopes.first[e] = wp.vec3d()
        slopes.second[e] = wp.vec3d()
        found = row_of(pairs, data, e, x, d)
        moved = ZERO
        most = ZERO
        size = found.size
        for i in range(4):
            w = found.weights[i]
            free = wp.float64(inverse_mass[s[i]])
            moved += free * w * w
            most = wp.max(most, free * wp.abs(w))
            size += wp.abs(w) * wp.length(wp.vec3d(d[s[i]]))
        if moved == ZERO or wp.length_sq(found.first) == ZERO:
            return
        slopes.weights[e] = found.weights
        slopes.first[e] = found.first
        if wp.static(curved):
            found.second *= h
        slopes.second[e] = found.second
        for j in range(Q):
            row = start + j
            square = wp.length_sq(wp.where(j == 1, found.second, found.first))
            total = square * moved
            if wp.static(curved) and j == 1:
                rows.inverse[row] = dtype(ONE / (total + ONE))
            elif found.stiffness == ZERO:
                rows.multipliers[row] = dtype(found.fixed * h * h)
                rows.compliance[row] = dtype(FIXED)
                rows.inverse[row] = dtype(ONE / FIXED)
            else:
                steep = wp.sqrt(square)
                alpha = ONE / (found.stiffness * h * h)
                excess = wp.max(lowest_compliance(alpha, least) * total - alpha, ZERO)
                alpha += excess
                own_held = -found.C[j] / alpha
                if j == 0:
                    own_held += h * h * found.fixed
                inverse = ONE / (total + alpha)
                rows.multipliers[row] = dtype(own_held)
                rows.compliance[row] = dtype(alpha)
                rows.inverse[row] = dtype(inverse)
                rows.carried[row] = most * steep * excess * wp.abs(own_held) * inverse
                lost = most * steep * (steep * size * inverse + wp.abs(own_held))
                rows.rounding[row] = wp.float64(dtype(ROUNDINGS) * epsilon(dtype(lost)) * dtype(lost))

    return linearise_each_pair


@cache
def apply_pair_rows(dtype, two: bool):
    """Kernel over pairs: rows += J v."""
    vec3, _ = types(dtype)
    Q = wp.constant(2 if two else 1)

    @wp.kernel(module="unique", enable_backward=False)
    def apply_each_pair(
        # elements
        pairs: Pairs,
        # state in
        slopes: PairSlopes,
        v: wp.array(dtype=vec3),
        # parameters
        layout: RowLayout,
        ranks: wp.array(dtype=wp.int32),
        # in and out
        rows: wp.array(dtype=dtype),
    ):
        e = wp.tid()
        if wp.length_sq(slopes.first[e]) == ZERO:
            return
        s = pairs.stencils[e]
        row = row_of_pair(s[0] // pairs.layout.per_copy, e, ranks, layout, Q)
        moved = wp.vec3d()
        for i in range(4):
            moved += slopes.weights[e][i] * wp.vec3d(v[s[i]])
        rows[row] = rows[row] + dtype(wp.dot(slopes.first[e], moved))
        if wp.static(two):
            rows[row + 1] = rows[row + 1] + dtype(wp.dot(slopes.second[e], moved))

    return apply_each_pair


@cache
def gather_pair_rows(dtype, two: bool):
    """Kernel over vertices: out += Jᵀ rows."""
    vec3, _ = types(dtype)
    Q = wp.constant(2 if two else 1)

    @wp.kernel(module="unique", enable_backward=False)
    def gather_of_pairs(
        # elements
        pairs: Pairs,
        # state in
        slopes: PairSlopes,
        rows: wp.array(dtype=dtype),
        # parameters
        layout: RowLayout,
        ranks: wp.array(dtype=wp.int32),
        # in and out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        total = wp.vec3d()
        for k in range(pairs.first[i], pairs.first[i + 1]):
            e = pairs.corners[k] // 4
            if wp.length_sq(slopes.first[e]) > ZERO:
                row = row_of_pair(i // pairs.layout.per_copy, e, ranks, layout, Q)
                pull = wp.float64(rows[row]) * slopes.first[e]
                if wp.static(two):
                    pull += wp.float64(rows[row + 1]) * slopes.second[e]
                total += slopes.weights[e][pairs.corners[k] - 4 * e] * pull
        out[i] = out[i] + vec3(total)

    return gather_of_pairs
