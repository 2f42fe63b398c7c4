"""The transpose of local coordinates, out += Dᵀz: vertex i gets Σₘ wᵢ[m] z[m].

A :class:`LocalSource` computes z, such as kA∂u/∂y or multipliers. One kernel sums over elements, for the CPU, the other over
the elements of each vertex, for a GPU.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import warp as wp

from .memory import add_to, load, store
from .term import Term
from .vectors import types


@cache
def to_corner(term: Term, dtype):
    """Device function (rest, i, z) → Σₘ wᵢ[m] z[m], z (M, 3)."""
    M, weight = wp.constant(term.rows), term.weight
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)

    @wp.func
    def share_of(rest: rest_type, corner: int, z: y_type):
        w = weight(rest, corner)
        total = w[0] * z[0]
        for m in range(1, M):
            total += w[m] * z[m]
        return total

    return share_of


@cache
def to_block(rows: int, dtype):
    """Device function (wᵢ, wⱼ, h) → Σₘₙ wᵢ[m] wⱼ[n] h[m, n], the block (i, j) of DᵀhD."""
    M, weights_type = wp.constant(rows), wp.types.vector(rows, dtype)
    mat33, h_type = types(dtype)[1], wp.types.matrix((3 * rows, 3 * rows), dtype)

    @wp.func
    def block_of(wi: weights_type, wj: weights_type, h: h_type):
        block = mat33()
        for m in range(M):
            for n in range(M):
                w = wi[m] * wj[n]
                for row in range(3):
                    for column in range(3):
                        block[row, column] = block[row, column] + w * h[3 * m + row, 3 * n + column]
        return block

    return block_of


@cache
def add_outer(rows: int, dtype):
    """Device function (wᵢ, wⱼ, h, s, t, values) that adds :func:`to_block` to values[s] and its transpose to values[t], if s, t
    ≥ 0.
    """
    weights_type, h_type, mat33 = wp.types.vector(rows, dtype), wp.types.matrix((3 * rows, 3 * rows), dtype), types(dtype)[1]
    block_of, put, put_transposed = to_block(rows, dtype), add_to(mat33), add_to(mat33, transposed=True)

    @wp.func
    def add_outer_of(wi: weights_type, wj: weights_type, h: h_type, s: int, t: int, values: wp.array(dtype=mat33)):
        if s >= 0:
            block = block_of(wi, wj, h)
            put(values, s, block)
            if t >= 0:
                put_transposed(values, t, block)

    return add_outer_of


class LocalSource(NamedTuple):
    """How z is computed.

    Attributes:
        data: Warp struct of the input arrays.
        z_of: Device function (data, element, rest) → z (M, 3).
        left_out: Device function (data, element) → whether to skip it; or None.
    """

    data: Any
    z_of: Callable
    left_out: Callable | None = None


@cache
def stored(term: Term, dtype):
    """The source of a z that is stored in an array."""
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)

    @wp.struct
    class Stored:
        z: wp.array(dtype=y_type)

    @wp.func
    def stored_z(data: Stored, e: int, rest: rest_type):
        return data.z[e]

    return LocalSource(Stored, stored_z)


@cache
def scatter(term: Term, dtype, source: LocalSource):
    """Kernel over elements: out += Dᵀz. For one thread of the CPU: no addition is atomic."""
    vec3, _ = types(dtype)
    K, rest_type = wp.constant(term.vertices), wp.types.vector(term.parameters, dtype)
    share_of, z_of, left_out = to_corner(term, dtype), source.z_of, source.left_out
    vector, vertex, rest_of, put = load(vec3), load(wp.int32, 2), load(rest_type), store(vec3)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_elements(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        # state in
        data: source.data,
        # in and out
        out: wp.array(dtype=vec3),
    ):
        e = wp.tid()
        if wp.static(left_out is not None):
            if left_out(data, e):
                return
        r = rest_of(rest, e)
        z = z_of(data, e, r)
        for i in range(K):
            v = vertex(stencil, K * e + i)
            put(out, v, vector(out, v) + share_of(r, i, z))

    return scatter_elements


@cache
def gather(term: Term, dtype, source: LocalSource):
    """Kernel over vertices: out += Dᵀz in a fixed order."""
    vec3, _ = types(dtype)
    K, rest_type = wp.constant(term.vertices), wp.types.vector(term.parameters, dtype)
    share_of, z_of, left_out = to_corner(term, dtype), source.z_of, source.left_out

    @wp.kernel(module="unique", enable_backward=False)
    def gather_elements(
        # elements
        offsets: wp.array(dtype=wp.int32),
        codes: wp.array(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        # state in
        data: source.data,
        # in and out
        out: wp.array(dtype=vec3),
    ):
        v = wp.tid()
        total = vec3()
        for n in range(offsets[v], offsets[v + 1]):
            e = codes[n] // K
            if wp.static(left_out is not None):
                if left_out(data, e):
                    return
            total += share_of(rest[e], codes[n] - e * K, z_of(data, e, rest[e]))
        out[v] = out[v] + total

    return gather_elements
