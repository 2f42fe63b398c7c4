"""The explicit step by blocks: one thread per copy computes all forces and the update in one pass.

Each element is in the block of its lowest vertex. After a block, its vertices are complete, so x and v are updated in place.
"""

from functools import cache

import warp as wp

from ..explicit_step import kick_and_drift
from ..memory import load, store
from ..vectors import types
from .block_forces import add_block_forces
from .guard import ContactFactories, guard_type
from .term_facts import TermFacts, chain_of


@cache
def block_step(
    parts: tuple[TermFacts, ...],
    dtype,
    symplectic: bool,
    flags: str,
    compensated: bool = False,
    contact: ContactFactories | None = None,
    moving: bool = False,
):
    """Kernel over copies, block by block: v, x after a step with a = g − ∇U/m.

    ``gradient`` is that of other terms, and is reset. ``flags`` are compiler flags of the CPU, ``compensated`` that of
    :func:`..explicit_step.kick_and_drift`, ``contact`` is that with colliders, of which some move if ``moving``.
    """
    vec3, _ = types(dtype)
    add, step = add_block_forces(parts, dtype, compensated), kick_and_drift(dtype, symplectic, compensated)
    vector, number, whole, put = load(vec3), load(dtype), load(wp.int32), store(vec3)
    clear, touch = contact.functions(dtype, symplectic, moving) if contact else (None, None)
    guarded = contact is not None

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": flags})
    def step_blocks(
        # elements
        chain: chain_of(parts, dtype),
        vertices: wp.array(dtype=wp.int32),
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        guard: guard_type(dtype, contact),
        # parameters
        h: dtype,
        # in and out, the first two scratch
        y: wp.array(dtype=dtype),
        dy: wp.array(dtype=dtype),
        gradient: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        residual: wp.array(dtype=vec3),
    ):
        copy = wp.tid()
        g = gravity[copy]
        blocks = (vertices.shape[0] - 1) // gravity.shape[0]
        b = copy * blocks
        now = wp.int32(0)
        if wp.static(guarded):
            now = guard.steps[copy]
        last = b + blocks
        while b < last:
            if wp.static(compensated):
                add(chain, b, x, residual, dtype(1.0), y, dy, gradient)
            else:
                add(chain, b, x, v, h, y, dy, gradient)
            i = whole(vertices, b)
            end = whole(vertices, b + 1)
            if wp.static(guarded):
                near = wp.int32(0)
                j = i
                while j < end:  # to be vectorised
                    w = number(inverse_mass, j)
                    before = vector(x, j)
                    position, more, velocity = step(before, vec3(), vector(v, j), g - w * vector(gradient, j), h)
                    near += 1 - clear(guard, j, now, before, position)
                    j += 1
                while near > 0 and i < end:
                    w = number(inverse_mass, i)
                    if w > dtype(0.0):
                        before = vector(x, i)
                        speed = vector(v, i)
                        a = g - w * vector(gradient, i)
                        position, more, velocity = step(before, vec3(), speed, a, h)
                        if clear(guard, i, now, before, position) == 0:
                            position, velocity = touch(guard, i, w, before, speed, a, h)
                        put(x, i, position)
                        put(v, i, velocity)
                    put(gradient, i, vec3())
                    i += 1
            while i < end:
                w = number(inverse_mass, i)
                before = vector(x, i)
                speed = vector(v, i)
                rest = vec3()
                if wp.static(compensated):
                    rest = vector(residual, i)
                position, more, velocity = step(before, rest, speed, g - w * vector(gradient, i), h)
                put(x, i, wp.where(w > dtype(0.0), position, before))
                put(v, i, wp.where(w > dtype(0.0), velocity, speed))
                if wp.static(compensated):
                    put(residual, i, wp.where(w > dtype(0.0), more, rest))
                put(gradient, i, vec3())
                i += 1
            b += 1
        if wp.static(guarded and not moving):
            guard.steps[copy] = now + 1

    return step_blocks
