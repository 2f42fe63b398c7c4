"""The surface of contact: the vertices of the cloth, and behind them those of mesh colliders, the *obstacles*.

All copies have N = B·n vertices of cloth, then B·m obstacles. Positions of both are in one array (N + B·m,).
"""

from functools import cache

import warp as wp

from ..memory import load
from ..pairs import Layout
from ..vectors import types
from .colliders import pose_types, step_poses, to_space

# Groups of elements: cloth, cloth with a vertex that cannot move, and obstacles.
CLOTH, HELD, OBSTACLE = wp.constant(0), wp.constant(1), wp.constant(2)


@wp.func
def copy_of(layout: Layout, i: int):
    """The copy of a vertex."""
    if i < layout.cloth:
        return i // layout.per_copy
    return (i - layout.cloth) // layout.obstacles


@wp.func
def in_copy(layout: Layout, i: int):
    """The index of a vertex in its copy, where obstacles follow the cloth."""
    if i < layout.cloth:
        return i % layout.per_copy
    return layout.per_copy + (i - layout.cloth) % layout.obstacles


@wp.func
def cloth_vertex(layout: Layout, s: wp.vec4i):
    """The first vertex of a pair that belongs to the cloth."""
    found = s[0]
    for k in range(1, 4):
        if found >= layout.cloth:
            found = s[k]
    return found


@wp.func
def has_obstacle(layout: Layout, s: wp.vec4i):
    """Whether one side of a pair belongs to a mesh."""
    return s[0] >= layout.cloth or s[3] >= layout.cloth


@wp.func
def obstacle_of(layout: Layout, s: wp.vec4i):
    """The last of the obstacles of a copy that is a vertex of a pair (−1: no vertex), or −1."""
    found = wp.int32(-1)
    for i in range(4):
        if s[i] >= layout.cloth:
            found = in_copy(layout, s[i]) - layout.per_copy
    return found


@cache
def vector_within(dtype):
    """Device function (p, i) → the move of vertex i, which is 0 beyond the array, where p is for the cloth alone."""
    vec3, _ = types(dtype)
    vector = load(vec3)

    @wp.func
    def vector_or_zero(p: wp.array(dtype=vec3), i: int):
        if i < p.shape[0]:
            return vector(p, i)
        return vec3()

    return vector_or_zero


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


@wp.struct
class Obstacles:
    """The collider and its vertex of each obstacle of a copy, (m,), and where the frames of colliders begin in ``present``."""

    collider: wp.array(dtype=wp.int32)
    vertex: wp.array(dtype=wp.int32)
    first_frame: wp.array(dtype=wp.int32)
    present: wp.array(dtype=wp.int32)


@cache
def find_obstacles(dtype):
    """Kernel over obstacles of all copies: positions at the ``poses`` of a step and, as float64, their ``moves`` in it [m].

    Forces are evaluated after ``ahead`` half steps, of which a frame has ``per_frame``. Points move linearly between keyframes,
    and stand still after the last. While a collider is absent, that is at one point for a whole step, positions are NaN, and
    moves 0.
    """
    vec3, _ = types(dtype)
    pose_type, _anchor = pose_types(dtype)

    @wp.func
    def point_at(mesh: meshes(dtype), pose: pose_type, c: int, vertex: int, halves: int, per_frame: int):
        frame = wp.min(wp.max(halves, 0) // per_frame, mesh.frames[c] - 1)
        here = mesh.first_point[c] + frame * mesh.size[c] + vertex
        point = mesh.points[here]
        if frame + 1 < mesh.frames[c]:
            part = dtype(wp.max(halves, 0) - frame * per_frame) / dtype(per_frame)
            point = point + part * (mesh.points[here + mesh.size[c]] - point)
        return to_space(pose, point)

    @wp.kernel(module="warpcloth.obstacles." + dtype.__name__, enable_backward=False)
    def find_each_obstacle(
        # elements
        layout: Layout,
        obstacles: Obstacles,
        mesh: meshes(dtype),
        # state in
        poses: step_poses(dtype),
        steps: wp.array(dtype=wp.int32),
        # parameters
        per_frame: int,
        ahead: int,
        # out
        before: wp.array(dtype=vec3),
        at: wp.array(dtype=vec3),
        after: wp.array(dtype=vec3),
        moves: wp.array(dtype=wp.vec3d),
    ):
        t = wp.tid()
        copy = t // layout.obstacles
        j = t - copy * layout.obstacles
        c = obstacles.collider[j]
        i = obstacles.vertex[j]
        now = 2 * steps[copy]
        frame = wp.min(wp.max(now, 0) // per_frame, mesh.frames[c] - 1)
        last = wp.min(frame + 1, mesh.frames[c] - 1)  # of this step, which ends at this frame or before
        first = obstacles.first_frame[c]
        before[t] = vec3(dtype(wp.nan), dtype(wp.nan), dtype(wp.nan))
        at[t] = before[t]
        after[t] = before[t]
        moves[t] = wp.vec3d()
        if wp.max(obstacles.present[first + frame], obstacles.present[first + last]) != 0:
            before[t] = point_at(mesh, poses.before[copy, c], c, i, now, per_frame)
            at[t] = point_at(mesh, poses.at[copy, c], c, i, now + ahead, per_frame)
            after[t] = point_at(mesh, poses.after[copy, c], c, i, now + 2, per_frame)
            moves[t] = wp.vec3d(after[t]) - wp.vec3d(before[t])

    return find_each_obstacle
