"""Kernels of time integration: prediction, end of step, pins.

A pin has inverse mass 0; moved ones follow their keyframes. hₑ is the effective step of the integrator.
"""

from functools import cache

import warp as wp

from .vectors import types


@cache
def predict(dtype):
    """Kernel over vertices: v += hₑ g, x += hₑ v, which gives x̃."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def predict_vertices(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        he: dtype,
        # in and out
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if inverse_mass[i] > dtype(0.0):
            after = v[i] + he * gravity[i // per_copy]
            v[i] = after
            x[i] = x[i] + he * after

    return predict_vertices


@cache
def start_bdf2(dtype):
    """Kernel over vertices: move ← x₀ − x₋₁ = h(v₁ − 7/4(v₂ − v₁)), v₋₁ ← v₀ − 3/2(v₁ − v₀), from two Euler steps with hₑ =
    2h/3; v₋₁ has v₁ before.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def start(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        # state in
        v: wp.array(dtype=vec3),
        second: wp.array(dtype=vec3),
        # parameters
        h: dtype,
        # in and out
        move: wp.array(dtype=vec3),
        v_before: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if inverse_mass[i] > dtype(0.0):
            first = v_before[i]
            move[i] = h * (first - dtype(1.75) * (second[i] - first))
            v_before[i] = v[i] - dtype(1.5) * (first - v[i])

    return start


@cache
def predict_bdf2(dtype):
    """Kernel over vertices: v ← (4v₀ − v₋₁)/3 + hₑ g, move ← (x₀ − x₋₁)/3 + hₑ v, x += move, v₋₁ ← v₀.

    That is x̃ = (4x₀ − x₋₁)/3 + hₑ v.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def predict_vertices(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        he: dtype,
        # in and out
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        v_before: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if inverse_mass[i] > dtype(0.0):
            third = dtype(1.0) / dtype(3.0)
            now = v[i]
            after = now + third * (now - v_before[i]) + he * gravity[i // per_copy]
            v_before[i] = now
            v[i] = after
            move[i] = third * move[i] + he * after
            x[i] = x[i] + move[i]

    return predict_vertices


@cache
def keyframed_position(dtype):
    """Device function (keyframes, pin, step, steps per keyframe) → position, linear between keyframes, constant after them."""
    vec3, _ = types(dtype)

    @wp.func
    def position(keyframes: wp.array2d(dtype=vec3), p: int, step: int, steps_per_frame: int):
        last = keyframes.shape[0] - 1
        frame = wp.min(step // steps_per_frame, last)
        found = keyframes[frame, p]
        if frame < last:
            part = dtype(step - frame * steps_per_frame) / dtype(steps_per_frame)
            found = (dtype(1.0) - part) * found + part * keyframes[frame + 1, p]
        return found

    return position


@cache
def move_pins(dtype):
    """Kernel over (copies, pins): sets x of pinned vertices to their keyframes one step later, and v = (x − x before)/h.

    Each copy counts its steps, ``steps_per_frame`` per keyframe. Pins on some ``axes`` move along these, with x before from
    keyframes too.
    """
    vec3, _ = types(dtype)
    position = keyframed_position(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def move(
        # elements
        pins: wp.array(dtype=wp.int32),
        keyframes: wp.array2d(dtype=vec3),
        axes: wp.array(dtype=vec3),
        # state in
        step: wp.array(dtype=wp.int32),
        # parameters
        steps_per_frame: int,
        per_copy: int,
        h: dtype,
        # in and out
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
    ):
        copy, p = wp.tid()
        i = copy * per_copy + pins[p]
        after = position(keyframes, p, step[copy] + 1, steps_per_frame)
        if axes:
            before = position(keyframes, p, wp.max(step[copy], 0), steps_per_frame)
            for axis in range(3):
                if axes[p][axis] > dtype(0.0):
                    v[i][axis] = (after[axis] - before[axis]) / h
                    x[i][axis] = after[axis]
        else:
            v[i] = (after - x[i]) / h
            x[i] = after

    return move


@cache
def count_step():
    @wp.kernel(module="unique", enable_backward=False)
    def count(
        # in and out
        step: wp.array(dtype=wp.int32),
    ):
        copy = wp.tid()
        step[copy] = step[copy] + 1

    return count


@cache
def finish(dtype):
    """Kernel over vertices, after a prediction and a correction d: x += d, v += d/hₑ.

    Pins keep x and v.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def finish_vertices(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        # state in
        correction: wp.array(dtype=vec3),
        # parameters
        he: dtype,
        # in and out
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if inverse_mass[i] > dtype(0.0):
            x[i] = x[i] + correction[i]
            v[i] = v[i] + correction[i] / he

    return finish_vertices


@cache
def finish_midpoint(dtype):
    """Kernel over vertices, after a prediction to the midpoint and a correction d: x₁ = 2(x̃ + d) − x₀, v₁ = 2(ṽ + d/hₑ) − v₀.

    With ṽ = v₀ + hₑ g from the prediction: x += 2d + hₑ ṽ, v += 2d/hₑ + hₑ g. Pins keep x and v.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def finish_vertices(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        # state in
        correction: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        he: dtype,
        # in and out
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if inverse_mass[i] > dtype(0.0):
            twice = dtype(2.0) * correction[i]
            x[i] = x[i] + (twice + he * v[i])
            v[i] = v[i] + twice / he + he * gravity[i // per_copy]

    return finish_vertices


@cache
def note_move(dtype):
    """Kernel over vertices, after a correction d: move += d, which gives x₁ − x₀; along pinned axes move = h v."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def note(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        mobility: wp.array(dtype=vec3),
        # state in
        correction: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        # parameters
        h: dtype,
        # in and out
        move: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        held = h * v[i]
        if inverse_mass[i] > dtype(0.0):
            free = move[i] + correction[i]
            if mobility:
                for axis in range(3):
                    if mobility[i][axis] == dtype(0.0):
                        free[axis] = held[axis]
            move[i] = free
        else:
            move[i] = held

    return note


@cache
def lock(dtype):
    """Kernel over vertices: sets the components of vectors along locked axes to 0."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def lock_coordinates(
        # elements
        mobility: wp.array(dtype=vec3),
        # in and out
        values: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        for axis in range(3):
            if mobility[i][axis] == dtype(0.0):
                values[i][axis] = dtype(0.0)

    return lock_coordinates


@cache
def reset(dtype, led: bool):
    """Kernel over vertices: resets copies where the mask (B,) is true; pins get v = 0.

    Pins with keyframes (``led``) start where the model has them, not at ``x_start``. Other state is given by addresses of
    arrays and of those to copy, or 0; with 32-bit words per vertex, or, if negative, per copy.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def reset_vertices(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        positions: wp.array(dtype=vec3),
        # state in
        x_start: wp.array(dtype=vec3),
        v_start: wp.array(dtype=vec3),
        starts: wp.array(dtype=wp.uint64),
        # parameters
        mask: wp.array(dtype=wp.bool),
        per_copy: int,
        words: wp.array(dtype=wp.int32),
        # out
        carried: wp.array(dtype=wp.uint64),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        copy = i // per_copy
        if mask[copy]:
            x[i] = x_start[i]
            v[i] = v_start[i]
            if inverse_mass[i] == dtype(0.0):
                v[i] = vec3()
                if wp.static(led):
                    x[i] = positions[i]
            for k in range(carried.shape[0]):
                count = words[k]
                row = i
                if count < 0:
                    count = -count
                    row = copy
                if words[k] > 0 or i == copy * per_copy:
                    end = (row + 1) * count
                    out = wp.array(ptr=carried[k], shape=(end,), dtype=wp.int32)
                    start = wp.array(ptr=starts[k], shape=(end,), dtype=wp.int32)
                    for word in range(row * count, end):
                        if starts[k] == wp.uint64(0):
                            out[word] = 0
                        else:
                            out[word] = start[word]

    return reset_vertices
