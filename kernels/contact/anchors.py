"""Kernels that anchor friction on colliders where a step begins."""

from functools import cache

import warp as wp

from ..coulomb import Law
from ..terms import contact
from ..vectors import types
from .colliders import filters, gap_of, pose_types, rotated, to_local, to_space


@cache
def slip_of(dtype, law: Law):
    """Device function (anchor, X, n) → the tangential vector from an anchor to X, less the part that the anchor follows."""
    vec3, _ = types(dtype)
    _pose, anchor_type = pose_types(dtype)
    kept = law.kept

    @wp.func
    def slip(held: anchor_type, X: vec3, n: vec3):
        if held[3] > dtype(0.0):
            u = X - vec3(held[0], held[1], held[2])
            u = u - wp.dot(n, u) * n
            return kept(wp.length(u), held[3]) * u
        return vec3()

    return slip


@cache
def anchor_vertices(dtype, solids, law: Law, bounded: bool):
    """Kernel over friction elements of one collider at the start of a step: anchors, and the rest states of the step.

    ε = μN/(kA) by Coulomb's law, with N = −kAφ′(d), or kA(r − d) if ``bounded``. The anchor is where contact began. If ‖u‖ is
    above the ε of the last step, the vertex slid, and its anchor follows to the distance ε. Anchors are in the frame of the
    collider; their ε is 0 without contact.
    """
    vec3, _ = types(dtype)
    _pose, anchor_type = pose_types(dtype)
    rest_type, gap, slip = wp.types.vector(8, dtype), gap_of(dtype, solids), slip_of(dtype, law)
    slope, limit = contact.bounded_slope if bounded else contact.slope, law.limit

    @wp.kernel(module="unique", enable_backward=False)
    def anchor(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        colliders: filters(dtype),
        # state in
        x: wp.array(dtype=vec3),
        # parameters
        collider: int,
        distance: dtype,
        # in and out
        anchors: wp.array(dtype=anchor_type),
        rest: wp.array(dtype=rest_type),
    ):
        e = wp.tid()
        i = stencil[e, 0]
        copy = i // colliders.per_copy
        pose = colliders.poses.before[copy, collider]
        X = to_local(pose, x[i])
        d, n = gap(colliders.shape, collider, X)
        depth = -slope(d, distance)
        if depth > dtype(0.0):
            a = X - slip(anchors[i], X, n)
            now = colliders.poses.at[copy, collider]
            target = to_space(now, a)
            normal = rotated(now, n)
            r = rest_type()
            for k in range(3):
                r[k] = target[k]
                r[3 + k] = normal[k]
            r[6] = limit(depth, colliders.shape.friction[collider])
            r[7] = rest[e][7]
            rest[e] = r
            anchors[i] = anchor_type(a[0], a[1], a[2], r[6])
        elif rest[e][6] != dtype(0.0) or anchors[i][3] != dtype(0.0):
            rest[e][6] = dtype(0.0)
            anchors[i] = anchor_type()

    return anchor
