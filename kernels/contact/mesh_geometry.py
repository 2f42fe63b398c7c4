"""Factories of the structs of mesh colliders and of their motion in a step, and of device functions on triangles.

Everything is in the frame of the collider. Points of the mesh move linearly between its keyframes, and so within a step.
``halves`` are numbers of half steps. Distances are unsigned: a vertex starts on one side of the surface, and the filter never
lets it cross. So open and non-manifold meshes, and meshes with inconsistent winding, work like closed ones.
"""

from functools import cache

import warp as wp

from ..vectors import types
from .colliders import pose_types


@cache
def meshes(dtype):
    """Struct of the meshes of C colliders. ``points`` has the keyframes of all meshes, ``triangles`` their triangles.

    For each collider: the hierarchy ``bvh`` or 0, the index of the first triangle, the index of the first point, the points per
    keyframe, the number of keyframes, and the margin of the hierarchy for rounding.
    """
    vec3, _ = types(dtype)

    @wp.struct
    class Meshes:
        points: wp.array(dtype=vec3)
        triangles: wp.array(dtype=wp.vec3i)
        bvh: wp.array(dtype=wp.uint64)
        first_triangle: wp.array(dtype=wp.int32)
        first_point: wp.array(dtype=wp.int32)
        size: wp.array(dtype=wp.int32)
        frames: wp.array(dtype=wp.int32)
        margin: wp.array(dtype=wp.float32)

    return Meshes


@cache
def motions(dtype):
    """Struct of a step: the poses (copies, colliders) of :func:`.colliders.step_poses`, and parameters of all kernels.

    ``steps`` is the number of steps of h [s] of each copy. A frame has ``per_frame`` half steps. Forces are evaluated after
    ``ahead`` half steps. ``r`` is the contact distance, ``least`` the smallest distance that the filter allows, ``landing`` the
    distance at which it stops vertices, and predictions stop.
    """
    pose_type, _anchor = pose_types(dtype)

    @wp.struct
    class Motion:
        before: wp.array2d(dtype=pose_type)
        at: wp.array2d(dtype=pose_type)
        after: wp.array2d(dtype=pose_type)
        steps: wp.array(dtype=wp.int32)
        per_frame: wp.int32
        ahead: wp.int32
        h: dtype
        r: dtype
        least: dtype
        landing: dtype

    return Motion


@cache
def corners_of(dtype, wide):
    """Device function (mesh, c, triangle, halves, per_frame) → the corners of a triangle, as rows, in the precision ``wide``.

    They are those after ``halves`` half steps; a frame has ``per_frame`` half steps.
    """
    vec3, mat33 = types(wide)

    @wp.func
    def point(mesh: meshes(dtype), i: int):
        p = mesh.points[i]
        return vec3(wide(p[0]), wide(p[1]), wide(p[2]))

    @wp.func
    def corners(mesh: meshes(dtype), c: int, triangle: int, halves: int, per_frame: int):
        v = mesh.triangles[mesh.first_triangle[c] + triangle]
        first = mesh.first_point[c]
        frames = mesh.frames[c]
        found = mat33()
        if frames == 1:
            for k in range(3):
                found[k] = point(mesh, first + v[k])
        else:
            size = mesh.size[c]
            frame = wp.max(wp.min(halves // per_frame, frames - 1), 0)
            after = wp.min(frame + 1, frames - 1)
            part = wide(wp.max(halves, 0) - frame * per_frame) / wide(per_frame)
            if after == frame:
                part = wide(0.0)
            for k in range(3):
                a = point(mesh, first + frame * size + v[k])
                found[k] = a + part * (point(mesh, first + after * size + v[k]) - a)
        return found

    return corners


@cache
def geometry(dtype):
    """Device functions on triangles: :func:`corners_of`, ``from_triangle``, ``carry``."""
    vec3, mat33 = types(dtype)
    corners, zero, one = corners_of(dtype, dtype), dtype(0.0), dtype(1.0)

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

    @wp.func
    def frame_of(t: mat33):
        """An orthonormal frame of a triangle, as rows."""
        x = wp.normalize(t[1] - t[0])
        z = wp.normalize(wp.cross(t[1] - t[0], t[2] - t[0]))
        y = wp.cross(z, x)
        return mat33(x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2])

    @wp.func
    def carry(n: vec3, before: mat33, after: mat33):
        """A direction rotated with a triangle; unchanged for a degenerate triangle."""
        found = wp.transpose(frame_of(after)) * (frame_of(before) * n)
        return wp.where(wp.dot(found, found) > dtype(0.5), found, n)

    return corners, from_triangle, carry
