"""Factories of the struct of mesh colliders, and of device functions on their points and on triangles.
"""

from functools import cache

import warp as wp

from ..vectors import types


@cache
def meshes(dtype):
    """Struct of the meshes of C colliders: the ``points`` of all keyframes of all meshes.

    For each collider: the index of its first point, the points per keyframe, and the number of keyframes, 0 if it is not a mesh.
    """
    vec3, _ = types(dtype)

    @wp.struct
    class Meshes:
        points: wp.array(dtype=vec3)
        first_point: wp.array(dtype=wp.int32)
        size: wp.array(dtype=wp.int32)
        frames: wp.array(dtype=wp.int32)

    return Meshes


@cache
def point_at(dtype):
    """Device function (mesh, c, i, halves, per_frame) → point i of mesh c after ``halves`` half steps, in the frame of the collider.

    A frame has ``per_frame`` half steps. Points move linearly between keyframes, and stand still after the last.
    """

    @wp.func
    def point(mesh: meshes(dtype), c: int, i: int, halves: int, per_frame: int):
        frames = mesh.frames[c]
        frame = wp.max(wp.min(halves // per_frame, frames - 1), 0)
        here = mesh.first_point[c] + frame * mesh.size[c] + i
        found = mesh.points[here]
        if frame + 1 < frames:
            part = dtype(wp.max(halves, 0) - frame * per_frame) / dtype(per_frame)
            found = found + part * (mesh.points[here + mesh.size[c]] - found)
        return found

    return point


@cache
def nearest_on_triangle(dtype):
    """Device function (p, corners) → distance to a triangle, direction away from it, barycentric coordinates of the point."""
    vec3, mat33 = types(dtype)
    zero, one = dtype(0.0), dtype(1.0)

    @wp.func
    def nearer_side(p: vec3, a: vec3, b: vec3, best: dtype):
        """Squared distance of p to the segment from a to b, its parameter, and the vector to p, if below ``best``; else −1.

        A short vector must not be tilted along the segment by rounding, for the ends may be far.
        """
        e = b - a
        l = wp.dot(e, e)
        t = zero
        if l > zero:
            t = wp.clamp(wp.dot(p - a, e) / l, zero, one)
        y = p - a - t * e
        if t > zero and t < one:
            y -= wp.dot(y, e) / l * e
        s = wp.dot(y, y)
        return wp.where(s < best, s, -one), t, y

    @wp.func
    def from_triangle(p: vec3, t: mat33):
        """Distance to a triangle, direction away from it, and barycentric coordinates of the nearest point."""
        a = t[0]
        b = t[1]
        c = t[2]
        n = wp.cross(b - a, c - a)
        w = vec3(wp.dot(wp.cross(c - b, p - b), n), wp.dot(wp.cross(a - c, p - c), n), wp.dot(wp.cross(b - a, p - a), n))
        size = w[0] + w[1] + w[2]
        d = zero
        away = vec3()
        if size > zero and w[0] >= zero and w[1] >= zero and w[2] >= zero:
            w = w / size
            n = wp.normalize(n)
            d = wp.dot(n, p - a)
            away = wp.where(d < zero, -n, n)
            d = wp.abs(d)
        else:
            best = dtype(wp.inf)
            flat = size <= zero
            ta = vec3(one, zero, zero)
            if w[2] < zero or flat:
                s, at, y = nearer_side(p, a, b, best)
                if s >= zero:
                    best = s
                    ta = vec3(one - at, at, zero)
                    away = y
            if w[0] < zero or flat:
                s, at, y = nearer_side(p, b, c, best)
                if s >= zero:
                    best = s
                    ta = vec3(zero, one - at, at)
                    away = y
            if w[1] < zero or flat:
                s, at, y = nearer_side(p, c, a, best)
                if s >= zero:
                    best = s
                    ta = vec3(at, zero, one - at)
                    away = y
            w = ta
            d = wp.length(away)
            if d > zero:
                away = away / d
        return d, away, w

    return from_triangle
