"""Constraint rows of rigid clusters: C = √mᵢ(xᵢ − c − R qᵢ), 3 rows per vertex, with U = (κ/2)‖C‖².

(c, R) is the best rigid motion, so J removes the rigid part of a change of x,

    J = (I − Q)√M,    Q v = √mᵢ(V + Ω × rᵢ),    V = Σ √mᵢ vᵢ/Σ mᵢ,    Ω = (Σ mᵢ(rᵢ²I − rᵢrᵢᵀ))⁻¹ Σ √mᵢ rᵢ × vᵢ,    rᵢ = R qᵢ,

where Q projects onto translations and rotations; the inverse is a pseudo-inverse. Six rows are redundant.
"""

from functools import cache

import warp as wp

from .clusters import cluster_fit
from .constraint_rows import ROUNDINGS, RowLayout, first_row, lowest_compliance, row_values
from .rotation import epsilon
from .term import Term
from .transpose import gather, stored
from .vectors import types


@cache
def linearise_clusters(dtype):
    """Kernel over clusters: as :func:`.constraint_rows.linearise`, and the rotation R, 0 without stiffness."""
    vec3, mat33 = types(dtype)
    rest_type = wp.types.vector(4, dtype)
    fit_cluster = cluster_fit(dtype, True)

    @wp.kernel(module="unique", enable_backward=False)
    def linearise(
        # elements
        offsets: wp.array(dtype=wp.int32),
        shape: wp.array(dtype=vec3),
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        h: dtype,
        least: dtype,
        layout: RowLayout,
        # out, and the multipliers in and out
        rotations: wp.array(dtype=mat33),
        rows: row_values(dtype),
    ):
        c = wp.tid()
        R = fit_cluster(offsets[c], offsets[c + 1], stencil, rest, shape, x, d)
        o = stencil[offsets[c], 0]
        for e in range(offsets[c], offsets[c + 1]):
            s = first_row(e, layout, 3)
            v = stencil[e, 0]
            root = wp.sqrt(rest[e][3])
            alpha = dtype(1.0) / (stiffness[e] * h * h)
            active = wp.isfinite(alpha)
            if not active:
                alpha = dtype(1.0)
                R = mat33()
            excess = wp.max(lowest_compliance(alpha, least) - alpha, dtype(0.0))
            alpha += excess
            row = vec3()
            force = vec3()
            for a in range(3):
                if not active:
                    rows.multipliers[s + a] = dtype(0.0)
                    rest[e][a] = dtype(0.0)
                force[a] = rows.multipliers[s + a]
                row[a] = alpha * force[a] - root * rest[e][a]
                rows.gap[s + a] = row[a]
                rows.compliance[s + a] = alpha
                rows.inverse[s + a] = dtype(1.0) / (dtype(1.0) + alpha)
            move = dtype(1.0) / (root * (dtype(1.0) + alpha))
            rows.carried[s] = wp.float64(excess * wp.length(force) * move)
            rows.residual[s] = wp.float64(wp.length(row) * move)
            lost = wp.length(x[v] - x[o]) + wp.length(d[v]) + wp.length(shape[e]) + wp.length(force) / root
            rows.rounding[s] = wp.float64(dtype(ROUNDINGS) * epsilon(lost) * lost)
        rotations[c] = R

    return linearise


@cache
def motion(dtype):
    """Device function (Σ √m v, Σ √m r × v, …) → matrix with the rows V and Ω of a cluster."""
    vec3, mat33 = types(dtype)

    @wp.func
    def rigid_part(linear: vec3, angular: vec3, total: dtype, R: mat33, inertia: mat33):
        return wp.matrix_from_rows(linear / total, R * (inertia * (wp.transpose(R) * angular)))

    return rigid_part


@cache
def apply_cluster_rows(dtype):
    """Kernel over clusters: rows += J v."""
    vec3, mat33 = types(dtype)
    rest_type = wp.types.vector(4, dtype)
    rigid_part = motion(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def apply(
        # elements
        offsets: wp.array(dtype=wp.int32),
        shape: wp.array(dtype=vec3),
        inertia: wp.array(dtype=mat33),
        rotations: wp.array(dtype=mat33),
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        # state in
        v: wp.array(dtype=vec3),
        # parameters
        layout: RowLayout,
        # in and out
        rows: wp.array(dtype=dtype),
    ):
        c = wp.tid()
        R = rotations[c]
        if wp.ddot(R, R) == dtype(0.0):
            return
        linear = vec3()
        angular = vec3()
        total = dtype(0.0)
        for e in range(offsets[c], offsets[c + 1]):
            total += rest[e][3]
        for e in range(offsets[c], offsets[c + 1]):
            part = rest[e][3] * v[stencil[e, 0]]
            linear += part
            angular += wp.cross(R * shape[e], part)
        rigid = rigid_part(linear, angular, total, R, inertia[c])
        for e in range(offsets[c], offsets[c + 1]):
            left = wp.sqrt(rest[e][3]) * (v[stencil[e, 0]] - (rigid[0] + wp.cross(rigid[1], R * shape[e])))
            s = first_row(e, layout, 3)
            for a in range(3):
                rows[s + a] = rows[s + a] + left[a]

    return apply


@cache
def pull_clusters(dtype):
    """Kernel over clusters: pulls (B·E,), each element's part in Jᵀλ, as matrices of one row."""
    vec3, mat33 = types(dtype)
    y_type = wp.types.matrix((1, 3), dtype)
    rest_type = wp.types.vector(4, dtype)
    rigid_part = motion(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def pull(
        # elements
        offsets: wp.array(dtype=wp.int32),
        shape: wp.array(dtype=vec3),
        inertia: wp.array(dtype=mat33),
        rotations: wp.array(dtype=mat33),
        rest: wp.array(dtype=rest_type),
        # state in
        lambdas: wp.array(dtype=dtype),
        # parameters
        layout: RowLayout,
        # out
        pulls: wp.array(dtype=y_type),
    ):
        c = wp.tid()
        R = rotations[c]
        linear = vec3()
        angular = vec3()
        total = dtype(0.0)
        for e in range(offsets[c], offsets[c + 1]):
            s = first_row(e, layout, 3)
            part = wp.sqrt(rest[e][3]) * vec3(lambdas[s], lambdas[s + 1], lambdas[s + 2])
            linear += part
            angular += wp.cross(R * shape[e], part)
            total += rest[e][3]
        rigid = rigid_part(linear, angular, total, R, inertia[c])
        held = wp.ddot(R, R) != dtype(0.0)
        for e in range(offsets[c], offsets[c + 1]):
            s = first_row(e, layout, 3)
            part = wp.sqrt(rest[e][3]) * vec3(lambdas[s], lambdas[s + 1], lambdas[s + 2])
            z = y_type()
            if held:
                z[0] = part - rest[e][3] * (rigid[0] + wp.cross(rigid[1], R * shape[e]))
            pulls[e] = z

    return pull


def gather_pulls(term: Term, dtype):
    return gather(term, dtype, stored(term, dtype))
