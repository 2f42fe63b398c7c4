"""Factory of the kernels that tell whether a step may come near a collider, by balls about vertices in which there is none."""

from functools import cache

import warp as wp

from .colliders import local_gap_of, of_pose, shapes, step_poses
from .rotation import epsilon
from .vectors import types


@cache
def balls(dtype):
    """The struct of a center and a radius of each vertex, among the colliders before step ``found``.

    From there the surface of none moves on by more than ``drift`` a step [m]. ``distance`` is the contact distance [m].
    """

    @wp.struct
    class Balls:
        balls: wp.array(dtype=wp.types.vector(4, dtype))
        found: wp.array(dtype=wp.int32)
        drift: dtype
        distance: dtype

    return Balls


@cache
def near_colliders(dtype, ended: bool):
    """Kernel over vertices: near = 1 if one comes within the contact distance of a collider in a step.

    Before a step it is asked for twice the way of its prediction, 2‖h v + h² g‖; of one that has ``ended``, for the way from
    ``x`` to ``end``. The distance from x to the colliders decides, and depends on the state alone; a ball spares finding it
    where it is large enough for both ways one after another. Once one is near, no other need be looked at.
    """
    vec3, _ = types(dtype)
    to_local, _to_space = of_pose(dtype)
    ball_type = wp.types.vector(4, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def find(
        # elements
        shape: shapes(dtype),
        gravity: wp.array(dtype=vec3),
        per_gravity: int,
        # state in
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        end: wp.array(dtype=vec3),
        poses: step_poses(dtype),
        step: wp.array(dtype=wp.int32),
        # parameters
        per_copy: int,
        h: dtype,
        # in and out
        clear: balls(dtype),
        near: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        if near[0] != 0:
            return
        copy = i // per_copy
        x0 = x[i]
        way = clear.drift
        if wp.static(ended):
            way += wp.length(end[i] - x0)
        else:
            way += dtype(2.0) * h * wp.length(v[i] + h * gravity[i // per_gravity])
        ball = clear.balls[i]
        now = step[copy]
        off = wp.length(x0 - vec3(ball[0], ball[1], ball[2])) + clear.drift * dtype(wp.abs(now - clear.found[i]))
        if not (off + way <= ball[3]):
            radius = dtype(wp.inf)
            for c in range(shape.radius.shape[0]):
                d, _n = local_gap_of(to_local(poses.before[copy, c], x0), shape.core[c], shape.radius[c])
                radius = wp.min(radius, d)
            radius -= clear.distance + dtype(8.0) * epsilon(radius) * wp.max(wp.abs(x0))
            clear.balls[i] = ball_type(x0[0], x0[1], x0[2], radius)
            clear.found[i] = now
            if not (way <= radius):
                near[0] = 1

    return find
