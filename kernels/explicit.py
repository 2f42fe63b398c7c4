"""Factories of the kernels that take an explicit step in one pass over the vertices: the forces of all terms and the update.

:func:`sweep` is for one thread a copy. It handles each element in the block of its lowest vertex. When a block is done no later
element adds to the forces on its vertices or asks where they are, so that x, v move on in place. :func:`gather` is for one
thread a vertex, and writes x to another array than it reads.
"""

from functools import cache

import warp as wp

from .assemble import types
from .blocks import add_blocks
from .elements import Part, chain_of, load, store
from .gather import sum_at_vertices


@cache
def advance(dtype, symplectic: bool):
    """The device function (x, v, a, h) → x, v after a step: kick and drift, or drift and kick at the same state."""
    vec3, _ = types(dtype)

    @wp.func
    def kick_and_drift(x: vec3, v: vec3, a: vec3, h: dtype):
        after = v + h * a
        return x + h * after, after

    @wp.func
    def drift_and_kick(x: vec3, v: vec3, a: vec3, h: dtype):
        return x + h * v, v + h * a

    return kick_and_drift if symplectic else drift_and_kick


@cache
def sweep(parts: tuple[Part, ...], dtype, symplectic: bool, flags: str):
    """Kernel over copies, each block by block: v, x after a step, a = g − ∇U/m.

    ``gradient`` is what other terms have left, and 0 afterwards. ``flags`` are those of the compiler, on the CPU.
    """
    vec3, _ = types(dtype)
    add, step = add_blocks(parts, dtype), advance(dtype, symplectic)
    vector, number, whole, put = load(vec3), load(dtype), load(wp.int32), store(vec3)

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": flags})
    def sweep_blocks(
        chain: chain_of(parts, dtype),
        vertices: wp.array(dtype=wp.int32),
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        h: dtype,
        # scratch
        y: wp.array(dtype=dtype),
        dy: wp.array(dtype=dtype),
        # in and out
        gradient: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
    ):
        copy = wp.tid()
        g = gravity[copy]
        blocks = (vertices.shape[0] - 1) // gravity.shape[0]
        b = copy * blocks
        last = b + blocks
        while b < last:
            add(chain, b, x, v, h, y, dy, gradient)
            i = whole(vertices, b)
            end = whole(vertices, b + 1)
            while i < end:
                w = number(inverse_mass, i)
                before = vector(x, i)
                speed = vector(v, i)
                place, velocity = step(before, speed, g - w * vector(gradient, i), h)
                put(x, i, wp.where(w > dtype(0.0), place, before))
                put(v, i, wp.where(w > dtype(0.0), velocity, speed))
                put(gradient, i, vec3())
                i += 1
            b += 1

    return sweep_blocks


@cache
def gather(parts: tuple[Part, ...], dtype, symplectic: bool, fast: bool, lanes: int = 1):
    """Kernel over vertices, ``lanes`` threads each: x, v after a step, a = g − ∇U/m.

    Where nothing is damped v may be ``v_after``. ``fast`` takes approximate quotients and roots, of the last bit or two; NaN
    stays.
    """
    vec3, _ = types(dtype)
    total_of, step = sum_at_vertices(parts, dtype, lanes=lanes), advance(dtype, symplectic)
    vector, number, put = load(vec3), load(dtype), store(vec3)

    @wp.kernel(module="unique", enable_backward=False, module_options={"fast_math": fast})
    def gather_vertices(
        chain: chain_of(parts, dtype),
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        per_copy: int,
        h: dtype,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        # out
        x_after: wp.array(dtype=vec3),
        v_after: wp.array(dtype=vec3),
    ):
        thread = wp.tid()
        total = total_of(thread, chain, inverse_mass.shape[0], x, v, h)  # of pins too: what follows need not wait for w
        i = thread // lanes
        w = number(inverse_mass, i)
        place = vector(x, i)
        velocity = vector(v, i)
        if w > dtype(0.0):
            place, velocity = step(place, velocity, gravity[i // per_copy] - w * total, h)
        if thread == i * lanes:
            put(x_after, i, place)
            put(v_after, i, velocity)

    return gather_vertices
