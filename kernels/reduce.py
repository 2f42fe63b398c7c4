"""Sums and maxima per copy, in float64 and in a fixed order.

A launch over (copies, lanes) stores parts by block; the next adds them up.
"""

from functools import cache

import warp as wp

from .vectors import types


@wp.func
def stands_aside(active: wp.array(dtype=wp.int32), copy: int):
    """Whether active[copy] is 0; False if ``active`` (B,) is None."""
    if active:
        return active[copy] == 0
    return False


@wp.func
def larger(most: wp.float64, value: wp.float64):
    """The larger of two numbers; NaN if either is NaN."""
    return wp.where(most == most and not (value <= most), value, most)


@cache
def block_sums(block: int):
    """Device functions (lane, value, parts, copy), which stores a block's part, and (lane, parts, copy) → Σ."""
    threads = max(block, 1)

    @wp.func
    def over_block(value: wp.float64):
        return wp.tile_sum(wp.tile(value))[0]

    @wp.func
    def store(lane: int, value: wp.float64, parts: wp.array2d(dtype=wp.float64), copy: int):
        if wp.static(block > 0):
            total = over_block(value)
            if lane % wp.static(threads) == 0:
                parts[copy, lane // wp.static(threads)] = total
        else:
            parts[copy, 0] = value

    @wp.func
    def add_up(lane: int, parts: wp.array2d(dtype=wp.float64), copy: int):
        total = wp.float64(0.0)
        if wp.static(block > 0):
            own = wp.float64(0.0)
            for k in range(lane % wp.static(threads), parts.shape[1], wp.static(threads)):
                own += parts[copy, k]
            total = over_block(own)
        else:
            total = parts[copy, 0]
        return total

    return store, add_up


@cache
def block_largest(block: int):
    """:func:`block_sums` for the largest of numbers ≥ 0; NaN if one is NaN."""
    threads = max(block, 1)

    @wp.func
    def over_block(value: wp.float64):
        return wp.tile_reduce(larger, wp.tile(value))[0]

    @wp.func
    def store(lane: int, value: wp.float64, parts: wp.array2d(dtype=wp.float64), copy: int):
        if wp.static(block > 0):
            most = over_block(value)
            if lane % wp.static(threads) == 0:
                parts[copy, lane // wp.static(threads)] = most
        else:
            parts[copy, 0] = value

    @wp.func
    def find(lane: int, parts: wp.array2d(dtype=wp.float64), copy: int):
        most = wp.float64(0.0)
        if wp.static(block > 0):
            own = wp.float64(0.0)
            for k in range(lane % wp.static(threads), parts.shape[1], wp.static(threads)):
                own = larger(own, parts[copy, k])
            most = over_block(own)
        else:
            most = parts[copy, 0]
        return most

    return store, find


@cache
def sum_of_lanes(dtype, lanes: int):
    """Device function (value) → sum over the ``lanes`` neighbouring threads of a vertex or row."""
    vec3, _ = types(dtype)
    if lanes == 1:

        @wp.func
        def itself(value: vec3):
            return value

        return itself
    shuffle = "value.c[{0}] += __shfl_xor_sync(mask, value.c[{0}], n);"

    # A module with such kernels is also built for the CPU, in processes that use both devices.
    @wp.func_native(
        "\n#if defined(__CUDA_ARCH__)\n"
        f"const unsigned mask = {(1 << lanes) - 1}u << (threadIdx.x & 31 & ~{lanes - 1}); "
        f"for (int n = 1; n < {lanes}; n *= 2) {{ {' '.join(shuffle.format(c) for c in range(3))} }}"
        "\n#endif\nreturn value;"
    )
    def sum_over_lanes(value: vec3) -> vec3: ...

    return sum_over_lanes


@cache
def largest_of_warp(dtype):
    """Device function (value, key) → the value; if a warp has one key, their largest by components in its first thread, 0 in
    others.

    All threads must call it.
    """
    vec3, _ = types(dtype)

    @wp.func_native(
        "\n#if defined(__CUDA_ARCH__)\n"
        "const unsigned all = 0xffffffffu; "
        "if (__activemask() == all && __all_sync(all, key == __shfl_sync(all, key, 0))) { for (int c = 0; c < 3; ++c) { "
        "for (int n = 16; n > 0; n /= 2) { "
        "auto other = __shfl_xor_sync(all, value.c[c], n); if (other > value.c[c]) value.c[c] = other; } "
        "if (threadIdx.x & 31) value.c[c] = 0; } }"
        "\n#endif\nreturn value;"
    )
    def largest_in_warp(value: vec3, key: int) -> vec3: ...

    return largest_in_warp


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncthreads();
#endif
""")
def wait_for_block(): ...


@cache
def partial_sum(block: int):
    """Kernel over (copies, lanes): parts of Σ values."""
    store, _add_up = block_sums(block)

    @wp.kernel(module="warpcloth.reduce", enable_backward=False)
    def sum_parts(
        # state in
        values: wp.array(dtype=wp.float64),
        # parameters
        per_copy: int,
        lanes: int,
        # out
        parts: wp.array2d(dtype=wp.float64),
    ):
        copy, lane = wp.tid()
        total = wp.float64(0.0)
        for i in range(lane, per_copy, lanes):
            total += values[copy * per_copy + i]
        store(lane, total, parts, copy)

    return sum_parts


@cache
def partial_dot(dtype, numbers: bool, block: int):
    """Kernel over (copies, lanes): parts of Σ a·b of vectors or ``numbers`` in active copies."""
    value = dtype if numbers else types(dtype)[0]
    store, _add_up = block_sums(block)

    @wp.kernel(module="unique", enable_backward=False)
    def dot_parts(
        # state in
        a: wp.array(dtype=value),
        b: wp.array(dtype=value),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        lanes: int,
        # out
        parts: wp.array2d(dtype=wp.float64),
    ):
        copy, lane = wp.tid()
        total = wp.float64(0.0)
        if not stands_aside(active, copy):
            for j in range(lane, per_copy, lanes):
                i = copy * per_copy + j
                if wp.static(numbers):
                    total += wp.float64(a[i]) * wp.float64(b[i])
                else:
                    total += wp.float64(wp.dot(a[i], b[i]))
        store(lane, total, parts, copy)

    return dot_parts


@cache
def finish_sum(block: int):
    """Kernel over (copies, lanes of one block): out[copy] = the sum of parts, or += if ``accumulate`` is 1."""
    _store, add_up = block_sums(block)

    @wp.kernel(module="warpcloth.reduce", enable_backward=False)
    def add_parts(
        # state in
        parts: wp.array2d(dtype=wp.float64),
        # parameters
        accumulate: int,
        # in and out
        out: wp.array(dtype=wp.float64),
    ):
        copy, lane = wp.tid()
        total = add_up(lane, parts, copy)
        if lane == 0:
            if accumulate == 1:  # not by a factor, for 0·NaN is NaN
                total = out[copy] + total
            out[copy] = total

    return add_parts


@cache
def partial_largest(dtype, block: int):
    """Kernel over (copies, lanes): parts of max wᵢ‖aᵢ‖ over vertices, or NaN."""
    vec3, _ = types(dtype)
    store, _find = block_largest(block)

    @wp.kernel(module="unique", enable_backward=False)
    def largest_parts(
        # elements
        weights: wp.array(dtype=dtype),
        # state in
        a: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        lanes: int,
        # out
        parts: wp.array2d(dtype=wp.float64),
    ):
        copy, lane = wp.tid()
        most = wp.float64(0.0)
        for j in range(lane, per_copy, lanes):
            i = copy * per_copy + j
            most = larger(most, wp.float64(weights[i]) * wp.float64(wp.length(a[i])))
        store(lane, most, parts, copy)

    return largest_parts


@cache
def partial_largest_number(block: int):
    """Kernel over (copies, lanes): parts of the maximum of numbers ≥ 0, or NaN."""
    store, _find = block_largest(block)

    @wp.kernel(module="unique", enable_backward=False)
    def largest_number_parts(
        # state in
        values: wp.array(dtype=wp.float64),
        # parameters
        per_copy: int,
        lanes: int,
        # out
        parts: wp.array2d(dtype=wp.float64),
    ):
        copy, lane = wp.tid()
        most = wp.float64(0.0)
        for i in range(lane, per_copy, lanes):
            most = larger(most, values[copy * per_copy + i])
        store(lane, most, parts, copy)

    return largest_number_parts


@cache
def finish_largest(block: int):
    """Kernel over (copies, lanes of one block): out[copy] = the largest part, or NaN."""
    _store, find = block_largest(block)

    @wp.kernel(module="warpcloth.reduce", enable_backward=False)
    def largest_part(
        # state in
        parts: wp.array2d(dtype=wp.float64),
        # out
        out: wp.array(dtype=wp.float64),
    ):
        copy, lane = wp.tid()
        most = find(lane, parts, copy)
        if lane == 0:
            out[copy] = most

    return largest_part


@cache
def keep_largest():
    """Kernel over copies: out[copy] = max(out[copy], value[copy]) of numbers ≥ 0, or NaN."""

    @wp.kernel(module="warpcloth.reduce", enable_backward=False)
    def keep(
        # state in
        values: wp.array(dtype=wp.float64),
        # in and out
        out: wp.array(dtype=wp.float64),
    ):
        copy = wp.tid()
        out[copy] = larger(out[copy], values[copy])

    return keep
