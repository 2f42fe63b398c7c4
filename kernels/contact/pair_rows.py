"""Factories of the constraint rows of self-contact pairs: C = −√(2φ(d)), as for contact with colliders.

Each copy has rows for all pairs of the list. Rows of pairs of other copies, or of pairs beyond the contact distance, are
inactive, see :mod:`..constraint_rows`. With ``curved``, each pair has a second row, which adds the stiffness −λC″ along n.
Pairs with friction have two more rows, see :func:`linearise_friction_rows`.
"""

from functools import cache

import warp as wp

from ..constraint_rows import ROUNDINGS, RowLayout, lowest_compliance, row_values
from ..rotation import epsilon
from ..terms import contact
from ..vectors import types
from .self_friction import RubbedPairs, edge_tangent, stretch_of
from .self_gaps import nearest, signed_gap, vertex_of
from .self_pairs import StepPairs, near_pairs

constraint_slope, constraint_bend, potential = contact.constraint_slope, contact.constraint_bend, contact.potential
ZERO, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0))


@wp.struct
class PairSlopes:
    """Weights w of pairs, and ∂C/∂y of their first and second rows; 0 for inactive rows."""

    weights: wp.array(dtype=wp.vec4d)
    first: wp.array(dtype=wp.vec3d)
    second: wp.array(dtype=wp.vec3d)


@wp.func
def row_of_pair(copy: int, e: int, layout: RowLayout, rows: int):
    return copy * layout.rows_per_copy + layout.first + e * rows


@cache
def linearise_pair_rows(dtype, curved: bool):
    """Kernel over copies and pairs at x̃ + d: rows as in :func:`..constraint_rows.linearise`."""
    vec3, _ = types(dtype)
    at, exact = vertex_of(dtype)
    Q = wp.constant(2 if curved else 1)

    @wp.kernel(module="unique", enable_backward=False)
    def linearise_each_pair(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=dtype),
        # state in
        step: StepPairs,
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        h: wp.float64,
        least: wp.float64,
        per_copy: int,
        layout: RowLayout,
        # out, and the multipliers in and out
        slopes: PairSlopes,
        rows: row_values(dtype),
    ):
        copy, e = wp.tid()
        count = pairs.counts[0] + pairs.counts[1]
        own = False
        if e < count:
            own = pairs.stencils[e][0] // per_copy == copy
        row = row_of_pair(copy, e, layout, Q)
        held = wp.max(wp.float64(rows.multipliers[row]), ZERO)
        for j in range(Q):
            rows.multipliers[row + j] = dtype(0.0)
            rows.gap[row + j] = dtype(0.0)
            rows.compliance[row + j] = dtype(1.0)
            rows.inverse[row + j] = dtype(1.0)
            rows.residual[row + j] = ZERO
            rows.rounding[row + j] = ZERO
            rows.carried[row + j] = ZERO
        if not own:
            return
        slopes.first[e] = wp.vec3d()
        slopes.second[e] = wp.vec3d()
        k = step.stiffness[e]
        if k == ZERO:
            return
        s = pairs.stencils[e]
        r = wp.float64(pairs.distances[e])
        w, y, inside = nearest(e < pairs.counts[0], at(x, d, s[0]), at(x, d, s[1]), at(x, d, s[2]), at(x, d, s[3]))
        gap, n = signed_gap(y, step.normal[e], inside)
        steep = constraint_slope(gap, r)
        if steep == ZERO:
            return
        C = -wp.sqrt(wp.float64(2.0) * potential(gap, r))
        moved = ZERO
        most = ZERO
        size = ZERO
        for i in range(4):
            free = wp.float64(inverse_mass[s[i]])
            moved += free * w[i] * w[i]
            most = wp.max(most, free * wp.abs(w[i]))
            size += wp.abs(w[i]) * (wp.length(at(x, d, s[i]) - at(x, d, s[0])) + wp.length(exact(d[s[i]])))
        if moved == ZERO:
            return
        alpha = ONE / (k * h * h)
        total = steep * steep * moved
        excess = wp.max(lowest_compliance(alpha, least) * total - alpha, ZERO)
        alpha += excess
        slopes.weights[e] = w
        slopes.first[e] = steep * n
        rows.multipliers[row] = dtype(held)
        rows.gap[row] = dtype(C + alpha * held)
        rows.compliance[row] = dtype(alpha)
        inverse = ONE / (total + alpha)
        rows.inverse[row] = dtype(inverse)
        if wp.static(curved):
            stiffening = wp.sqrt(wp.max(-held * constraint_bend(gap, r), ZERO))
            slopes.second[e] = stiffening * n
            rows.inverse[row + 1] = dtype(ONE / (stiffening * stiffening * moved + ONE))
        rows.carried[row] = most * steep * excess * held * inverse
        rows.residual[row] = most * steep * wp.abs(C + alpha * held) * inverse
        lost = most * steep * (steep * size * inverse + held)
        rows.rounding[row] = wp.float64(dtype(ROUNDINGS) * epsilon(dtype(lost)) * dtype(lost))

    return linearise_each_pair


@cache
def linearise_friction_rows(dtype):
    """Kernel over copies and pairs at x̃ + d: the rows of friction, C = (u·t, u·(n × t)), t along the edge of the pair.

    For a sliding pair, they are those of a softer spring with the same force.
    """
    vec3, _ = types(dtype)
    stretch, (at, exact) = stretch_of(dtype), vertex_of(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def linearise_friction_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=dtype),
        # state in
        rubbed: RubbedPairs,
        start: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        h: wp.float64,
        least: wp.float64,
        per_copy: int,
        layout: RowLayout,
        # out, and the multipliers in and out
        slopes: PairSlopes,
        rows: row_values(dtype),
    ):
        copy, e = wp.tid()
        own = False
        if e < pairs.counts[0] + pairs.counts[1]:
            own = pairs.stencils[e][0] // per_copy == copy
        row = row_of_pair(copy, e, layout, 2)
        held = wp.vec2d(wp.float64(rows.multipliers[row]), wp.float64(rows.multipliers[row + 1]))
        for j in range(2):
            rows.multipliers[row + j] = dtype(0.0)
            rows.gap[row + j] = dtype(0.0)
            rows.compliance[row + j] = dtype(1.0)
            rows.inverse[row + j] = dtype(1.0)
            rows.residual[row + j] = ZERO
            rows.rounding[row + j] = ZERO
            rows.carried[row + j] = ZERO
        if not own:
            return
        slopes.first[e] = wp.vec3d()
        slopes.second[e] = wp.vec3d()
        limit = rubbed.limit[e]
        if limit == ZERO:
            return
        s = pairs.stencils[e]
        w = rubbed.weights[e]
        n = rubbed.normal[e]
        moved = ZERO
        most = ZERO
        size = ZERO
        for i in range(4):
            free = wp.float64(inverse_mass[s[i]])
            moved += free * w[i] * w[i]
            most = wp.max(most, free * wp.abs(w[i]))
            size += wp.abs(w[i]) * (wp.length(at(x, d, s[i]) - exact(start[s[i]])) + wp.length(exact(d[s[i]])))
        t = edge_tangent(exact(start[s[3]]) - exact(start[s[2]]), n)
        if moved == ZERO or wp.length_sq(t) == ZERO:
            return
        u = stretch(s, w, n, rubbed.stretch[e], start, x, d)
        k = wp.min(rubbed.stiffness[e], limit / wp.max(wp.length(u), wp.float64(1e-300)))
        alpha = ONE / (k * h * h)
        excess = wp.max(lowest_compliance(alpha, least) * moved - alpha, ZERO)
        alpha += excess
        inverse = ONE / (moved + alpha)
        slopes.weights[e] = w
        slopes.first[e] = t
        slopes.second[e] = wp.cross(n, t)
        for j in range(2):
            C = wp.dot(u, t)
            if j == 1:
                C = wp.dot(u, wp.cross(n, t))
            rows.multipliers[row + j] = dtype(held[j])
            rows.gap[row + j] = dtype(C + alpha * held[j])
            rows.compliance[row + j] = dtype(alpha)
            rows.inverse[row + j] = dtype(inverse)
            rows.carried[row + j] = most * excess * wp.abs(held[j]) * inverse
            rows.residual[row + j] = most * wp.abs(C + alpha * held[j]) * inverse
            lost = most * (size * inverse + wp.abs(held[j]))
            rows.rounding[row + j] = wp.float64(dtype(ROUNDINGS) * epsilon(dtype(lost)) * dtype(lost))

    return linearise_friction_of_pairs


@cache
def apply_pair_rows(dtype, two: bool):
    """Kernel over pairs: rows += J v."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    Q = wp.constant(2 if two else 1)

    @wp.kernel(module="unique", enable_backward=False)
    def apply_each_pair(
        # elements
        pairs: near_pairs(dtype),
        # state in
        slopes: PairSlopes,
        v: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        layout: RowLayout,
        # in and out
        rows: wp.array(dtype=dtype),
    ):
        e = wp.tid()
        if e >= pairs.counts[0] + pairs.counts[1]:
            return
        if wp.length_sq(slopes.first[e]) == ZERO:
            return
        s = pairs.stencils[e]
        row = row_of_pair(s[0] // per_copy, e, layout, Q)
        moved = wp.vec3d()
        for i in range(4):
            moved += slopes.weights[e][i] * exact(v[s[i]])
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
        pairs: near_pairs(dtype),
        # state in
        slopes: PairSlopes,
        rows: wp.array(dtype=dtype),
        # parameters
        per_copy: int,
        layout: RowLayout,
        # in and out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        total = wp.vec3d()
        for k in range(pairs.first[i], pairs.first[i + 1]):
            e = pairs.corners[k] // 4
            if wp.length_sq(slopes.first[e]) > ZERO:
                row = row_of_pair(i // per_copy, e, layout, Q)
                pull = wp.float64(rows[row]) * slopes.first[e]
                if wp.static(two):
                    pull += wp.float64(rows[row + 1]) * slopes.second[e]
                total += slopes.weights[e][pairs.corners[k] - 4 * e] * pull
        out[i] = out[i] + vec3(dtype(total[0]), dtype(total[1]), dtype(total[2]))

    return gather_of_pairs
