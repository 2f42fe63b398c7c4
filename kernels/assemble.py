"""Kernels that assemble any term: energy, gradient and Hessian blocks."""

from functools import cache
from typing import Any

import warp as wp

from .local import local_coordinate
from .memory import load, load_shared, prefetch
from .reduce import block_sums
from .term import Term
from .transpose import LocalSource, add_outer, gather, scatter, to_block
from .vectors import types

AHEAD = wp.constant(4)  # elements for whose blocks memory is asked ahead


@wp.func
def is_clear(radius: Any, d: Any):
    """Whether ‖d‖ is below the radius; False for NaN and infinity."""
    return radius > type(radius)(0.0) and wp.dot(d, d) < radius * radius


@cache
def of_element(term: Term, dtype, corrected: bool):
    """Device functions (stencil, stiffness, e, rest, x, d) → kₑ Aₑ u(yₑ) [J] in float64, and kₑ Aₑ ∂u/∂y.

    A third, with the factor of the negative part, gives kₑ Aₑ ∂²u/∂y².

    If ``corrected``, energy and gradient are computed in float64, also from float32.
    """
    vec3, _ = types(dtype)
    indices, numbers, vectors = wp.array2d(dtype=wp.int32), wp.array(dtype=dtype), wp.array(dtype=vec3)
    rest_type = wp.types.vector(term.parameters, dtype)
    precision = wp.float64 if corrected else dtype
    wide, y_type = wp.types.vector(term.parameters, precision), wp.types.matrix((term.rows, 3), dtype)
    exact_y_of = local_coordinate(term, dtype, corrected, precision)
    y_of, number, measure = local_coordinate(term, dtype, corrected), load_shared(dtype), term.measure
    u, gradient, hessian = term.energy, term.gradient, term.hessian

    @wp.func
    def energy_of(stencil: indices, stiffness: numbers, e: int, r: rest_type, x: vectors, d: vectors):
        rest = wide(r)
        return wp.float64(precision(number(stiffness, e)) * measure(rest) * u(exact_y_of(stencil, e, rest, x, d), rest))

    @wp.func
    def gradient_of(stencil: indices, stiffness: numbers, e: int, r: rest_type, x: vectors, d: vectors):
        rest = wide(r)
        g = (precision(number(stiffness, e)) * measure(rest)) * gradient(exact_y_of(stencil, e, rest, x, d), rest)
        return y_type(g)

    @wp.func
    def hessian_of(stencil: indices, stiffness: numbers, e: int, r: rest_type, x: vectors, d: vectors, negative: dtype):
        return (number(stiffness, e) * measure(r)) * hessian(y_of(stencil, e, r, x, d), r, negative)

    return energy_of, gradient_of, hessian_of


@cache
def energy(term: Term, dtype, corrected: bool = False, clearing: bool = False):
    """Kernel over elements: out[e] = kₑ Aₑ u(yₑ) [J], in float64; 0, if ``clearing``, where d of a vertex is below its
    ``clear``.
    """
    vec3, _ = types(dtype)
    rest_type = wp.types.vector(term.parameters, dtype)
    (energy_of, _gradient, _hessian), rest_of = of_element(term, dtype, corrected), load(rest_type)

    @wp.kernel(module="unique", enable_backward=False)
    def energy_of_elements(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        clear: wp.array(dtype=dtype),
        # out
        out: wp.array(dtype=wp.float64),
    ):
        e = wp.tid()
        if wp.static(clearing):
            if is_clear(clear[e], d[stencil[e, 0]]):
                out[e] = wp.float64(0.0)
                return
        out[e] = energy_of(stencil, stiffness, e, rest_of(rest, e), x, d)

    return energy_of_elements


@cache
def energy_parts(term: Term, dtype, block: int, clearing: bool = False):
    """Kernel over (copies, lanes): parts of Σ kₑ Aₑ u(yₑ) [J] at x + d."""
    vec3, _ = types(dtype)
    rest_type = wp.types.vector(term.parameters, dtype)
    (energy_of, _gradient, _hessian), rest_of = of_element(term, dtype, True), load(rest_type)
    store_part, _add_up = block_sums(block)

    @wp.kernel(module="unique", enable_backward=False)
    def energy_of_lanes(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        clear: wp.array(dtype=dtype),
        # parameters
        per_copy: int,
        lanes: int,
        # out
        parts: wp.array2d(dtype=wp.float64),
    ):
        copy, lane = wp.tid()
        total = wp.float64(0.0)
        for j in range(lane, per_copy, lanes):
            e = copy * per_copy + j
            if wp.static(clearing):
                if is_clear(clear[e], d[stencil[e, 0]]):
                    continue
            total += energy_of(stencil, stiffness, e, rest_of(rest, e), x, d)
        store_part(lane, total, parts, copy)

    return energy_of_lanes


@cache
def elastic(term: Term, dtype):
    """Struct of a term's forces: elements, x, d, and ``clear``."""
    vec3, _ = types(dtype)

    @wp.struct
    class Elastic:
        stencil: wp.array2d(dtype=wp.int32)
        stiffness: wp.array(dtype=dtype)
        x: wp.array(dtype=vec3)
        d: wp.array(dtype=vec3)
        clear: wp.array(dtype=dtype)

    return Elastic


@cache
def forces(term: Term, dtype, corrected: bool = False, clearing: bool = False):
    """The :class:`.transpose.LocalSource` of kₑ Aₑ ∂u/∂y, with ``clearing`` as in :func:`energy`."""
    data, rest_type = elastic(term, dtype), wp.types.vector(term.parameters, dtype)
    _energy, gradient_of, _hessian = of_element(term, dtype, corrected)

    @wp.func
    def force(data: data, e: int, r: rest_type):
        return gradient_of(data.stencil, data.stiffness, e, r, data.x, data.d)

    @wp.func
    def skips(data: data, e: int):
        return is_clear(data.clear[e], data.d[data.stencil[e, 0]])

    return LocalSource(data, force, skips if clearing else None)


def scatter_gradient(term: Term, dtype, corrected: bool = False, clearing: bool = False):
    """Kernel over elements: adds kₑ Aₑ wᵢ·∂u/∂y [N] to out[vertex i]."""
    return scatter(term, dtype, forces(term, dtype, corrected, clearing))


def gather_gradient(term: Term, dtype, corrected: bool = False, clearing: bool = False):
    return gather(term, dtype, forces(term, dtype, corrected, clearing))


@cache
def hessian_blocks(term: Term, dtype, corrected: bool = False):
    """Kernel over elements: out[e, K·i + j] = kₑ Aₑ ∂²u/∂xᵢ∂xⱼ [N/m], with the ``policy`` of the copy."""
    vec3, mat33 = types(dtype)
    K, rest_type = wp.constant(term.vertices), wp.types.vector(term.parameters, dtype)
    weight, block_of, (_energy, _gradient, hessian_of) = (
        term.weight,
        to_block(term.rows, dtype),
        of_element(term, dtype, corrected),
    )

    @wp.kernel(module="unique", enable_backward=False)
    def blocks_of_elements(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        elements_per_copy: int,
        policy: wp.array(dtype=wp.float64),
        # out
        out: wp.array2d(dtype=mat33),
    ):
        e = wp.tid()
        r = rest[e]
        corners = out.shape[1] // K  # K, but not a constant: the compiler would take seconds to unroll the loops
        h = hessian_of(stencil, stiffness, e, r, x, d, dtype(policy[e // elements_per_copy]))
        for i in range(corners):
            wi = weight(r, i)
            for j in range(corners):
                out[e, K * i + j] = block_of(wi, weight(r, j), h)

    return blocks_of_elements


@cache
def scatter_hessian(term: Term, dtype, corrected: bool = False):
    """Kernel over elements: adds block q = K·i + j of :func:`hessian_blocks` to values[slots[K²e + q]] if that slot is ≥ 0.

    Block (j, i) is the transpose of (i, j).
    """
    vec3, mat33 = types(dtype)
    K, rest_type = wp.constant(term.vertices), wp.types.vector(term.parameters, dtype)
    weight, put, (_energy, _gradient, hessian_of) = term.weight, add_outer(term.rows, dtype), of_element(term, dtype, corrected)
    rest_of, slot, fetch, short = load(rest_type), load(wp.int32), prefetch(mat33), term.vertices <= 2

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_blocks(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        slots: wp.array(dtype=wp.int32),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        elements_per_copy: int,
        policy: wp.array(dtype=wp.float64),
        # in and out
        values: wp.array(dtype=mat33),
    ):
        e = wp.tid()
        fetch(values, slots, K * K * (e + AHEAD), K * K * (e + AHEAD + 1))
        r = rest_of(rest, e)
        h = hessian_of(stencil, stiffness, e, r, x, d, dtype(policy[e // elements_per_copy]))
        first = K * K * e
        if wp.static(short):
            for i in range(K):
                for j in range(i, K):
                    t = wp.where(i < j, slot(slots, first + K * j + i), -1)
                    put(weight(r, i), weight(r, j), h, slot(slots, first + K * i + j), t, values)
        else:
            corners = stencil.shape[1]  # K, but not a constant: the compiler would take seconds to unroll the loops
            for i in range(corners):
                wi = weight(r, i)
                for j in range(i, corners):
                    t = wp.where(i < j, slot(slots, first + K * j + i), -1)
                    put(wi, weight(r, j), h, slot(slots, first + K * i + j), t, values)

    return scatter_blocks


@cache
def row_norms(dtype):
    """Kernel over rows of blocks: out = Σ √(‖·‖₁‖·‖∞), in float64, a bound of the spectral norms."""
    _, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def norms_of_rows(
        # state in
        blocks: wp.array2d(dtype=mat33),
        # out
        out: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        total = wp.float64(0.0)
        for j in range(blocks.shape[1]):
            block = blocks[i, j]
            row, column, sum = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
            for a in range(3):
                of_row, of_column = wp.float64(0.0), wp.float64(0.0)
                for b in range(3):
                    of_row += wp.abs(wp.float64(block[a, b]))
                    of_column += wp.abs(wp.float64(block[b, a]))
                row, column, sum = wp.max(row, of_row), wp.max(column, of_column), sum + of_row
            norm = wp.sqrt(row * column)
            total += wp.where(wp.isnan(sum), sum, norm)  # a maximum may lose NaN
        out[i] = total

    return norms_of_rows


@cache
def constant_blocks(term: Term, dtype):
    """Kernel over elements: out[e, K·i + j] = kₑ Aₑ wᵢ·wⱼ [N/m], in float64."""
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type = wp.types.vector(term.parameters, dtype)
    weight, measure = term.weight, term.measure

    @wp.kernel(module="unique", enable_backward=False)
    def blocks_of_weights(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        # out
        out: wp.array2d(dtype=wp.float64),
    ):
        e = wp.tid()
        r = rest[e]
        scale = wp.float64(stiffness[e]) * wp.float64(measure(r))
        for i in range(K):
            wi = weight(r, i)
            for j in range(K):
                wj = weight(r, j)
                total = wp.float64(0.0)
                for m in range(M):
                    total += wp.float64(wi[m]) * wp.float64(wj[m])
                out[e, K * i + j] = scale * total

    return blocks_of_weights


# Weights up to this fraction of the largest one of an element count as 0, such as cotangents that cancel in double precision.
ZERO = 1e-12


@cache
def sum_entries():
    """Kernel over (copies, entries of a matrix): sums of the entries of :func:`constant_blocks` and of their sizes.

    Entries that are 0 up to rounding count as 0.
    """
    threshold = wp.constant(ZERO * ZERO)

    @wp.kernel(module="unique", enable_backward=False)
    def sum_each_entry(
        # elements
        offsets: wp.array(dtype=wp.int32),
        sources: wp.array(dtype=wp.int32),
        blocks: wp.array3d(dtype=wp.float64),
        # parameters
        K: int,
        # out
        numbers: wp.array2d(dtype=wp.float64),
        sizes: wp.array2d(dtype=wp.float64),
    ):
        copy, s = wp.tid()
        number, size = wp.float64(0.0), wp.float64(0.0)
        for n in range(offsets[s], offsets[s + 1]):
            e = sources[n] // (K * K)
            entry = sources[n] - e * K * K
            i = entry // K
            j = entry - i * K
            most = wp.float64(0.0)
            for k in range(K):
                most = wp.max(most, blocks[copy, e, k * (K + 1)])
            least = wp.min(blocks[copy, e, i * (K + 1)], blocks[copy, e, j * (K + 1)])
            value = blocks[copy, e, entry]
            if least <= wp.float64(threshold) * most:
                value = wp.float64(0.0)
            number += value
            size += wp.abs(value)
        numbers[copy, s] = number
        sizes[copy, s] = size

    return sum_each_entry
