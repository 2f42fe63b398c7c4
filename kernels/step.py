"""Factories of the kernels that move vertices through time: symplectic update, predict, finish, pins.

A pinned vertex has inverse mass 0. Fixed pins stay; moved ones take the place that their keyframes give at the end of the step.
"""

from functools import cache

import warp as wp

from .assemble import types


@cache
def explicit_update(dtype, symplectic: bool):
    """Kernel over vertices: kick and drift (symplectic), or drift and kick at the same state (forward Euler).

    a = g − ∇U/m;  symplectic: v += h a, x += h v;  forward: x += h v, v += h a. Leaves gradient at 0 for the next sum.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def update(
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        per_copy: int,
        h: dtype,
        # in and out
        gradient: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        w = inverse_mass[i]
        if w > dtype(0.0):
            before = v[i]
            after = before + h * (gravity[i // per_copy] - w * gradient[i])
            v[i] = after
            if wp.static(symplectic):
                x[i] = x[i] + h * after
            else:
                x[i] = x[i] + h * before
        gradient[i] = vec3()

    return update


@cache
def predict(dtype):
    """Kernel over vertices: x += h v + h² g, the place x̃ that inertia and gravity alone lead to."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def predict_vertices(
        inverse_mass: wp.array(dtype=dtype),
        v: wp.array(dtype=vec3),
        gravity: wp.array(dtype=vec3),
        per_copy: int,
        h: dtype,
        # in and out
        x: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if inverse_mass[i] > dtype(0.0):
            x[i] = x[i] + h * (v[i] + h * gravity[i // per_copy])

    return predict_vertices


@cache
def move_pins(dtype):
    """Kernel over (copies, pins): places the pinned vertices where the keyframes say they are at the end of this step.

    Step counter k in whole steps, ``steps_per_frame`` of them to a keyframe; between keyframes linear, after the last at rest.
    x is set, v = (x − x before)/h.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def move(
        pins: wp.array(dtype=wp.int32),
        keyframes: wp.array2d(dtype=vec3),
        step: wp.array(dtype=wp.int32),
        steps_per_frame: int,
        per_copy: int,
        h: dtype,
        # in and out
        x: wp.array(dtype=vec3),
        # out
        v: wp.array(dtype=vec3),
    ):
        copy, p = wp.tid()
        i = copy * per_copy + pins[p]
        after = step[0] + 1
        last = keyframes.shape[0] - 1
        frame = wp.min(after // steps_per_frame, last)
        part = dtype(after - frame * steps_per_frame) / dtype(steps_per_frame)
        place = keyframes[frame, p]
        if frame < last:
            place = (dtype(1.0) - part) * place + part * keyframes[frame + 1, p]
        v[i] = (place - x[i]) / h
        x[i] = place

    return move


@cache
def count_step():
    """Kernel of one thread: step[0] += 1."""

    @wp.kernel(module="unique", enable_backward=False)
    def count(step: wp.array(dtype=wp.int32)):
        step[0] = step[0] + 1

    return count


@cache
def finish(dtype):
    """Kernel over vertices, after a prediction and a correction d: x += d, v += h g + d/h.

    The same as v = (x − x before)/h, but d keeps the digits that large coordinates lose. Pins have d = 0 and keep their v.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def finish_vertices(
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        per_copy: int,
        h: dtype,
        # in and out
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if inverse_mass[i] > dtype(0.0):
            x[i] = x[i] + correction[i]
            v[i] = v[i] + h * gravity[i // per_copy] + correction[i] / h

    return finish_vertices
