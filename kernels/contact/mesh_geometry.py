"""Factories of the struct of mesh colliders, and of device functions on their points and on triangles."""

from functools import cache

import warp as wp

from ..vectors import types


@cache
def meshes(dtype):
    """Struct of the meshes of C colliders: the ``points`` of all keyframes of all meshes.

    For each collider: its first point, the points per keyframe, and the number of keyframes, 0 if it is not a mesh.
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
    """Device function (mesh, c, i, halves, per_frame) → point i of mesh c, in its frame, after ``halves`` half steps.

    A frame has ``per_frame`` of them. Points move linearly between keyframes, and stand still after the last.
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
    """Device function (p, corners) → distance of p to a triangle, and the direction away from it."""
    vec3, mat33 = types(dtype)
    zero, one = dtype(0.0), dtype(1.0)

    @wp.func
    def from_side(p: vec3, a: vec3, b: vec3):
        """The vector from the segment ab to p. A short one must not be tilted along ab by rounding, for the ends may be far."""
        e = b - a
        l = wp.dot(e, e)
        t = zero
        if l > zero:
            t = wp.clamp(wp.dot(p - a, e) / l, zero, one)
        y = p - a - t * e
        if t > zero and t < one:
            y -= wp.dot(y, e) / l * e
        return y

    @wp.func
    def from_triangle(p: vec3, t: mat33):
        a, b, c = t[0], t[1], t[2]
        n = wp.cross(b - a, c - a)
        w = vec3(wp.dot(wp.cross(c - b, p - b), n), wp.dot(wp.cross(a - c, p - c), n), wp.dot(wp.cross(b - a, p - a), n))
        size = w[0] + w[1] + w[2]
        if size > zero and w[0] >= zero and w[1] >= zero and w[2] >= zero:
            n = wp.normalize(n)
            d = wp.dot(n, p - a)
            return wp.abs(d), wp.where(d < zero, -n, n)
        best = dtype(wp.inf)
        away = vec3()
        for k in range(3):  # the sides opposite c, a and b
            if w[(k + 2) % 3] < zero or size <= zero:
                y = from_side(p, t[k], t[(k + 1) % 3])
                if wp.dot(y, y) < best:
                    best = wp.dot(y, y)
                    away = y
        d = wp.length(away)
        if d > zero:
            away = away / d
        return d, away

    return from_triangle
