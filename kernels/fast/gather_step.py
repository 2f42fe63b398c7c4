"""The explicit step that gathers: each vertex sums over its elements, from two arrays into two others."""

from functools import cache

import warp as wp

from ..explicit_step import kick_and_drift
from ..memory import load, store
from ..reduce import wait_for_block
from ..vectors import types
from .gather_forces import move_of, sum_at_vertices
from .guard import ContactFactories, guard_type
from .packed_residual import pack_residual
from .term_facts import TermFacts, chain_of


@cache
def gather_vertex(
    parts: tuple[TermFacts, ...], dtype, symplectic: bool, lanes: int = 1, residual_type=None, contact=None, moving=False
):
    """Device function with which ``lanes`` threads set x, v of a vertex after a step, with a = g − ∇U/m."""
    vec3, _ = types(dtype)
    compensated, packed, stored = residual_type is not None, residual_type is wp.int32, residual_type or vec3
    total_of = sum_at_vertices(parts, dtype, residual_type, lanes)
    step = kick_and_drift(dtype, symplectic, compensated)
    vector, number, put = load(vec3), load(dtype), store(vec3)
    residual_of, put_residual = move_of(dtype, stored), store(stored)
    clear, touch = contact.functions(dtype, symplectic, moving) if contact else (None, None)
    guarded = contact is not None

    @wp.func
    def gather_one(
        thread: int,
        chain: chain_of(parts, dtype),
        inverse_mass: wp.array(dtype=dtype),
        g: vec3,
        guard: guard_type(dtype, contact),
        h: dtype,
        unit: dtype,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        residual: wp.array(dtype=stored),
        x_after: wp.array(dtype=vec3),
        v_after: wp.array(dtype=vec3),
        residual_after: wp.array(dtype=stored),
    ):
        # For pins too, so that the sum does not wait for w.
        total = vec3()
        if wp.static(compensated):
            total = total_of(thread, chain, inverse_mass.shape[0], x, residual, unit)
        else:
            total = total_of(thread, chain, inverse_mass.shape[0], x, v, h)
        i = thread // lanes
        w = number(inverse_mass, i)
        position = vector(x, i)
        velocity = vector(v, i)
        rest = vec3()
        if wp.static(compensated):
            rest = residual_of(residual, i, unit)
        if w > dtype(0.0):
            a = g - w * total
            if wp.static(guarded):
                before = position
                speed = velocity
                now = wp.int32(0)
                if wp.static(moving):
                    now = guard.steps[i // guard.per_copy]
                position, rest, velocity = step(before, rest, speed, a, h)
                if thread == i * lanes and clear(guard, i, now, before, position) == 0:
                    position, velocity = touch(guard, i, w, before, speed, a, h)
            else:
                position, rest, velocity = step(position, rest, velocity, a, h)
        if thread == i * lanes:
            put(x_after, i, position)
            put(v_after, i, velocity)
            if wp.static(packed):
                put_residual(residual_after, i, pack_residual(rest, unit))
            elif wp.static(compensated):
                put_residual(residual_after, i, rest)
            if wp.static(guarded and not moving):
                if i % guard.per_copy == 0:
                    guard.steps[i // guard.per_copy] += 1

    return gather_one


@cache
def gather_step(
    parts: tuple[TermFacts, ...],
    dtype,
    symplectic: bool,
    fast: bool,
    alone: bool,
    lanes: int = 1,
    residual_type=None,
    contact: ContactFactories | None = None,
    moving: bool = False,
):
    """Kernel over vertices, ``lanes`` threads each: x, v after a step.

    ``fast`` allows errors of two bits in quotients and roots. ``residual_type`` is None, or, in float32 without damping, that
    of the residual of :func:`..explicit_step.kick_and_drift`: vectors, with a ``unit`` of 1, or int32 of
    :mod:`.packed_residual` in units of ``unit``. ``contact`` is that with colliders, of which some move if ``moving``.
    """
    vec3, _ = types(dtype)
    stored = residual_type or vec3
    gather_one = gather_vertex(parts, dtype, symplectic, lanes, residual_type, contact, moving)
    # A loop over the rows of bending that is not unrolled takes 1.3 times as long with compensation, else the same (H200,
    # 512²).
    options = {"fast_math": fast, "max_unroll": 32 if residual_type else 16}

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=options)
    def step_vertices(
        # elements
        chain: chain_of(parts, dtype),
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        guard: guard_type(dtype, contact),
        # state in
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        residual: wp.array(dtype=stored),
        # parameters
        h: dtype,
        unit: dtype,
        # out
        x_after: wp.array(dtype=vec3),
        v_after: wp.array(dtype=vec3),
        residual_after: wp.array(dtype=stored),
    ):
        thread = wp.tid()
        copy = 0
        if wp.static(not alone):
            copy = thread // (lanes * guard.per_copy)  # takes a tenth of the instructions of a step of springs
        gather_one(thread, chain, inverse_mass, gravity[copy], guard, h, unit, x, v, residual, x_after, v_after, residual_after)

    return step_vertices


@cache
def gather_steps_of_copies(
    parts: tuple[TermFacts, ...], dtype, symplectic: bool, fast: bool, threads: int, contact: ContactFactories | None = None
):
    """Kernel over (copies, threads): x, v after several steps, a block of ``threads`` per copy.

    Every other step writes x_other and v_other.
    """
    vec3, _ = types(dtype)
    gather_one = gather_vertex(parts, dtype, symplectic, contact=contact)
    vector, put = load(vec3), store(vec3)
    threads = wp.constant(threads)

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=threads, module_options={"fast_math": fast})
    def step_copies(
        # elements
        chain: chain_of(parts, dtype),
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        guard: guard_type(dtype, contact),
        # parameters
        h: dtype,
        steps: int,
        # in and out, the last two scratch
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        x_other: wp.array(dtype=vec3),
        v_other: wp.array(dtype=vec3),
    ):
        copy, thread = wp.tid()
        g = gravity[copy]
        first = copy * guard.per_copy + thread
        end = (copy + 1) * guard.per_copy
        left = steps
        while left > 0:
            i = first
            while i < end:
                gather_one(i, chain, inverse_mass, g, guard, h, h, x, v, x, x_other, v_other, x)
                i += threads
            wait_for_block()
            i = first
            while i < end:
                if left > 1:
                    gather_one(i, chain, inverse_mass, g, guard, h, h, x_other, v_other, x, x, v, x)
                else:  # the last step of an odd number
                    put(x, i, vector(x_other, i))
                    put(v, i, vector(v_other, i))
                i += threads
            wait_for_block()
            left -= 2

    return step_copies
