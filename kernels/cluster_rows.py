"""Factories of the constraint rows of rigid clusters: C = √mᵢ(xᵢ − c − R qᵢ), 3 rows a vertex, so that U = (κ/2)‖C‖².

What the best motion (c, R) cannot take up is what is left of a change of x when its rigid part is taken away,

    J = (I − Q)√M,    Q v = √mᵢ(V + Ω × rᵢ),    V = Σ √mᵢ vᵢ/Σ mᵢ,    Ω = (Σ mᵢ(rᵢ²I − rᵢrᵢᵀ))⁻¹ Σ √mᵢ rᵢ × vᵢ,    rᵢ = R qᵢ,

Q being the projection onto translations and turns, of a body on a line without those about it (pseudo-inverse). Six of the
rows are redundant. For rows, see :mod:`.constrain`; kernels are over clusters, of which each has a thread.
"""

from functools import cache

import warp as wp

from .assemble import types
from .clusters import fit
from .constraint_rows import ROUNDINGS, first_row
from .rotation import epsilon


@cache
def linearise_clusters(dtype):
    """Kernel over clusters: as :func:`.constrain.linearise`, and the rotation R; 0 of a cluster without stiffness."""
    vec3, mat33 = types(dtype)
    rest_type = wp.types.vector(4, dtype)
    fit_cluster = fit(dtype, True)

    @wp.kernel(module="unique", enable_backward=False)
    def linearise(
        offsets: wp.array(dtype=wp.int32),
        shape: wp.array(dtype=vec3),
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        h: dtype,
        least: dtype,
        per_copy: int,
        first: int,
        rows_per_copy: int,
        # in and out
        lambdas: wp.array(dtype=dtype),
        # out
        rotations: wp.array(dtype=mat33),
        gap: wp.array(dtype=dtype),
        compliance: wp.array(dtype=dtype),
        inverse: wp.array(dtype=dtype),
        residual: wp.array(dtype=wp.float64),
        rounding: wp.array(dtype=wp.float64),
        carried: wp.array(dtype=wp.float64),
    ):
        c = wp.tid()
        R = fit_cluster(offsets[c], offsets[c + 1], stencil, rest, shape, x, d)
        o = stencil[offsets[c], 0]
        for e in range(offsets[c], offsets[c + 1]):
            s = first_row(e, per_copy, first, rows_per_copy, 3)
            v = stencil[e, 0]
            root = wp.sqrt(rest[e][3])
            alpha = dtype(1.0) / (stiffness[e] * h * h)
            active = wp.isfinite(alpha)
            if not active:
                alpha = dtype(1.0)
                R = mat33()
            excess = wp.max(least - alpha, dtype(0.0))
            alpha += excess
            row = vec3()
            force = vec3()
            for a in range(3):
                if not active:
                    lambdas[s + a] = dtype(0.0)
                    rest[e][a] = dtype(0.0)
                force[a] = lambdas[s + a]
                row[a] = alpha * force[a] - root * rest[e][a]
                gap[s + a] = row[a]
                compliance[s + a] = alpha
                inverse[s + a] = dtype(1.0) / (dtype(1.0) + alpha)
            move = dtype(1.0) / (root * (dtype(1.0) + alpha))
            carried[s] = wp.float64(excess * wp.length(force) * move)
            residual[s] = wp.float64(wp.length(row) * move)
            lost = wp.length(x[v] - x[o]) + wp.length(d[v]) + wp.length(shape[e]) + wp.length(force) / root
            rounding[s] = wp.float64(dtype(ROUNDINGS) * epsilon(lost) * lost)
        rotations[c] = R

    return linearise


@cache
def motion(dtype):
    """The device function that is given Σ √m v and Σ √m r × v of a cluster, and gives V and Ω as the rows of a matrix."""
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
        offsets: wp.array(dtype=wp.int32),
        shape: wp.array(dtype=vec3),
        inertia: wp.array(dtype=mat33),
        rotations: wp.array(dtype=mat33),
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        v: wp.array(dtype=vec3),
        per_copy: int,
        first: int,
        rows_per_copy: int,
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
            s = first_row(e, per_copy, first, rows_per_copy, 3)
            for a in range(3):
                rows[s + a] = rows[s + a] + left[a]

    return apply


@cache
def pull_clusters(dtype):
    """Kernel over clusters: of Jᵀ λ the part of each element, (B·E,) vectors."""
    vec3, mat33 = types(dtype)
    rest_type = wp.types.vector(4, dtype)
    rigid_part = motion(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def pull(
        offsets: wp.array(dtype=wp.int32),
        shape: wp.array(dtype=vec3),
        inertia: wp.array(dtype=mat33),
        rotations: wp.array(dtype=mat33),
        rest: wp.array(dtype=rest_type),
        lambdas: wp.array(dtype=dtype),
        per_copy: int,
        first: int,
        rows_per_copy: int,
        # out
        pulls: wp.array(dtype=vec3),
    ):
        c = wp.tid()
        R = rotations[c]
        linear = vec3()
        angular = vec3()
        total = dtype(0.0)
        for e in range(offsets[c], offsets[c + 1]):
            s = first_row(e, per_copy, first, rows_per_copy, 3)
            part = wp.sqrt(rest[e][3]) * vec3(lambdas[s], lambdas[s + 1], lambdas[s + 2])
            linear += part
            angular += wp.cross(R * shape[e], part)
            total += rest[e][3]
        rigid = rigid_part(linear, angular, total, R, inertia[c])
        held = wp.ddot(R, R) != dtype(0.0)
        for e in range(offsets[c], offsets[c + 1]):
            s = first_row(e, per_copy, first, rows_per_copy, 3)
            part = wp.sqrt(rest[e][3]) * vec3(lambdas[s], lambdas[s + 1], lambdas[s + 2])
            pulls[e] = part - rest[e][3] * (rigid[0] + wp.cross(rigid[1], R * shape[e]))
            if not held:
                pulls[e] = vec3()

    return pull


@cache
def gather_pulls(dtype):
    """Kernel over vertices: out += the parts of the elements of a vertex, in a fixed order."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def gather(
        offsets: wp.array(dtype=wp.int32),
        incidences: wp.array(dtype=wp.int32),
        pulls: wp.array(dtype=vec3),
        # in and out
        out: wp.array(dtype=vec3),
    ):
        v = wp.tid()
        total = vec3()
        for n in range(offsets[v], offsets[v + 1]):
            total += pulls[incidences[n]]
        out[v] = out[v] + total

    return gather
