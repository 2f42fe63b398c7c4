"""The hashed grid that finds near pairs, and structs of surfaces.

The *items* are the triangles and then the edges of all copies. Their boxes are sorted by centre into the cells of a
hierarchical grid (count, scan, fill). Level l has boxes with half sizes up to ``size``·2ˡ, so a box meets only boxes whose
centres are at most this far from it, in its own level and those above. A row of cells along x is hashed to a sequence of
buckets; so cells are a quarter as long as wide.
"""

from functools import cache
from typing import Any

import warp as wp

from ..memory import load
from ..pairs import Layout
from ..reduce import largest_of_warp
from ..rotation import epsilon
from ..vectors import types
from .local_motion import FARTHEST, bucket_of, differences, motions
from .obstacles import OBSTACLE, vector_within

LEVELS = wp.constant(30)  # levels of the grid; the last has one cell
MODULE = "warpcloth.proximity"


@cache
def surfaces(dtype):
    """Struct of the cloths: the vertices of each item (the last vertex of an edge twice), with 2·copy + kind.

    ``rest`` are rest positions in a copy [m], and ``piece`` connected pieces, −1 without an element. ``groups`` and
    ``vertex_groups`` say which elements meet, ``itself`` whether cloth meets cloth. ``distance`` is the contact distance of
    cloth with cloth, ``of_meshes`` that with meshes, ``max_distance`` the larger one; edges and vertices of meshes are listed
    up to ``close`` and the skin [m]. Elements whose first vertices are more than ``far`` [m] apart at rest are at least twice
    the contact distance apart. ``lowest`` and ``highest`` bound the cloth of each copy; without obstacles they are empty.
    """
    vec3, _ = types(dtype)

    @wp.struct
    class ContactSurface:
        layout: Layout
        items: wp.array(dtype=wp.vec4i)
        groups: wp.array(dtype=wp.int32)
        vertex_groups: wp.array(dtype=wp.int32)
        itself: wp.bool
        rest: wp.array(dtype=vec3)
        piece: wp.array(dtype=wp.int32)
        distance: dtype
        of_meshes: dtype
        max_distance: dtype
        close: dtype
        skin: dtype
        far: dtype
        lowest: wp.array(dtype=vec3)
        highest: wp.array(dtype=vec3)

    return ContactSurface


@cache
def grids(dtype):
    """Struct of the grid: ``size``, the half size of the largest boxes of level 0 [m], and 2ᵏ buckets of entries.

    Bucket b has the entries first[b] to first[b+1], each a box and (item, y, z, code) with y and z of the cell. ``counts`` and
    ``keys`` are scratch. ``levels`` (4,) has a bit for each level with items of a kind, ``extents`` their largest half sizes
    [m].
    """
    vec3, _ = types(dtype)

    @wp.struct
    class Grid:
        size: dtype
        levels: wp.array(dtype=wp.int32)
        extents: wp.array2d(dtype=vec3)
        counts: wp.array(dtype=wp.int32)
        keys: wp.array(dtype=wp.int32)
        first: wp.array(dtype=wp.int32)
        entries: wp.array(dtype=wp.vec4i)
        boxes: wp.array(dtype=wp.types.vector(8, dtype))

    return Grid


@cache
def boxes(dtype):
    """Device functions on boxes and cells: ``box_at``, ``box_along``, ``stored_box``, ``cell_of``, ``level_of``."""
    vec3, _ = types(dtype)
    _relative_box, all_calm = differences(dtype)
    half, farthest, corner, vector_or_zero = dtype(0.5), dtype(FARTHEST), load(vec3), vector_within(dtype)

    @wp.func
    def box_of(radius: dtype, a: vec3, b: vec3, c: vec3):
        """The box of three points, enlarged by half of ``radius`` and a margin for rounding."""
        low = wp.min(wp.min(a, b), c)
        high = wp.max(wp.max(a, b), c)
        more = half * radius
        more += dtype(4.0) * epsilon(more) * wp.max(wp.max(wp.abs(low)), wp.max(wp.abs(high)))
        # min and max ignore NaN; these products do not.
        more += wp.dot(a, vec3()) + wp.dot(b, vec3()) + wp.dot(c, vec3())
        edge = vec3(more, more, more)
        return low - edge, high + edge

    @wp.func
    def box_at(surface: surfaces(dtype), x: wp.array(dtype=vec3), i: int, j: int, k: int):
        """The box of three vertices and its radius [m]. Of an edge, j and k are equal."""
        of_mesh = i >= surface.layout.cloth
        is_edge = i != j and j == k
        radius = surface.skin + surface.max_distance
        if (of_mesh or not surface.itself) and (is_edge or of_mesh == (i == j)):
            radius = surface.skin + surface.close
        low, high = box_of(radius, corner(x, i), corner(x, j), corner(x, k))
        return low, high, radius

    @wp.func
    def box_along(surface: surfaces(dtype), x: wp.array(dtype=vec3), p: wp.array(dtype=vec3), i: int, j: int, k: int):
        """The box of three vertices that move from x to x + p, or stay if p is None."""
        a, b, c = corner(x, i), corner(x, j), corner(x, k)
        low, high, radius = box_at(surface, x, i, j, k)
        if p:
            l, h = box_of(radius, a + vector_or_zero(p, i), b + vector_or_zero(p, j), c + vector_or_zero(p, k))
            low = wp.min(low, l)
            high = wp.max(high, h)
        return low, high

    @wp.func
    def level_of(size: dtype, low: vec3, high: vec3):
        """The level of a box; −1 if it is not finite."""
        own = half * wp.max(high - low)
        level = wp.int32(-1)
        if own < dtype(wp.inf):
            level = wp.int32(0)
            while level < LEVELS and own > size:
                own *= half
                level += 1
        return level

    @wp.func
    def stored_box(
        surface: surfaces(dtype),
        motion: motions(dtype),
        x: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
        size: dtype,
        i: int,
        j: int,
        k: int,
    ):
        """The box of three vertices in the grid, and its level.

        Of calm vertices that move it is their box at x, on level 0. Other boxes along moves of the cloth are above it.
        """
        low, high = box_along(surface, x, p, i, j, k)
        level = level_of(size, low, high)
        if p:
            if surface.itself and i < surface.layout.cloth and level >= 0:
                level = wp.max(level, 1)
                if all_calm(motion, i, j, k):
                    l, h, _radius = box_at(surface, x, i, j, k)
                    if level_of(size, l, h) == 0:
                        low = l
                        high = h
                        level = wp.int32(0)
        return low, high, level

    @wp.func
    def cell_of(size: dtype, level: int, p: vec3):
        cell = wp.vec3i()
        if level < LEVELS:
            q = vec3(dtype(2.0) * p[0], half * p[1], half * p[2]) / (size * dtype(1 << level))
            for i in range(3):
                cell[i] = wp.int32(wp.floor(wp.clamp(q[i], -farthest, farthest)))
        return cell

    return box_at, box_along, stored_box, cell_of, level_of


@wp.func
def boxes_meet(low: Any, high: Any, l: Any, u: Any):
    return not (l[0] > high[0] or u[0] < low[0] or l[1] > high[1] or u[1] < low[1] or l[2] > high[2] or u[2] < low[2])


@cache
def box_tests(dtype):
    """Device functions ``ends_of`` (low, high) → a box as stored in the grid, and ``next_meeting``.

    ``next_meeting`` is the first of every ``stride``-th entry from ``at`` to ``end``, then of ``more`` entries from the first
    bucket on, whose box meets the one with low and high exchanged in ``ends``. One branch an entry takes .7 of the time on the
    CPU.
    """
    vec3, _ = types(dtype)
    vec8 = wp.types.vector(8, dtype)
    number = f"wp::{dtype.__name__}"

    @wp.func
    def ends_of(low: vec3, high: vec3):
        return vec8(low[0], low[1], low[2], -high[0], -high[1], -high[2], dtype(0.0), dtype(0.0))

    @wp.func_native(
        "for (; at < end + more; at += stride) { "
        f"const {number}* b = (const {number}*)boxes.data + 8 * size_t(at < end ? at : at - end); "
        "bool apart = false; for (int n = 0; n < 8; ++n) apart |= b[n] > ends[n]; if (!apart) break; } return at;"
    )
    def next_meeting(boxes: wp.array(dtype=vec8), at: int, end: int, more: int, stride: int, ends: vec8) -> int: ...

    return ends_of, next_meeting


@wp.func
def kind_in_grid(v: wp.vec4i, group: int):
    """The kind of an item: 0 for triangles, 1 for edges, and 2 more for obstacles."""
    return (v[3] & 1) + wp.where(group == OBSTACLE, 2, 0)


@wp.func
def code_of(copy: int, kind: int, level: int):
    return (4 * copy + kind) * 32 + level


@cache
def note_large(dtype):
    """Kernel over edges: notes in ``some`` those with a box above level 0, for the vertices of these may be far apart."""
    vec3, _ = types(dtype)
    box_at, *_, level_of = boxes(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def note_each_large(
        # elements
        surface: surfaces(dtype),
        # state in
        x: wp.array(dtype=vec3),
        # parameters
        size: dtype,
        triangles: int,
        # in and out
        motion: motions(dtype),
    ):
        if motion.some[0] == 0:
            v = surface.items[triangles + wp.tid()]
            low, high, _radius = box_at(surface, x, v[0], v[1], v[2])
            if level_of(size, low, high) > 0:
                motion.some[0] = 1

    return note_each_large


@cache
def bound_cloth(dtype):
    """Kernel over vertices of the cloth: extends the box of their copy by their boxes along p."""
    vec3, _ = types(dtype)
    _box_at, box_along, *_ = boxes(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def bound_each_vertex(
        # elements
        surface: surfaces(dtype),
        # state in
        x: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        copy = i // surface.layout.per_copy
        low, high = box_along(surface, x, p, i, i, i)
        if wp.max(wp.max(surface.lowest[copy] - low, high - surface.highest[copy])) > dtype(0.0):
            wp.atomic_min(surface.lowest, copy, low)
            wp.atomic_max(surface.highest, copy, high)

    return bound_each_vertex


@cache
def count_items(dtype):
    """Kernel over items: counts of buckets, the bucket of each item or −1, and the levels that exist.

    Obstacles count where they meet the box of the cloth.
    """
    vec3, _ = types(dtype)
    *_, stored_box, cell_of, _level_of = boxes(dtype)
    largest_in_warp, number = largest_of_warp(dtype), f"wp::{dtype.__name__}"

    # Volatile, because a cached value would miss what other multiprocessors have stored.
    @wp.func_native(
        f"const volatile {number}* at = (const volatile {number}*)((const char*)a.data + i * a.strides[0]) + 3 * j; "
        f"return wp::vec_t<3, {number}>(at[0], at[1], at[2]);"
    )
    def extent_now(a: wp.array2d(dtype=vec3), i: int, j: int) -> vec3: ...

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def count_each_item(
        # elements
        surface: surfaces(dtype),
        # state in
        x: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
        motion: motions(dtype),
        # in and out
        grid: grids(dtype),
    ):
        item = wp.tid()
        v = surface.items[item]
        low, high, level = stored_box(surface, motion, x, p, grid.size, v[0], v[1], v[2])
        if surface.groups[item] == OBSTACLE:
            copy = v[3] >> 1
            if not boxes_meet(low, high, surface.lowest[copy], surface.highest[copy]):
                level = -1
        kind = kind_in_grid(v, surface.groups[item])
        own = largest_in_warp(dtype(0.5) * (high - low), (LEVELS + 2) * kind + level)
        key = wp.int32(-1)
        if level >= 0:
            if (grid.levels[kind] & (1 << level)) == 0:
                wp.atomic_or(grid.levels, kind, 1 << level)
            if wp.max(own) > dtype(0.0):
                if wp.max(own - extent_now(grid.extents, kind, level)) > dtype(0.0):  # few are
                    wp.atomic_max(grid.extents, kind, level, own)
            cell = cell_of(grid.size, level, dtype(0.5) * (low + high))
            key = bucket_of(cell[0], cell[1], cell[2], code_of(v[3] >> 1, kind, level), grid.counts.shape[0])
            wp.atomic_add(grid.counts, key, 1)
        grid.keys[item] = key

    return count_each_item


@cache
def fill_buckets(dtype):
    """Kernel over items: the entries of the buckets; counts ``counts`` down to 0."""
    vec3, _ = types(dtype)
    *_, stored_box, cell_of, _level_of = boxes(dtype)
    ends_of, _next_meeting = box_tests(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def fill_each_bucket(
        # elements
        surface: surfaces(dtype),
        # state in
        x: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
        motion: motions(dtype),
        # in and out
        grid: grids(dtype),
    ):
        item = wp.tid()
        key = grid.keys[item]
        if key < 0:
            return
        v = surface.items[item]
        low, high, level = stored_box(surface, motion, x, p, grid.size, v[0], v[1], v[2])
        cell = cell_of(grid.size, level, dtype(0.5) * (low + high))
        slot = grid.first[key] + wp.atomic_sub(grid.counts, key, 1) - 1
        grid.entries[slot] = wp.vec4i(item, cell[1], cell[2], code_of(v[3] >> 1, kind_in_grid(v, surface.groups[item]), level))
        grid.boxes[slot] = ends_of(low, high)

    return fill_each_bucket
