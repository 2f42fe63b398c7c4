"""Factories of the struct of mesh colliders, and of a device function on their points."""

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
