"""Kernels over cells: sets of vertices with one rotation.

The vertices of cell c are ``members`` offsets[c] to offsets[c+1], at least one. Their constant moments gᵢ have Σᵢ gᵢ = 0. The
covariance of the cell is S_c = Σᵢ (xᵢ − x_o) gᵢᵀ for any reference x_o. Points with weights wᵢ and centroid X̄ have gᵢ = wᵢ(Xᵢ
− X̄) (Kabsch 1976), edges gᵢ = Σⱼ w_ij (Xᵢ − Xⱼ).
"""

from functools import cache

import warp as wp

from .rotation import nearest_rotation
from .vectors import types


@cache
def set_moments(dtype):
    """Kernel over cells: moments gᵢ = wᵢ(Xᵢ − X̄), X̄ = Σ wᵢ Xᵢ / Σ wᵢ, scaled to a maximum length of 1 against underflow."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def set_from_centroid(
        # elements
        offsets: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=dtype),
        # state in
        X: wp.array(dtype=vec3),
        # out
        moments: wp.array(dtype=vec3),
    ):
        c = wp.tid()
        first, last = offsets[c], offsets[c + 1]
        total = dtype(0.0)
        # Relative to a member with a weight, so that positions far from the origin lose no digits.
        origin = X[members[first]]
        for k in range(first, last):
            if total == dtype(0.0):
                origin = X[members[k]]
            total += weights[members[k]]
        centroid = vec3()
        for k in range(first, last):
            centroid += (weights[members[k]] / total) * (X[members[k]] - origin)
        largest = dtype(0.0)
        for k in range(first, last):
            g = (weights[members[k]] / total) * ((X[members[k]] - origin) - centroid)
            largest = wp.max(largest, wp.max(wp.abs(g)))
            moments[k] = g
        if largest > dtype(0.0):
            for k in range(first, last):
                moments[k] = moments[k] / largest

    return set_from_centroid


@cache
def fit_rotations(dtype):
    """Kernel over cells: R_c = the rotation with the largest tr(RᵀS_c), S_c = Σᵢ (xᵢ − x_o) gᵢᵀ.

    x_o is the first member with a nonzero moment.
    """
    vec3, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def fit(
        # elements
        offsets: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        moments: wp.array(dtype=vec3),
        # state in
        x: wp.array(dtype=vec3),
        # out
        rotations: wp.array(dtype=mat33),
    ):
        c = wp.tid()
        first, last = offsets[c], offsets[c + 1]
        o = first
        while o < last - 1 and wp.length_sq(moments[o]) == dtype(0.0):
            o += 1
        origin = x[members[o]]
        S = mat33()
        for k in range(first, last):
            S += wp.outer(x[members[k]] - origin, moments[k])
        rotations[c] = nearest_rotation(S)

    return fit


@cache
def gather_moments(dtype):
    """Kernel over vertices: b_i = start_i + Σ_{c∋i} R_c g_ic, the transpose of the sums in :func:`fit_rotations`.

    Entries offsets[i] to offsets[i+1] of ``cells`` and ``moments`` are those of vertex i.
    """
    vec3, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def gather_at_vertices(
        # elements
        offsets: wp.array(dtype=wp.int32),
        cells: wp.array(dtype=wp.int32),
        moments: wp.array(dtype=vec3),
        # state in
        rotations: wp.array(dtype=mat33),
        start: wp.array(dtype=vec3),
        # out
        b: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        total = start[i]
        for k in range(offsets[i], offsets[i + 1]):
            total += rotations[cells[k]] * moments[k]
        b[i] = total

    return gather_at_vertices


@cache
def edge_energy(dtype):
    """Kernel over edges: out[e] = w_ij (‖d − R_i D‖² + ‖d − R_j D‖²), d = xⱼ − xᵢ, D = Xⱼ − Xᵢ."""
    vec3, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def energy_of_edges(
        # elements
        edges: wp.array(dtype=wp.vec2i),
        weights: wp.array(dtype=dtype),
        rest: wp.array(dtype=vec3),
        # state in
        rotations: wp.array(dtype=mat33),
        x: wp.array(dtype=vec3),
        # out
        out: wp.array(dtype=wp.float64),
    ):
        e = wp.tid()
        i, j = edges[e][0], edges[e][1]
        d, D = x[j] - x[i], rest[j] - rest[i]
        out[e] = wp.float64(weights[e] * (wp.length_sq(d - rotations[i] * D) + wp.length_sq(d - rotations[j] * D)))

    return energy_of_edges


@cache
def triangle_energy(dtype):
    """Kernel over triangles: out[t] = Σᵥ Σₑ w_e ‖dₑ − Rᵥ Dₑ‖² over its vertices v and edges e.

    d and D are edge vectors of x and at rest; edge k is opposite vertex k.
    """
    vec3, mat33 = types(dtype)

    @wp.func
    def of_one_rotation(w: vec3, R: mat33, d1: vec3, d2: vec3, D1: vec3, D2: vec3):
        r1, r2 = d1 - R * D1, d2 - R * D2
        return w[1] * wp.length_sq(r1) + w[2] * wp.length_sq(r2) + w[0] * wp.length_sq(r1 - r2)

    @wp.kernel(module="unique", enable_backward=False)
    def energy_of_triangles(
        # elements
        triangles: wp.array(dtype=wp.vec3i),
        weights: wp.array(dtype=vec3),
        rest: wp.array(dtype=vec3),
        # state in
        rotations: wp.array(dtype=mat33),
        x: wp.array(dtype=vec3),
        # out
        out: wp.array(dtype=wp.float64),
    ):
        t = wp.tid()
        i, j, k = triangles[t][0], triangles[t][1], triangles[t][2]
        w = weights[t]
        # Edge 1 goes from vertex 0 to 2, edge 2 from 0 to 1; edge 0 is their difference.
        d1, d2, D1, D2 = x[k] - x[i], x[j] - x[i], rest[k] - rest[i], rest[j] - rest[i]
        total = of_one_rotation(w, rotations[i], d1, d2, D1, D2)
        total += of_one_rotation(w, rotations[j], d1, d2, D1, D2)
        total += of_one_rotation(w, rotations[k], d1, d2, D1, D2)
        out[t] = wp.float64(total)

    return energy_of_triangles
