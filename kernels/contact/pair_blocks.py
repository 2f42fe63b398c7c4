"""The gaps of pairs at the start of a step on the CPU, block by block, in loops that the compiler vectorises."""

from functools import cache

import warp as wp

from ..memory import load, store
from ..vectors import types
from . import self_gaps
from .self_pairs import Pairs, StepPairs, module_of

# Pairs of a block, and the numbers of each: three vectors between its vertices, then w, y and d.
BLOCK, NUMBERS = 128, 17
SIZE = wp.constant(BLOCK)
_number, _put = load(wp.float64), store(wp.float64)


@wp.func
def vector_in(block: wp.array(dtype=wp.float64), row: int, k: int):
    k += row * SIZE
    return wp.vec3d(_number(block, k), _number(block, k + SIZE), _number(block, k + 2 * SIZE))


@wp.func
def put_vector(block: wp.array(dtype=wp.float64), row: int, k: int, v: wp.vec3d):
    k += row * SIZE
    _put(block, k, v[0])
    _put(block, k + SIZE, v[1])
    _put(block, k + 2 * SIZE, v[2])


@cache
def nearest_in_block(of_edges: bool):
    """Device function (block, n): w, y and d of its first n pairs."""
    nearest_points = self_gaps.edge_edge if of_edges else self_gaps.vertex_triangle

    @wp.func
    def find(block: wp.array(dtype=wp.float64), n: int):
        k = wp.int32(0)
        while k < n:
            w, y, _inside = nearest_points(vector_in(block, 0, k), vector_in(block, 3, k), vector_in(block, 6, k))
            _put(block, 9 * SIZE + k, w[0])
            put_vector(block, 10, k, wp.vec3d(w[1], w[2], w[3]))
            d = wp.length(y)
            put_vector(block, 13, k, y / wp.max(d, wp.float64(1e-300)))
            _put(block, 16 * SIZE + k, d)
            k += 1

    return find


@cache
def begin_blocks(dtype):
    """Kernel of one thread: n, d and w of all pairs, as :func:`.self_pairs.begin_pairs`, with ``block`` (NUMBERS·BLOCK,)."""
    vec3, _ = types(dtype)
    stencil, vector = load(wp.vec4i), load(vec3)
    put_normal, put_weights = store(wp.vec3d), store(wp.vec4d)
    of_vertices, of_edges = nearest_in_block(False), nearest_in_block(True)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def begin_each_block(
        # elements
        pairs: Pairs,
        # state in
        x: wp.array(dtype=vec3),
        # in and out
        block: wp.array(dtype=wp.float64),
        # out
        step: StepPairs,
    ):
        vertex_pairs = wp.min(pairs.counts[0], pairs.stencils.shape[0])
        count = wp.min(pairs.counts[0] + pairs.counts[1], pairs.stencils.shape[0])
        first = wp.int32(0)
        while first < count:
            end = wp.min(first + SIZE, wp.where(first < vertex_pairs, vertex_pairs, count))
            e = first
            while e < end:
                s = stencil(pairs.stencils, e)
                a = wp.vec3d(vector(x, s[0]))
                put_vector(block, 0, e - first, wp.vec3d(vector(x, s[1])) - a)
                put_vector(block, 3, e - first, wp.vec3d(vector(x, s[2])) - a)
                put_vector(block, 6, e - first, wp.vec3d(vector(x, s[3])) - a)
                e += 1
            if first < vertex_pairs:
                of_vertices(block, end - first)
            else:
                of_edges(block, end - first)
            e = first
            while e < end:
                k = e - first
                w = vector_in(block, 10, k)
                put_weights(step.weights, e, wp.vec4d(_number(block, 9 * SIZE + k), w[0], w[1], w[2]))
                put_normal(step.normal, e, vector_in(block, 13, k))
                _put(step.gap, e, _number(block, 16 * SIZE + k))
                e += 1
            first = end

    return begin_each_block
