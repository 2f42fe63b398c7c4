"""Kernels that add loads to gravity as accelerations, once per step."""

from functools import cache

import warp as wp

from .vectors import types


@cache
def dead_forces(dtype):
    """Struct of dead forces [N]: keyframes[frame, copy, k] acts on the k-th loaded vertex of a copy."""
    vec3, _ = types(dtype)

    @wp.struct
    class DeadForces:
        per_copy: int
        vertices: wp.array(dtype=wp.int32)
        keyframes: wp.array3d(dtype=vec3)

    return DeadForces


@cache
def pressures(dtype):
    """Struct of pressures on triangles [Pa], and offsets and 3·triangle + corner of the loaded vertices."""

    @wp.struct
    class Pressures:
        triangles: wp.array2d(dtype=wp.int32)
        keyframes: wp.array3d(dtype=dtype)
        offsets: wp.array(dtype=wp.int32)
        codes: wp.array(dtype=wp.int32)

    return Pressures


@cache
def set_loads(dtype, moved: bool):
    """Kernel over (copies, loaded vertices): force = f(t) + Σ p(t)/6 (x₁ − x₀)×(x₂ − x₀), and a = g + force/m.

    The sum is over triangles at the vertex, a third of p A n each, at x, or if ``moved`` at x + scale·move. Values are of the
    keyframes at ``step + ahead``, ``steps_per_frame`` apart, linear between, constant after.
    """
    vec3, _ = types(dtype)

    @wp.func
    def at(x: wp.array(dtype=vec3), move: wp.array(dtype=vec3), scale: dtype, i: int):
        found = x[i]
        if wp.static(moved):
            found = found + scale * move[i]
        return found

    @wp.kernel(module="unique", enable_backward=False)
    def set_each(
        # elements
        dead: dead_forces(dtype),
        pressed: pressures(dtype),
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        # state in
        x: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        step: wp.array(dtype=wp.int32),
        # parameters
        scale: dtype,
        ahead: int,
        steps_per_frame: int,
        # out
        force: wp.array(dtype=vec3),
        acceleration: wp.array(dtype=vec3),
    ):
        copy, k = wp.tid()
        after = ahead
        if step:
            after = step[copy] + ahead
        frame = after // steps_per_frame
        part = dtype(after - frame * steps_per_frame) / dtype(steps_per_frame)
        one = wp.min(frame, dead.keyframes.shape[0] - 1)
        two = wp.min(frame + 1, dead.keyframes.shape[0] - 1)
        total = (dtype(1.0) - part) * dead.keyframes[one, copy, k] + part * dead.keyframes[two, copy, k]
        first = copy * dead.per_copy
        i = first + dead.vertices[k]
        if pressed.codes:
            one = wp.min(frame, pressed.keyframes.shape[0] - 1)
            two = wp.min(frame + 1, pressed.keyframes.shape[0] - 1)
            for entry in range(pressed.offsets[k], pressed.offsets[k + 1]):
                t = pressed.codes[entry]
                p = (dtype(1.0) - part) * pressed.keyframes[one, copy, t] + part * pressed.keyframes[two, copy, t]
                a = at(x, move, scale, first + pressed.triangles[t, 0])
                b = at(x, move, scale, first + pressed.triangles[t, 1])
                c = at(x, move, scale, first + pressed.triangles[t, 2])
                total += (p / dtype(6.0)) * wp.cross(b - a, c - a)
        force[i] = total
        acceleration[i] = gravity[copy] + inverse_mass[i] * total

    return set_each
