"""Products of a matrix of 3×3 blocks with vectors: block compressed rows, and pairs outside them.

On CUDA LANES threads share a row.
"""

from functools import cache

import warp as wp

from .memory import add_to, load
from .pairs import Pairs, pair_blocks, turned_pull
from .vectors import types

LANES = 4


def lanes_of_rows(block: int):
    """The number of threads that share a row: 1 for blocks of one thread and for the CPU, with 0."""
    return LANES if block > 1 else 1


@cache
def block_rows(dtype):
    """Struct of a matrix: its rows, and the pairs of up to two energies, whose diagonal blocks the rows have; ``mobility`` is
    None without locks.
    """
    vec3, mat33 = types(dtype)

    @wp.struct
    class BlockRows:
        offsets: wp.array(dtype=wp.int32)
        columns: wp.array(dtype=wp.int32)
        diagonal: wp.array(dtype=wp.int32)
        values: wp.array(dtype=mat33)
        mobility: wp.array(dtype=vec3)
        pairs: Pairs
        blocks: pair_blocks(dtype)
        other_pairs: Pairs
        other_blocks: pair_blocks(dtype)

    return BlockRows


@cache
def operand_at(dtype, turned: bool):
    """Device function (x, p, ratio, j) → xⱼ, or if ``turned`` xⱼ + ratio·pⱼ."""
    vec3, _ = types(dtype)
    vector = load(vec3)

    @wp.func
    def at(x: wp.array(dtype=vec3), p: wp.array(dtype=vec3), ratio: dtype, j: int):
        if wp.static(turned):
            return vector(x, j) + ratio * vector(p, j)
        else:
            return vector(x, j)

    return at


@cache
def product_of_pairs(dtype, lanes: int, turned: bool):
    """Device function (pairs, blocks, i, lane, x, p, ratio) → Σ ∂²U/∂xᵢ∂xⱼ vⱼ over every ``lanes``-th pair of vertex i."""
    vec3, _ = types(dtype)
    vec2 = wp.types.vector(2, dtype)
    vector, whole, stencil = operand_at(dtype, turned), load(wp.int32), load(wp.vec4i)

    @wp.func
    def product(
        pairs: Pairs,
        blocks: pair_blocks(dtype),
        i: int,
        lane: int,
        x: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
        ratio: dtype,
    ):
        total = vec3()
        for k in range(whole(pairs.first, i) + lane, whole(pairs.first, i + 1), wp.static(lanes)):
            code = whole(pairs.corners, k)
            e = code // 4
            s = stencil(pairs.stencils, e)
            own = code - 4 * e
            w = blocks.weights[e]
            y = vec3()
            z = vec2()
            for j in range(4):
                if j != own:
                    v = vector(x, p, ratio, s[j])
                    y += w[j] * v
                    if blocks.turns:
                        z += wp.dot(blocks.normal[e], v) * blocks.turns[e][j]
            total += w[own] * (blocks.blocks[e] * y)
            if blocks.turns:
                total += turned_pull(w[own], blocks.turns[e][own], blocks.ways[e], blocks.normal[e], blocks.twisted[e], y, z)
        return total

    return product


@cache
def product_of_row(dtype, lanes: int, terms: int = 0, turned: bool = False):
    """Device function (matrix, i, lane, x, p, ratio) → a lane's part of row i of A v, v as in :func:`operand_at`, with
    ``terms`` ≤ 2 energies of pairs.
    """
    vec3, mat33 = types(dtype)
    column, block = load(wp.int32), load(mat33)
    vector, of_pairs = operand_at(dtype, turned), product_of_pairs(dtype, lanes, turned)

    @wp.func
    def product(
        matrix: block_rows(dtype),
        i: int,
        lane: int,
        x: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
        ratio: dtype,
    ):
        total = vec3()
        for s in range(matrix.offsets[i] + lane, matrix.offsets[i + 1], wp.static(lanes)):
            total += block(matrix.values, s) * vector(x, p, ratio, column(matrix.columns, s))
        if wp.static(terms > 0):
            pull = of_pairs(matrix.pairs, matrix.blocks, i, lane, x, p, ratio)
            if wp.static(terms > 1):
                pull += of_pairs(matrix.other_pairs, matrix.other_blocks, i, lane, x, p, ratio)
            if matrix.mobility:
                for axis in range(3):
                    if matrix.mobility[i][axis] == dtype(0.0):
                        pull[axis] = dtype(0.0)
            total += pull
        return total

    return product


@cache
def symmetric_product(dtype):
    """Device function (matrix, first, end, p, q) of one thread: q = A p in the rows of a copy.

    It reads only the diagonal and what is right of it.
    """
    vec3, mat33 = types(dtype)
    column, block, vector, add = load(wp.int32), load(mat33), load(vec3), add_to(vec3)

    @wp.func
    def multiply(matrix: block_rows(dtype), first: int, end: int, p: wp.array(dtype=vec3), q: wp.array(dtype=vec3)):
        for i in range(first, end):
            q[i] = vec3()
        for i in range(first, end):
            v = vector(p, i)
            s = column(matrix.diagonal, i)
            total = block(matrix.values, s) * v
            s += 1
            last = column(matrix.offsets, i + 1)
            while s < last:
                A = block(matrix.values, s)
                j = column(matrix.columns, s)
                total += A * vector(p, j)
                add(q, j, wp.transpose(A) * v)
                s += 1
            add(q, i, total)

    return multiply
