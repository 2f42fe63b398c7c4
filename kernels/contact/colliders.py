"""Factories of what contact and the filter know of colliders: shapes, poses, motion, and rest states where a step begins.

A pose is a position and a quaternion (x, y, z, w), seven numbers.
"""

from functools import cache
from typing import Any

import warp as wp

from ..terms import contact
from ..terms.contact import gap_to, turned
from ..vectors import types

MARCHES = wp.constant(32)  # maximum number of separating planes of a move past a convex collider
TRACES = wp.constant(512)  # maximum number of empty balls of a move past another collider


@cache
def pose_types(dtype):
    """Types of a pose, and of an anchor with its ε."""
    return wp.types.vector(7, dtype), wp.types.vector(4, dtype)


@cache
def shapes(dtype):
    """Struct of C colliders: ``kind``, see :func:`gap_of`, half sizes and radius of the shape, and friction μ."""
    vec3, _ = types(dtype)

    @wp.struct
    class Shapes:
        kind: wp.array(dtype=wp.int32)
        core: wp.array(dtype=vec3)
        radius: wp.array(dtype=dtype)
        friction: wp.array(dtype=dtype)

    return Shapes


@cache
def step_poses(dtype):
    """Struct of the poses (copies, colliders) at the start, at the end, and ``at`` the time of the forces of a step."""
    pose_type, _anchor = pose_types(dtype)

    @wp.struct
    class StepPoses:
        before: wp.array2d(dtype=pose_type)
        at: wp.array2d(dtype=pose_type)
        after: wp.array2d(dtype=pose_type)

    return StepPoses


@cache
def filters(dtype):
    """Struct of colliders, their ``poses`` in a step, and the numbers of the filter.

    A vertex may end at the distance ``least`` [m]. One that is stopped ends at most ``landing`` farther away [m].
    """

    @wp.struct
    class Filter:
        shape: shapes(dtype)
        poses: step_poses(dtype)
        per_copy: wp.int32
        least: dtype
        landing: dtype

    return Filter


@wp.func
def rotated(pose: Any, v: Any):
    """A vector v in the frame of a pose, in space."""
    return turned(type(v)(pose[3], pose[4], pose[5]), pose[6], v)


@wp.func
def to_local(pose: Any, x: Any):
    """The point x in the frame of a pose."""
    return turned(-type(x)(pose[3], pose[4], pose[5]), pose[6], x - type(x)(pose[0], pose[1], pose[2]))


@wp.func
def to_space(pose: Any, X: Any):
    """The point X in the frame of a pose, in space."""
    return rotated(pose, X) + type(X)(pose[0], pose[1], pose[2])


@cache
def move_colliders(dtype):
    """Kernel over (copies, colliders): the :func:`step_poses` of a step, with ``at`` after ``halves`` half steps.

    Between keyframes, velocities and angular velocities are constant. After the last keyframe colliders are at rest.
    """
    pose_type, _anchor = pose_types(dtype)
    quat_type = wp.types.quaternion(dtype=dtype)

    @wp.func
    def pose_at(keyframes: wp.array(dtype=pose_type), first: int, count: int, halves: int, per_frame: int):
        frame = wp.max(wp.min(halves // per_frame, count - 1), 0)
        found = keyframes[first + frame]
        if frame + 1 < count and halves > 0:
            after = keyframes[first + frame + 1]
            part = dtype(halves - frame * per_frame) / dtype(per_frame)
            q = wp.quat_slerp(
                quat_type(found[3], found[4], found[5], found[6]), quat_type(after[3], after[4], after[5], after[6]), part
            )
            for k in range(3):
                found[k] = (dtype(1.0) - part) * found[k] + part * after[k]
            for k in range(4):
                found[3 + k] = q[k]
        return found

    @wp.kernel(module="unique", enable_backward=False)
    def move(
        # elements
        keyframes: wp.array(dtype=pose_type),
        firsts: wp.array(dtype=wp.int32),
        # state in
        step: wp.array(dtype=wp.int32),
        # parameters
        steps_per_frame: int,
        halves: int,
        # out
        poses: step_poses(dtype),
    ):
        copy, c = wp.tid()
        first = firsts[c]
        count = firsts[c + 1] - first
        now = 2 * step[copy]
        poses.before[copy, c] = pose_at(keyframes, first, count, now, 2 * steps_per_frame)
        poses.at[copy, c] = pose_at(keyframes, first, count, now + halves, 2 * steps_per_frame)
        poses.after[copy, c] = pose_at(keyframes, first, count, now + 2, 2 * steps_per_frame)

    return move


@cache
def gap_of(dtype, solids):
    """Device function (shapes, collider, X) → the signed distance and its gradient, in the frame of the collider.

    ``solids`` are the :class:`..terms.contact.Solid` of the scene, the convex ones first. The ``kind`` of a collider is the
    number of those after its own.
    """
    vec3, _ = types(dtype)
    kind, first = len(solids) - 1, gap_to(solids[0])
    others = gap_of(dtype, solids[1:]) if kind else None

    @wp.func
    def gap(shape: shapes(dtype), c: int, X: vec3):
        d = X[1]
        n = X
        if wp.static(kind == 0):
            d, n = first(X, shape.core[c], shape.radius[c])
        else:
            if shape.kind[c] == wp.static(kind):
                d, n = first(X, shape.core[c], shape.radius[c])
            else:
                d, n = others(shape, c, X)
        return d, n

    return gap


@cache
def kept_part(dtype, solids):
    """Device function (shapes, collider, X, move, least) → the fraction of a move from X that is kept, in the collider's frame.

    A convex collider is behind the plane through its nearest point, normal to the distance. The move is kept until it is nearer
    to that plane than ``least``, or than its start if that is nearer. From there the next plane decides. Any other collider is
    outside the ball of radius d about a point at the distance d; the move is kept as far as it leads in this ball, less
    ``least``, or less half of its start if that is nearer (Hart 1996, *Sphere tracing*).
    """
    vec3, _ = types(dtype)
    gap, concave = gap_of(dtype, solids), sum(not each.convex for each in solids)

    @wp.func
    def kept(shape: shapes(dtype), c: int, X: vec3, move: vec3, least: dtype):
        d, n = gap(shape, c, X)
        t = dtype(0.0)
        if d > wp.length(move) + least:
            t = dtype(1.0)
        lowest = wp.min(least, d)
        most = MARCHES
        if wp.static(concave > 0):
            if shape.kind[c] < wp.static(concave) and d > dtype(0.0):
                lowest = wp.min(least, dtype(0.5) * d)
                most = TRACES
        k = wp.int32(0)
        while t < dtype(1.0) and k < most:
            k += 1
            approach = -wp.dot(move, n)
            if wp.static(concave > 0):
                if most == TRACES:
                    approach = wp.length(move)
            further = d - lowest
            if approach * (dtype(1.0) - t) <= further:
                t = dtype(1.0)
            elif further > dtype(0.01) * least:
                t += further / approach
                d, n = gap(shape, c, X + t * move)
            else:
                k = most
        return t

    return kept


@cache
def pose_collider(dtype, solids):
    """Kernel over contact elements of one collider at the start of a step: rest states with its pose, or with a half-space.

    If the prediction x + h v + h² g of a vertex crosses the collider, it has contact with the half-space behind the tangent
    plane where it meets the collider, for beyond a thin collider no force would lead it back. Explicit steps have h = 0.
    """
    vec3, _ = types(dtype)
    gap, kept = gap_of(dtype, solids), kept_part(dtype, solids)
    rest_type, (pose_type, _anchor) = wp.types.vector(contact.PARAMETERS, dtype), pose_types(dtype)

    @wp.func
    def behind(point: vec3, normal: vec3):
        """The pose of the half-space behind the plane with this point and normal."""
        turn = vec3(normal[2], dtype(0.0), -normal[0])
        w = dtype(1.0) + normal[1]
        size = wp.sqrt(wp.dot(turn, turn) + w * w)
        if w <= dtype(0.0) or size == dtype(0.0):
            return pose_type(point[0], point[1], point[2], dtype(1.0), dtype(0.0), dtype(0.0), dtype(0.0))
        turn /= size
        return pose_type(point[0], point[1], point[2], turn[0], turn[1], turn[2], w / size)

    @wp.kernel(module="unique", enable_backward=False)
    def set_pose(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        colliders: filters(dtype),
        gravity: wp.array(dtype=vec3),
        per_gravity: int,
        # state in
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        # parameters
        collider: int,
        h: dtype,
        # in and out
        rest: wp.array(dtype=rest_type),
    ):
        e = wp.tid()
        i = stencil[e, 0]
        copy = i // colliders.per_copy
        pose = colliders.poses.at[copy, collider]
        core = colliders.shape.core[collider]
        radius = colliders.shape.radius[collider]
        if wp.isfinite(core[0]) and h > dtype(0.0):
            way = h * (v[i] + h * gravity[i // per_gravity])
            X = to_local(colliders.poses.before[copy, collider], x[i])
            way = to_local(colliders.poses.after[copy, collider], x[i] + way) - X
            t = kept(colliders.shape, collider, X, way, colliders.least)
            if t < dtype(1.0):
                X = X + t * way
                d, n = gap(colliders.shape, collider, X)
                position = to_space(pose, X - d * n)
                pose = behind(position, rotated(pose, n))
                core = vec3(dtype(wp.inf), dtype(wp.inf), dtype(wp.inf))
                radius = dtype(0.0)
        r = rest[e]
        changed = wp.isfinite(r[7]) != wp.isfinite(core[0])  # few are
        for k in range(7):
            changed = changed or r[k] != pose[k]
        if changed:
            for k in range(7):
                r[k] = pose[k]
            for k in range(3):
                r[7 + k] = core[k]
            r[10] = radius
            rest[e] = r

    return set_pose
