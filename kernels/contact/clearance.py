"""Kernels that find whether a step may come near a collider, by balls around vertices that contain none."""

from functools import cache

import warp as wp

from ..rotation import epsilon
from ..terms.contact import ROUNDED_BOX
from ..vectors import types
from .colliders import filters, gap_of, to_local


@cache
def clearances(dtype):
    """Struct of the distances of vertices to colliders that stand still.

    No collider is within the contact ``distance`` [m] of the ball (centre, radius) of a vertex, so a vertex that stays in its
    ball needs no distances. ``near`` and ``before`` (B,) are 1 for copies with a vertex that may come near in this and in the
    last step; ``some`` is 1 if any is. All ``followed`` steps refresh contact.
    """

    @wp.struct
    class Clearances:
        balls: wp.array(dtype=wp.types.vector(4, dtype))
        near: wp.array(dtype=wp.int32)
        before: wp.array(dtype=wp.int32)
        some: wp.array(dtype=wp.int32)
        followed: wp.array(dtype=wp.int32)
        distance: dtype

    return Clearances


@cache
def near_colliders(dtype):
    """Kernel over vertices: due = 1 if a vertex may come near a collider in a step.

    At the start, where ``end`` is None, the bound on the motion is ‖h v + h² g‖ + ``distance``; after a step, ‖end − x‖. due is
    also 1 if a copy was near before, because a refresh then has to remove its anchors and half-spaces.
    """
    vec3, _ = types(dtype)
    gap, ball_type = gap_of(dtype, (ROUNDED_BOX,)), wp.types.vector(4, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def find(
        # elements
        colliders: filters(dtype),
        gravity: wp.array(dtype=vec3),
        per_gravity: int,
        # state in
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        end: wp.array(dtype=vec3),
        # parameters
        h: dtype,
        # in and out
        clear: clearances(dtype),
        due: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        copy = i // colliders.per_copy
        way = dtype(0.0)
        if end:
            if due[0] != 0:
                return
            way = wp.length(end[i] - x[i])
        else:
            if i == copy * colliders.per_copy and wp.max(clear.before[copy], clear.followed[0]) != 0:
                due[0] = 1
            if clear.near[copy] != 0:
                return
            way = h * wp.length(v[i] + h * gravity[i // per_gravity]) + clear.distance
        ball = clear.balls[i]
        if not (wp.length(x[i] - vec3(ball[0], ball[1], ball[2])) + way <= ball[3]):
            radius = dtype(wp.inf)
            for c in range(colliders.shape.radius.shape[0]):
                d, _n = gap(colliders.shape, c, to_local(colliders.poses.before[copy, c], x[i]))
                radius = wp.min(radius, d)
            radius -= clear.distance + dtype(8.0) * epsilon(radius) * wp.max(wp.abs(x[i]))
            clear.balls[i] = ball_type(x[i][0], x[i][1], x[i][2], radius)
            if not (way <= radius):
                due[0] = 1
                if not end:
                    clear.near[copy] = 1
                    clear.some[0] = 1

    return find
