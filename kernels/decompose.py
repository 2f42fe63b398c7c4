"""Kernels that apply a function of :mod:`.rotation` to every matrix of an array.

On CUDA, blocks load and store matrices through shared memory.
"""

from functools import cache

import warp as wp

BLOCK = 32  # threads of a CUDA block; 64 and 96 are 3 and 10 % slower


@cache
def access(dtype, block):
    """Device functions load(array, i) and store(array, i, value); all threads of a block must call them.

    The number of threads must be a multiple of ``block``.
    """

    @wp.func
    def load(array: wp.array(dtype=dtype), i: int):
        return array[i]

    @wp.func
    def store(array: wp.array(dtype=dtype), i: int, value: dtype):
        array[i] = value

    @wp.func
    def load_block(array: wp.array(dtype=dtype), i: int):
        return wp.untile(wp.tile_load(array, shape=block, offset=i // block * block, storage="shared"))

    @wp.func
    def store_block(array: wp.array(dtype=dtype), i: int, value: dtype):
        tile = wp.tile_empty(shape=block, dtype=dtype, storage="shared")
        wp.tile_assign(tile, wp.tile(value, preserve_type=True))
        wp.tile_store(array, tile, offset=i // block * block)

    return (load_block, store_block) if block > 1 else (load, store)


@cache
def into_three(function, matrix, types, block):
    """Kernel over matrices: (a[i], b[i], c[i]) = function(A[i]).

    Args:
        function: The device function.
        matrix: Warp type of A.
        types: Warp types of a, b and c.
        block: 1 on the CPU, :data:`BLOCK` on CUDA.
    """
    a_type, b_type, c_type = types
    load, _ = access(matrix, block)
    (_, store_a), (_, store_b), (_, store_c) = (access(dtype, block) for dtype in types)

    @wp.kernel(module="unique", enable_backward=False)
    def decompose(
        # state in
        A: wp.array(dtype=matrix),
        # out
        a: wp.array(dtype=a_type),
        b: wp.array(dtype=b_type),
        c: wp.array(dtype=c_type),
    ):
        i = wp.tid()
        first, second, third = function(load(A, i))
        store_a(a, i, first)
        store_b(b, i, second)
        store_c(c, i, third)

    return decompose


@cache
def into_two(function, matrix, types, block):
    """Kernel over matrices: (a[i], b[i]) = function(A[i]), as :func:`into_three`."""
    a_type, b_type = types
    load, _ = access(matrix, block)
    (_, store_a), (_, store_b) = (access(dtype, block) for dtype in types)

    @wp.kernel(module="unique", enable_backward=False)
    def decompose(
        # state in
        A: wp.array(dtype=matrix),
        # out
        a: wp.array(dtype=a_type),
        b: wp.array(dtype=b_type),
    ):
        i = wp.tid()
        first, second = function(load(A, i))
        store_a(a, i, first)
        store_b(b, i, second)

    return decompose


def launch(factory, function, A, out):
    """Launches a factory's kernel over the matrices A (n,), into the arrays ``out`` (n,)."""
    block = BLOCK if A.device.is_cuda else 1
    kernel = factory(function, A.dtype, tuple(array.dtype for array in out), block)
    threads = -(-len(A) // block) * block
    wp.launch(kernel, threads, inputs=[A], outputs=out, device=A.device, block_dim=block)
