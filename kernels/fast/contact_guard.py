"""Contact with colliders inside an explicit step, with a ball around each vertex that contains no collider.

A step within the ball has no contact; others compute contact, friction, filter and the ball. Balls are not part of the state;
they stay valid when vertices are set.
"""

from functools import cache

import warp as wp

from ..contact.anchors import slip_of
from ..contact.collider_filter import FilterNotes, outside
from ..contact.colliders import filters, gap_of, pose_types, rotated, to_local
from ..coulomb import COULOMB, huber_secant
from ..explicit_step import kick_and_drift
from ..memory import load, store
from ..rotation import epsilon
from ..terms.contact import ROUNDED_BOX
from ..vectors import types
from .guard import ContactFactories


@cache
def guard_struct(dtype):
    """Struct of contact of vertices with C colliders.

    ``stiffness`` is kA (C, N) [N/m]. ``balls`` are centre and radius [m] at the start of step ``found`` (N,), infinite for
    pins. Surfaces move by at most ``drift`` per step [m].
    """
    _pose, anchor_type = pose_types(dtype)

    @wp.struct
    class Guard:
        filter: filters(dtype)
        stiffness: wp.array2d(dtype=dtype)
        anchors: wp.array2d(dtype=anchor_type)
        balls: wp.array(dtype=wp.types.vector(4, dtype))
        found: wp.array(dtype=wp.int32)
        steps: wp.array(dtype=wp.int32)
        notes: FilterNotes
        per_copy: int
        distance: dtype
        drift: dtype

    return Guard


@cache
def in_ball(dtype, moving: bool):
    """Device function (guard, i, step, before, after) → 1 if a step begins and ends in the ball of vertex i, else 0."""
    vec3, _ = types(dtype)
    ball_of, step_of = load(wp.types.vector(4, dtype)), load(wp.int32)

    @wp.func
    def clear(guard: guard_struct(dtype), i: int, step: int, before: vec3, after: vec3):
        ball = ball_of(guard.balls, i)
        radius = ball[3]
        if wp.static(moving):
            radius -= guard.drift * dtype(wp.abs(step - step_of(guard.found, i)) + 1)
        center = vec3(ball[0], ball[1], ball[2])
        begin = before - center
        end = after - center
        far = radius * wp.abs(radius)
        return wp.where(wp.dot(begin, begin) <= far, wp.where(wp.dot(end, end) <= far, wp.int32(1), wp.int32(0)), wp.int32(0))

    return clear


@cache
def touching_step(dtype, symplectic: bool):
    """Device function (guard, i, w, x, v, a, h) → x, v of vertex i after a step, with a = g − ∇U/m without contact.

    It is :func:`..contact.anchors.anchor_vertices` (``bounded``) and :func:`..contact.collider_filter.outside` in one.
    """
    vec3, _ = types(dtype)
    _pose, anchor_type = pose_types(dtype)
    gap, end_outside = gap_of(dtype, (ROUNDED_BOX,)), outside(dtype, (ROUNDED_BOX,))
    step, ball_type = kick_and_drift(dtype, symplectic), wp.types.vector(4, dtype)
    put, slip_along = store(ball_type), slip_of(dtype, COULOMB)

    @wp.func
    def touch(guard: guard_struct(dtype), i: int, w: dtype, x: vec3, v: vec3, a: vec3, h: dtype):
        copy = i // guard.per_copy
        force = vec3()
        held = wp.int32(0)
        for c in range(guard.filter.shape.radius.shape[0]):
            pose = guard.filter.poses.before[copy, c]
            X = to_local(pose, x)
            d, n = gap(guard.filter.shape, c, X)
            depth = wp.max(guard.distance - d, dtype(0.0))
            most = guard.filter.shape.friction[c] * depth
            slip = vec3()
            if depth > dtype(0.0):
                pull = depth * n
                if most > dtype(0.0):
                    held = 1
                    slip = slip_along(guard.anchors[c, i], X, n)
                    pull -= huber_secant(wp.length(slip), most) * slip
                force += guard.stiffness[c, i] * rotated(pose, pull)
            if guard.filter.shape.friction[c] > dtype(0.0):
                found = anchor_type()  # without contact 0, whatever the ball was
                if most > dtype(0.0):
                    X = X - slip
                    found = anchor_type(X[0], X[1], X[2], most)
                guard.anchors[c, i] = found
        after, _rest, velocity = step(x, vec3(), v, a + w * force, h)
        now = guard.steps[copy]
        end, velocity, _short = end_outside(x, after, velocity, h, i, now, guard.filter, guard.notes)
        radius = dtype(-1.0)  # no ball while there is an anchor: a later step must release it
        if held == 0:
            radius = dtype(wp.inf)
            for c in range(guard.filter.shape.radius.shape[0]):
                d, _n = gap(guard.filter.shape, c, to_local(guard.filter.poses.after[copy, c], end))
                radius = wp.min(radius, d)
            radius -= guard.distance + dtype(8.0) * epsilon(radius) * wp.max(wp.abs(end))
        put(guard.balls, i, ball_type(end[0], end[1], end[2], radius))
        guard.found[i] = now + 1
        return end, velocity

    return touch


CONTACT_GUARD = ContactFactories(guard_struct, in_ball, touching_step)
