"""Kernels of quasi-Newton iterations with a constant matrix A. With w = A⁻¹∇φ(d), the plain step is d − w. Slot j of m holds a
step sⱼ of d, the change yⱼ of ∇φ, and zⱼ = A⁻¹yⱼ, the change of w.
"""

from functools import cache

import warp as wp

from .reduce import block_sums
from .vectors import types


@cache
def plain_step(dtype):
    """Kernel over vertices: out = d − w in active copies, else d; out may be d."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def step(
        # state in
        d: wp.array(dtype=vec3),
        w: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        # out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if active[i // per_copy] == 1:
            out[i] = d[i] - w[i]
        else:
            out[i] = d[i]

    return step


@cache
def note_change(dtype):
    """Kernel over vertices: y and z of the slot = changes of ∇φ and w, whose values it stores."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def note(
        # state in
        gradient: wp.array(dtype=vec3),
        w: wp.array(dtype=vec3),
        # parameters
        slot: wp.array(dtype=wp.int32),
        # in and out
        last_gradient: wp.array(dtype=vec3),
        last_w: wp.array(dtype=vec3),
        # out
        y: wp.array2d(dtype=vec3),
        z: wp.array2d(dtype=vec3),
    ):
        i = wp.tid()
        y[slot[0], i] = gradient[i] - last_gradient[i]
        z[slot[0], i] = w[i] - last_w[i]
        last_gradient[i] = gradient[i]
        last_w[i] = w[i]

    return note


@cache
def partial_products(dtype, block: int):
    """Kernel over (copies, 4m, lanes): parts of sⱼ·∇φ, zⱼ·∇φ, sⱼ·y and zⱼ·y for j < m, y of the current slot."""
    vec3, _ = types(dtype)
    store, _add_up = block_sums(block)

    @wp.kernel(module="unique", enable_backward=False)
    def multiply(
        # state in
        gradient: wp.array(dtype=vec3),
        s: wp.array2d(dtype=vec3),
        y: wp.array2d(dtype=vec3),
        z: wp.array2d(dtype=vec3),
        # parameters
        slot: wp.array(dtype=wp.int32),
        per_copy: int,
        lanes: int,
        # out
        parts: wp.array3d(dtype=wp.float64),
    ):
        copy, row, lane = wp.tid()
        m = s.shape[0]
        j, kind = row % m, row // m
        a = s[j]
        if kind % 2 == 1:
            a = z[j]
        b = gradient
        if kind >= 2:
            b = y[slot[0]]
        total = wp.float64(0.0)
        for i in range(copy * per_copy + lane, (copy + 1) * per_copy, lanes):
            total += wp.float64(wp.dot(a[i], b[i]))
        store(lane, total, parts[row], copy)

    return multiply


@cache
def finish_products(block: int):
    """Kernel over (copies, 4m, lanes of one block): out = the sums of the parts."""
    _store, add_up = block_sums(block)

    @wp.kernel(module="unique", enable_backward=False)
    def add_parts(
        # state in
        parts: wp.array3d(dtype=wp.float64),
        # out
        out: wp.array2d(dtype=wp.float64),
    ):
        copy, row, lane = wp.tid()
        total = add_up(lane, parts[row], copy)
        if lane == 0:
            out[copy, row] = total

    return add_parts


@cache
def combine(dtype):
    """Kernel over vertices: out = d − c₀ w + Σⱼ aⱼ sⱼ + bⱼ zⱼ with coefficients (c₀, a, b), (B, 1 + 2m).

    Slots with a coefficient of 0 may hold NaN.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def combine_histories(
        # state in
        d: wp.array(dtype=vec3),
        w: wp.array(dtype=vec3),
        s: wp.array2d(dtype=vec3),
        z: wp.array2d(dtype=vec3),
        # parameters
        coefficients: wp.array2d(dtype=wp.float64),
        per_copy: int,
        # out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        copy = i // per_copy
        m = s.shape[0]
        total = vec3()
        if coefficients[copy, 0] != wp.float64(0.0):
            total -= dtype(coefficients[copy, 0]) * w[i]
        for j in range(m):
            if coefficients[copy, 1 + j] != wp.float64(0.0):
                total += dtype(coefficients[copy, 1 + j]) * s[j, i]
            if coefficients[copy, 1 + m + j] != wp.float64(0.0):
                total += dtype(coefficients[copy, 1 + m + j]) * z[j, i]
        out[i] = d[i] + total

    return combine_histories


@cache
def accept(dtype):
    """Kernel over vertices: d = the accelerated candidate if its φ is at most that of the plain one, never NaN.

    s of the slot is the step, 0 where ``stayed`` (or None) is 1.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def accept_candidate(
        # state in
        plain: wp.array(dtype=vec3),
        accelerated: wp.array(dtype=vec3),
        plain_energy: wp.array(dtype=wp.float64),
        energy: wp.array(dtype=wp.float64),
        stayed: wp.array(dtype=wp.int32),
        # parameters
        slot: wp.array(dtype=wp.int32),
        per_copy: int,
        # in and out
        d: wp.array(dtype=vec3),
        # out
        s: wp.array2d(dtype=vec3),
    ):
        i = wp.tid()
        copy = i // per_copy
        chosen = wp.where(energy[copy] <= plain_energy[copy], accelerated[i], plain[i])
        if stayed:
            if stayed[copy] == 1:
                chosen = d[i]
        s[slot[0], i] = chosen - d[i]
        d[i] = chosen

    return accept_candidate


@cache
def note_lowest():
    """Kernel over copies: stayed = 1 if both candidates raise φ by more than the fraction ``noise``, NaN excepted; updates the
    lowest φ.
    """

    @wp.kernel(module="unique", enable_backward=False)
    def note(
        # state in
        plain_energy: wp.array(dtype=wp.float64),
        energy: wp.array(dtype=wp.float64),
        # parameters
        noise: wp.float64,
        # in and out
        lowest: wp.array(dtype=wp.float64),
        # out
        stayed: wp.array(dtype=wp.int32),
    ):
        copy = wp.tid()
        now = wp.where(energy[copy] <= plain_energy[copy], energy[copy], plain_energy[copy])
        stayed[copy] = wp.where(now > lowest[copy] + noise * wp.abs(lowest[copy]), 1, 0)
        if now < lowest[copy]:
            lowest[copy] = now

    return note


@cache
def next_slot():
    """Kernel of one thread: slot[0] = (slot[0] + 1) mod m."""

    @wp.kernel(module="unique", enable_backward=False)
    def advance(
        # parameters
        m: int,
        # in and out
        slot: wp.array(dtype=wp.int32),
    ):
        slot[0] = (slot[0] + 1) % m

    return advance
