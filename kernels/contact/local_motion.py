"""Kernels that bound the moves of all cloth near a vertex, so that a search may omit common motion.

Two elements can meet only if their distance is at most the difference of their moves, and cloth nearby moves almost alike.
"""

from functools import cache

import warp as wp

from ..memory import load
from ..pairs import Layout
from ..rotation import epsilon
from ..vectors import types
from .obstacles import copy_of, vector_within

FARTHEST = 1e9  # largest cell coordinate; the outermost cells contain everything beyond
MODULE = "warpcloth.local_motion"


@wp.func
def bucket_of(x: int, y: int, z: int, code: int, buckets: int):
    """The bucket of a cell, of 2ᵏ; cells along x have buckets in sequence."""
    key = wp.uint32(x) + wp.uint32(y) * wp.uint32(73856093) + wp.uint32(z) * wp.uint32(19349663)
    return wp.int32((key + wp.uint32(code) * wp.uint32(83492791)) & wp.uint32(buckets - 1))


@cache
def motions(dtype):
    """Struct of moves near each vertex, and of clusters of vertices that are near one another at rest.

    Cluster c has ``members`` from first[c] to first[c+1] and the ``mean`` of their moves; ``cluster`` (N,) may be −1. A vertex
    is ``calm`` if its move differs by at most ``size`` [m] from the mean. ``lowest`` and ``highest`` (B,) bound means and moves
    of obstacles. ``tables`` (4, buckets) bound moves of calm vertices in cells: p from x, and q from the positions ``found`` of
    the last list. ``low`` and ``high`` (V,) bound p in the cells about a vertex. They are +∞ and −∞ where all q differ by at
    most ``alike`` [m], so that only listed pairs may meet; ``some`` is 1 if there are others, or elements with vertices
    farther apart than a cell.
    """
    vec3, _ = types(dtype)

    @wp.struct
    class LocalMotion:
        layout: Layout
        size: dtype
        alike: dtype
        first: wp.array(dtype=wp.int32)
        members: wp.array(dtype=wp.int32)
        cluster: wp.array(dtype=wp.int32)
        calm: wp.array(dtype=wp.int32)
        mean: wp.array(dtype=vec3)
        lowest: wp.array(dtype=vec3)
        highest: wp.array(dtype=vec3)
        tables: wp.array2d(dtype=vec3)
        low: wp.array(dtype=vec3)
        high: wp.array(dtype=vec3)
        some: wp.array(dtype=wp.int32)

    return LocalMotion


@cache
def _extend(dtype):
    vec3, _ = types(dtype)

    @wp.func
    def extend(low: wp.array(dtype=vec3), high: wp.array(dtype=vec3), i: int, p: vec3):
        if wp.max(wp.max(low[i] - p), wp.max(p - high[i])) > dtype(0.0):  # few do
            if wp.length_sq(p) < dtype(wp.inf):
                wp.atomic_min(low, i, p)
                wp.atomic_max(high, i, p)

    return extend


@cache
def find_means(dtype):
    """Kernel over clusters, then obstacles, which stand if p ends before them: means of moves p, and their range in a copy."""
    vec3, _ = types(dtype)
    extend, vector_or_zero = _extend(dtype), vector_within(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def find_each_mean(
        # state in
        p: wp.array(dtype=vec3),
        # in and out
        motion: motions(dtype),
    ):
        c = wp.tid()
        clusters = motion.mean.shape[0]
        if c >= clusters:
            i = motion.layout.cloth + c - clusters
            extend(motion.lowest, motion.highest, copy_of(motion.layout, i), vector_or_zero(p, i))
            return
        total = vec3()
        first = motion.first[c]
        end = motion.first[c + 1]
        for k in range(first, end):
            total += p[motion.members[k]]
        total /= dtype(end - first)
        motion.mean[c] = total
        extend(motion.lowest, motion.highest, copy_of(motion.layout, motion.members[first]), total)

    return find_each_mean


@cache
def cells(dtype):
    """Device functions (motion, copy) → the cell length H [m], and (motion, x, H, copy, dx, dy, dz) → a bucket next to x.

    Along each axis the moves of two calm elements differ by at most the range of the means + 2·``size``, and the extent of each
    is at most 2·``size``. H is the range and 6·``size``, so those that may meet are in adjacent cells.
    """
    vec3, _ = types(dtype)
    farthest = dtype(FARTHEST)

    @wp.func
    def cell_length(motion: motions(dtype), copy: int):
        return wp.max(wp.max(motion.highest[copy] - motion.lowest[copy]), dtype(0.0)) + dtype(6.0) * motion.size

    @wp.func
    def cell(motion: motions(dtype), x: vec3, H: dtype, copy: int, dx: int, dy: int, dz: int):
        at = wp.vec3i()
        for i in range(3):
            at[i] = wp.int32(wp.floor(wp.clamp(x[i] / H, -farthest, farthest)))
        return bucket_of(at[0] + dx, at[1] + dy, at[2] + dz, copy, motion.tables.shape[1])

    return cell_length, cell


@cache
def note_moves(dtype):
    """Kernel over vertices of the cloth: which are calm, and the range of their moves in each cell."""
    vec3, _ = types(dtype)
    extend, (cell_length, cell) = _extend(dtype), cells(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def note_each_move(
        # state in
        x: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
        found: wp.array(dtype=vec3),
        # in and out
        motion: motions(dtype),
    ):
        i = wp.tid()
        c = motion.cluster[i]
        if c < 0:
            return
        # Ranges have no moves whose square is not finite.
        finite = wp.max(wp.length_sq(p[i]), wp.length_sq(motion.mean[c])) < dtype(wp.inf)
        calm = finite and wp.length(p[i] - motion.mean[c]) <= motion.size
        motion.calm[i] = wp.where(calm, 1, 0)
        if calm:
            copy = copy_of(motion.layout, i)
            b = cell(motion, x[i], cell_length(motion, copy), copy, 0, 0, 0)
            extend(motion.tables[0], motion.tables[1], b, p[i])
            extend(motion.tables[2], motion.tables[3], b, x[i] + p[i] - found[i])

    return note_each_move


@cache
def bound_moves(dtype):
    """Kernel over vertices: ``low``, ``high`` and ``some``. Vertices that are not calm have the bounds of their copy."""
    vec3, _ = types(dtype)
    (cell_length, cell), vector = cells(dtype), load(vec3, 2)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def bound_each_move(
        # state in
        x: wp.array(dtype=vec3),
        # in and out
        motion: motions(dtype),
    ):
        i = wp.tid()
        copy = copy_of(motion.layout, i)
        of_cloth = i < motion.layout.cloth
        if of_cloth:
            if motion.cluster[i] < 0:
                return
            if motion.calm[i] == 0:
                more = vec3(motion.size, motion.size, motion.size)
                motion.low[i] = motion.lowest[copy] - more
                motion.high[i] = motion.highest[copy] + more
                motion.some[0] = 1
                return
        H = cell_length(motion, copy)
        buckets = motion.tables.shape[1]
        low = vec3(dtype(wp.inf), dtype(wp.inf), dtype(wp.inf))
        high = -low
        q_low = low
        q_high = high
        for dz in range(-1, 2):
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    b = cell(motion, x[i], H, copy, dx, dy, dz)
                    low = wp.min(low, vector(motion.tables, b))
                    high = wp.max(high, vector(motion.tables, buckets + b))
                    q_low = wp.min(q_low, vector(motion.tables, 2 * buckets + b))
                    q_high = wp.max(q_high, vector(motion.tables, 3 * buckets + b))
        if of_cloth and wp.length(q_high - q_low) <= motion.alike:
            low = vec3(dtype(wp.inf), dtype(wp.inf), dtype(wp.inf))
            high = -low
        else:
            motion.some[0] = 1
        motion.low[i] = low
        motion.high[i] = high

    return bound_each_move


@cache
def differences(dtype):
    """Device functions on the motion of a box relative to cloth nearby, and on whether three vertices are calm.

    ``relative_box`` is the box that low to high sweeps by p_low to p_high, in the frame of what moves by ``m`` to ``n``.
    """
    vec3, _ = types(dtype)

    @wp.func
    def relative_box(low: vec3, high: vec3, p_low: vec3, p_high: vec3, m: vec3, n: vec3, ulps: dtype):
        far = wp.max(wp.max(wp.abs(p_low)), wp.max(wp.abs(p_high))) + wp.max(wp.max(wp.abs(m)), wp.max(wp.abs(n)))
        more = ulps * epsilon(far) * far
        edge = vec3(more, more, more)
        return low + wp.min(p_low - n, vec3()) - edge, high + wp.max(p_high - m, vec3()) + edge

    @wp.func
    def all_calm(motion: motions(dtype), i: int, j: int, k: int):
        return motion.calm[i] != 0 and motion.calm[j] != 0 and motion.calm[k] != 0

    return relative_box, all_calm
