"""Factories of the kernels that take an explicit step in one pass over the vertices: the forces of all terms and the update.

:func:`sweep` is for one thread a copy. It handles each element in the block of its lowest vertex. When a block is done no later
element adds to the forces on its vertices or asks where they are, so that x, v move on in place. :func:`gather` is for one
thread a vertex, and writes x to another array than it reads.
"""

from functools import cache

import warp as wp

from ..memory import load, store
from ..vectors import types
from .block_forces import add_blocks
from .gather_forces import move_of, sum_at_vertices
from .packed_residual import pack
from .parts import Part, chain_of


@cache
def advance(dtype, symplectic: bool, fine: bool = False):
    """The device function (x, low, v, a, h) → x, low, v after a step: kick and drift, or drift and kick at the same state.

    ``fine`` keeps in ``low`` what x is rounded by (Dekker 1971, *A floating-point technique for extending the available
    precision*): the place is x + low.
    """
    vec3, _ = types(dtype)

    @wp.func
    def advance_vertex(x: vec3, low: vec3, v: vec3, a: vec3, h: dtype):
        after = v + h * a
        if wp.static(symplectic):
            move = h * after
        else:
            move = h * v
        if wp.static(fine):
            move += low
        place = x + move
        if wp.static(fine):
            low = move - (place - x)
        return place, low, after

    return advance_vertex


@cache
def sweep(parts: tuple[Part, ...], dtype, symplectic: bool, flags: str, fine: bool = False):
    """Kernel over copies, each block by block: v, x after a step, a = g − ∇U/m.

    ``gradient`` is what other terms have left, and 0 afterwards. ``flags`` are those of the compiler, on the CPU; ``fine`` as
    in :func:`advance`, of what is not damped.
    """
    vec3, _ = types(dtype)
    add, step = add_blocks(parts, dtype, fine), advance(dtype, symplectic, fine)
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
        low: wp.array(dtype=vec3),
    ):
        copy = wp.tid()
        g = gravity[copy]
        blocks = (vertices.shape[0] - 1) // gravity.shape[0]
        b = copy * blocks
        last = b + blocks
        while b < last:
            if wp.static(fine):
                add(chain, b, x, low, dtype(1.0), y, dy, gradient)
            else:
                add(chain, b, x, v, h, y, dy, gradient)
            i = whole(vertices, b)
            end = whole(vertices, b + 1)
            while i < end:
                w = number(inverse_mass, i)
                before = vector(x, i)
                speed = vector(v, i)
                rest = vec3()
                if wp.static(fine):
                    rest = vector(low, i)
                place, more, velocity = step(before, rest, speed, g - w * vector(gradient, i), h)
                put(x, i, wp.where(w > dtype(0.0), place, before))
                put(v, i, wp.where(w > dtype(0.0), velocity, speed))
                if wp.static(fine):
                    put(low, i, wp.where(w > dtype(0.0), more, rest))
                put(gradient, i, vec3())
                i += 1
            b += 1

    return sweep_blocks


@cache
def gather_vertex(parts: tuple[Part, ...], dtype, symplectic: bool, lanes: int = 1, kept=None):
    """The device function by which ``lanes`` threads set x, v of a vertex after a step, a = g − ∇U/m, in other arrays.

    ``kept`` is the type of what x is rounded by, see :func:`gather`.
    """
    vec3, _ = types(dtype)
    fine, packed, low_type = kept is not None, kept is wp.int32, kept or vec3
    total_of, step = sum_at_vertices(parts, dtype, kept, lanes), advance(dtype, symplectic, fine)
    vector, number, put = load(vec3), load(dtype), store(vec3)
    rest_of, put_rest = move_of(dtype, low_type), store(low_type)

    @wp.func
    def gather_one(
        thread: int,
        chain: chain_of(parts, dtype),
        inverse_mass: wp.array(dtype=dtype),
        g: vec3,
        h: dtype,
        unit: dtype,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        low: wp.array(dtype=low_type),
        x_after: wp.array(dtype=vec3),
        v_after: wp.array(dtype=vec3),
        low_after: wp.array(dtype=low_type),
    ):
        # Of pins too: what follows need not wait for w.
        total = vec3()
        if wp.static(fine):
            total = total_of(thread, chain, inverse_mass.shape[0], x, low, unit)
        else:
            total = total_of(thread, chain, inverse_mass.shape[0], x, v, h)
        i = thread // lanes
        w = number(inverse_mass, i)
        place = vector(x, i)
        velocity = vector(v, i)
        rest = vec3()
        if wp.static(fine):
            rest = rest_of(low, i, unit)
        if w > dtype(0.0):
            place, rest, velocity = step(place, rest, velocity, g - w * total, h)
        if thread == i * lanes:
            put(x_after, i, place)
            put(v_after, i, velocity)
            if wp.static(packed):
                put_rest(low_after, i, pack(rest, unit))
            elif wp.static(fine):
                put_rest(low_after, i, rest)

    return gather_one


@cache
def gather(parts: tuple[Part, ...], dtype, symplectic: bool, fast: bool, alone: bool, lanes: int = 1, kept=None):
    """Kernel over vertices, ``lanes`` threads each: x, v after a step.

    Where nothing is damped v may be ``v_after``. ``fast`` takes approximate quotients and roots, of the last bit or two; NaN
    stays. ``alone`` is for one copy. ``kept`` is None, or of what is not damped, in float32, the type of what x is rounded by,
    as in :func:`advance`: vectors, with a ``unit`` of 1, or int32 as :mod:`.places` packs them in units of ``unit``.
    """
    vec3, _ = types(dtype)
    low_type = kept or vec3
    gather_one = gather_vertex(parts, dtype, symplectic, lanes, kept)
    # Rows of bending one after another in a loop take 1.3 times as long where places are fine, else as long (H200, 512²).
    options = {"fast_math": fast, "max_unroll": 32 if kept else 16}

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=options)
    def gather_vertices(
        chain: chain_of(parts, dtype),
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        per_copy: int,
        h: dtype,
        unit: dtype,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        low: wp.array(dtype=low_type),
        # out
        x_after: wp.array(dtype=vec3),
        v_after: wp.array(dtype=vec3),
        low_after: wp.array(dtype=low_type),
    ):
        thread = wp.tid()
        copy = 0
        if wp.static(not alone):
            copy = thread // (lanes * per_copy)  # a tenth of the instructions of a step of springs
        gather_one(thread, chain, inverse_mass, gravity[copy], h, unit, x, v, low, x_after, v_after, low_after)

    return gather_vertices


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncthreads();
#endif
""")
def wait_for_block(): ...


@cache
def gather_copies(parts: tuple[Part, ...], dtype, symplectic: bool, fast: bool, threads: int):
    """Kernel over (copies, threads): x, v after several steps. A copy is a block of ``threads``, which wait for one another.

    x_other and v_other are where every other step ends; where nothing is damped v may be v_other.
    """
    vec3, _ = types(dtype)
    gather_one, vector, put = gather_vertex(parts, dtype, symplectic), load(vec3), store(vec3)
    threads = wp.constant(threads)

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=threads, module_options={"fast_math": fast})
    def gather_each_copy(
        chain: chain_of(parts, dtype),
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        per_copy: int,
        h: dtype,
        steps: int,
        # in and out
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        # between
        x_other: wp.array(dtype=vec3),
        v_other: wp.array(dtype=vec3),
    ):
        copy, thread = wp.tid()
        g = gravity[copy]
        first = copy * per_copy + thread
        end = (copy + 1) * per_copy
        left = steps
        while left > 0:
            i = first
            while i < end:
                gather_one(i, chain, inverse_mass, g, h, h, x, v, x, x_other, v_other, x)
                i += threads
            wait_for_block()
            i = first
            while i < end:
                if left > 1:
                    gather_one(i, chain, inverse_mass, g, h, h, x_other, v_other, x, x, v, x)
                else:  # the last of an odd number
                    put(x, i, vector(x_other, i))
                    put(v, i, vector(v_other, i))
                i += threads
            wait_for_block()
            left -= 2

    return gather_each_copy
