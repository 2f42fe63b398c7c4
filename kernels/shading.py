"""Normals of triangles and of their corners, and bounding boxes of tubes."""

from functools import cache

import warp as wp


@cache
def tube_bounds():
    @wp.kernel(module="unique", enable_backward=False)
    def bound_tube(
        # elements
        ends: wp.array(dtype=wp.vec2i),
        radii: wp.array(dtype=wp.float32),
        # state in
        points: wp.array(dtype=wp.vec3),
        # out
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
    ):
        k = wp.tid()
        a = points[ends[k][0]]
        b = points[ends[k][1]]
        r = wp.vec3(radii[k], radii[k], radii[k])
        low[k] = wp.min(a, b) - r
        high[k] = wp.max(a, b) + r

    return bound_tube


@cache
def face_normals():
    """Kernel over triangles: unit normals (0 without area), and angles at the corners."""

    @wp.kernel(module="unique", enable_backward=False)
    def find_face_normal(
        # elements
        triangles: wp.array(dtype=wp.int32),
        # state in
        points: wp.array(dtype=wp.vec3),
        # out
        normals: wp.array(dtype=wp.vec3),
        angles: wp.array(dtype=wp.float32),
    ):
        t = wp.tid()
        a = points[triangles[3 * t]]
        b = points[triangles[3 * t + 1]]
        c = points[triangles[3 * t + 2]]
        n = wp.cross(b - a, c - a)
        area = wp.length(n)
        normals[t] = wp.normalize(n)
        angles[3 * t] = wp.atan2(area, wp.dot(b - a, c - a))
        angles[3 * t + 1] = wp.atan2(area, wp.dot(c - b, a - b))
        angles[3 * t + 2] = wp.atan2(area, wp.dot(a - c, b - c))

    return find_face_normal


@cache
def corner_normals():
    """Kernel over corners: mean of normals around the vertex, weighted by angles (Thürmer & Wüthrich 1998).

    Only normals within about 75° count, in either winding.
    """

    @wp.kernel(module="unique", enable_backward=False)
    def find_corner_normal(
        # elements
        triangles: wp.array(dtype=wp.int32),
        smooth: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        corners: wp.array(dtype=wp.int32),
        # state in
        face_normals: wp.array(dtype=wp.vec3),
        angles: wp.array(dtype=wp.float32),
        # out
        normals: wp.array(dtype=wp.vec3),
    ):
        corner = wp.tid()
        own = face_normals[corner // 3]
        n = own
        if smooth[corner // 3] != 0:
            n = wp.vec3()
            vertex = triangles[corner]
            for k in range(starts[vertex], starts[vertex + 1]):
                other = face_normals[corners[k] // 3]
                along = wp.dot(own, other)
                n += (wp.sign(along) * angles[corners[k]] * wp.smoothstep(0.25, 0.6, wp.abs(along))) * other
            n = wp.normalize(n)
        normals[corner] = n

    return find_corner_normal
