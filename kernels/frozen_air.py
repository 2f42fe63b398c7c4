"""The kernel that freezes the forces of air where a step begins (:mod:`.terms.air`)."""

from functools import cache

import warp as wp

from .terms.air import AIR
from .vectors import types


@wp.func
def calm(_position: wp.vec3, _time: wp.float32):
    """No wind."""
    return wp.vec3()


@cache
def set_air(dtype, parts: int, explicit: bool, blow: wp.Function = calm):
    """Kernel over triangles: a, n, κ_n and κ_t of rest, from x, v and the wind.

    a is the centre after hₑ with the wind; velocities are those from x, or, with ``parts``, from x + move/parts (BDF2: 3). If
    ``explicit``, y stays at x, and a is that much farther back. A triangle without area has no force. Wind is that of the rest
    state, of keyframes (F,) ``ahead`` of the step, or ``blow`` at the centre, at most as fast as that of the rest state.
    """
    vec3, _ = types(dtype)
    rest_type = wp.types.vector(AIR.parameters, dtype)

    @wp.func
    def wind_at(position: wp.vec3, time: wp.float32) -> wp.vec3:
        return blow(position, time)

    @wp.kernel(module="unique", enable_backward=False)
    def set_each(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        keyframes: wp.array(dtype=vec3),
        # state in
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        step: wp.array(dtype=wp.int32),
        # parameters
        he: dtype,
        ahead: int,
        steps_per_frame: int,
        frame_time: dtype,
        per_copy: int,
        # in and out
        rest: wp.array(dtype=rest_type),
    ):
        e = wp.tid()
        i = stencil[e, 0]
        j = stencil[e, 1]
        k = stencil[e, 2]
        r = rest[e]
        third = dtype(1.0) / dtype(3.0)
        wind = vec3(r[8], r[9], r[10])
        after = ahead
        if step:
            after = step[i // per_copy] + ahead
        if keyframes:
            frame = after // steps_per_frame
            part = dtype(after - frame * steps_per_frame) / dtype(steps_per_frame)
            last = keyframes.shape[0] - 1
            wind = (dtype(1.0) - part) * keyframes[wp.min(frame, last)] + part * keyframes[wp.min(frame + 1, last)]
        velocity = third * (v[i] + v[j] + v[k])
        centre = third * (x[i] + x[j] + x[k])
        if wp.static(blow is not calm):
            time = dtype(after) / dtype(steps_per_frame) * frame_time
            blown = wind_at(wp.vec3(wp.float32(centre[0]), wp.float32(centre[1]), wp.float32(centre[2])), wp.float32(time))
            most = wp.length(wind)
            wind = vec3(dtype(blown[0]), dtype(blown[1]), dtype(blown[2]))
            speed = wp.length(wind)
            if speed > most:
                wind *= most / speed
        away = wind - velocity
        both = wp.cross(x[j] - x[i], x[k] - x[i])
        double_area = wp.length(both)
        n = vec3()
        if double_area > dtype(0.0):
            n = both / double_area
        normal = wp.dot(n, away)
        across = away - normal * n
        if wp.static(parts > 0):
            centre += dtype(1.0) / dtype(parts) * third * (move[i] + move[j] + move[k])
        way = he * wind
        if wp.static(explicit):
            way = he * away
        for c in range(3):
            r[c] = centre[c] + way[c]
            r[3 + c] = n[c]
        share = double_area / (dtype(4.0) * he)
        r[6] = share * r[11] * wp.abs(normal)
        r[7] = share * r[12] * wp.length(across)
        rest[e] = r

    return set_each
