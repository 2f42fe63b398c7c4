"""Factory of the kernels that find whether a step may come near a collider, by balls around vertices that contain none."""

from functools import cache

import warp as wp

from ..rotation import epsilon
from ..terms.contact import ROUNDED_BOX
from ..vectors import types
from .colliders import gap_of, of_pose, shapes, step_poses


@cache
def balls(dtype):
    """Struct of the balls of vertices: center and radius [m]. No collider is in the ball at the start of step ``found``.

    Surfaces of colliders move by at most ``drift`` per step [m]. ``distance`` is the contact distance [m]. ``x``, ``v`` and
    ``step`` are those at the start of the last step.
    """

    @wp.struct
    class Balls:
        balls: wp.array(dtype=wp.types.vector(4, dtype))
        found: wp.array(dtype=wp.int32)
        x: wp.array(dtype=types(dtype)[0])
        v: wp.array(dtype=types(dtype)[0])
        step: wp.array(dtype=wp.int32)
        drift: dtype
        distance: dtype

    return Balls


@cache
def near_colliders(dtype, ended: bool):
    """Kernel over vertices: near = 1 if a vertex may come within the contact distance of a collider in a step.

    Before steps of duration h, together, a vertex is assumed to move by twice its prediction, 2‖h v + h² g‖, and x, v and
    ``step`` are saved. After a step (``ended``), it moved from ``x`` to ``end``. The distance from x to the colliders decides.
    A ball that contains the motion makes this distance unnecessary. When one vertex is near, the others are skipped.
    """
    vec3, _ = types(dtype)
    to_local, _to_space = of_pose(dtype)
    gap, ball_type = gap_of(dtype, (ROUNDED_BOX,)), wp.types.vector(4, dtype)

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
        copy = i // per_copy
        x0 = x[i]
        now = step[copy]
        if wp.static(not ended):
            clear.x[i] = x0
            clear.v[i] = v[i]
            if i == copy * per_copy:
                clear.step[copy] = now
        if near[0] != 0:
            return
        way = clear.drift
        if wp.static(ended):
            way += wp.length(end[i] - x0)
        else:
            way += dtype(2.0) * h * wp.length(v[i] + h * gravity[i // per_gravity])
        ball = clear.balls[i]
        off = wp.length(x0 - vec3(ball[0], ball[1], ball[2])) + clear.drift * dtype(wp.abs(now - clear.found[i]))
        if not (off + way <= ball[3]):
            radius = dtype(wp.inf)
            for c in range(shape.radius.shape[0]):
                d, _n = gap(shape, c, to_local(poses.before[copy, c], x0))
                radius = wp.min(radius, d)
            radius -= clear.distance + dtype(8.0) * epsilon(radius) * wp.max(wp.abs(x0))
            clear.balls[i] = ball_type(x0[0], x0[1], x0[2], radius)
            clear.found[i] = now
            if not (way <= radius):
                near[0] = 1

    return find
