"""Factories of the kernels that list pairs again where a part of the cloth has moved, on the CPU.

The pairs of a list are those near one another at the positions ``found``. Where few vertices have moved, ``found`` follows
these alone, and only pairs with one of them are found anew. The list is the same, to the bit, as one of all pairs at ``found``.
"""

from functools import cache

import warp as wp

from ..memory import copy_range, load, store
from ..vectors import types
from .piece_motion import pieces
from .proximity import cutoffs, kept, pair_lists
from .proximity_grid import MODULE, boxes, moved_parts, surfaces

# A vertex has moved if that is by more than this fraction of the skin. By more than 0.25 of it, pairs are listed again.
PART = 0.1875


@cache
def take_parts(dtype):
    """Kernel over copies: in copies that have ``moved``, found ← x − drift of vertices whose motion is over ``most``.

    The motion is relative to the ``drift`` of their piece, which is the only one of the copy. If it is over ``most`` for more
    than half of the vertices, found ← x for all.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def take_each_part(
        # state in
        x: wp.array(dtype=vec3),
        copies: wp.array(dtype=wp.int32),
        pieces: pieces(dtype),
        # parameters
        per_copy: int,
        most: dtype,
        # in and out
        found: wp.array(dtype=vec3),
        # out
        moved: moved_parts(dtype),
    ):
        copy = wp.tid()
        first = copy * per_copy
        count = wp.int32(0)
        for i in range(first, first + per_copy):
            moved.vertices[i] = 0
            if copies[copy] != 0:
                if not (wp.length(x[i] - found[i] - pieces.drift[copy]) <= most):
                    moved.vertices[i] = 1
                    count += 1
        if copies[copy] != 0:
            drift = pieces.drift[copy]
            all = 2 * count > per_copy
            if all:
                drift = vec3()
            for i in range(first, first + per_copy):
                if all:
                    moved.vertices[i] = 1
                if moved.vertices[i] != 0:
                    found[i] = x[i] - drift
        if copy == 0:
            far = dtype(wp.inf)
            moved.region[0] = vec3(far, far, far)
            moved.region[1] = -moved.region[0]

    return take_each_part


@cache
def mark_items(dtype):
    """Kernel over items: which have a vertex that has moved, and the region of their boxes."""
    vec3, _ = types(dtype)
    box_of, _along, _level, _cell, _about = boxes(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def mark_each_item(
        # elements
        surface: surfaces(dtype),
        # state in
        x: wp.array(dtype=vec3),
        # in and out
        moved: moved_parts(dtype),
    ):
        item = wp.tid()
        v = surface.items[item]
        some = wp.max(wp.max(moved.vertices[v[0]], moved.vertices[v[1]]), moved.vertices[v[2]])
        moved.items[item] = some
        if some != 0:
            low, high = box_of(surface, x[v[0]], x[v[1]], x[v[2]])
            moved.region[0] = wp.min(moved.region[0], low)
            moved.region[1] = wp.max(moved.region[1], high)

    return mark_each_item


@cache
def merge_pairs(dtype):
    """Kernel of one thread: merges the pairs that were found into those of the list whose parts have not moved.

    ``before`` is scratch for the list. ``counts`` has the numbers of pairs found, and then of all, as if all had room.
    """

    vertex_cutoff, edge_cutoff = (cutoffs(dtype, each) for each in (False, True))
    number, put = load(wp.int32), store(wp.int32)
    copy_items, copy_stencils, copy_distances = (copy_range(each) for each in (wp.int32, wp.vec4i, dtype))

    @wp.func
    def copy(to: pair_lists(dtype), at: int, source: pair_lists(dtype), first: int, count: int):
        copy_items(to.items, at, source.items, first, count)
        copy_stencils(to.stencils, at, source.stencils, first, count)
        copy_distances(to.distances, at, source.distances, first, count)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def merge_all_pairs(
        # elements
        surface: surfaces(dtype),
        moved: moved_parts(dtype),
        # parameters
        vertices: int,
        triangles: int,
        # in and out
        before: pair_lists(dtype),
        pairs: pair_lists(dtype),
    ):
        rows = pairs.row_counts.shape[0]
        capacity = pairs.found.shape[0]
        more = kept(pairs.counts, capacity)
        # The numbers of pairs that stay, and rows with room for them and for those found.
        vertex_pairs = wp.int32(0)
        stay = wp.int32(0)
        total = wp.int32(0)
        begin = number(pairs.first, 0)
        for row in range(rows):
            end = number(pairs.first, row + 1)
            put(before.first, row, begin)
            if row == vertices:
                vertex_pairs = stay
            put(pairs.first, row, wp.min(total, capacity))
            own = wp.int32(0)
            if row < vertices:
                own = number(moved.vertices, row)
            else:
                own = number(moved.items, row - vertices + triangles)
            total += number(pairs.row_counts, row)
            count = wp.int32(0)
            if own == 0:
                count = end - begin
                for k in range(begin, end):
                    count -= number(moved.items, number(pairs.items, k))
            put(before.row_counts, row, count)
            total += count
            stay += count
            begin = end
        listed = pairs.first[rows]
        before.first[rows] = listed
        pairs.first[rows] = wp.min(total, capacity)
        pairs.counts[0] = pairs.counts[0] + vertex_pairs
        pairs.counts[1] = pairs.counts[1] + stay - vertex_pairs
        if pairs.counts[0] + pairs.counts[1] > capacity:  # the host makes room, and all pairs are listed
            for row in range(rows):
                pairs.row_counts[row] = 0
            return
        copy(before, 0, pairs, 0, listed)
        # Rows that stay as they are move together.
        begin = wp.int32(0)  # of those before, in the old list
        at = wp.int32(0)
        for row in range(rows):
            first = number(before.first, row)
            end = number(before.first, row + 1)
            count = number(before.row_counts, row)
            if count < end - first or number(pairs.row_counts, row) > 0:
                copy(pairs, at, before, begin, first - begin)
                at = number(pairs.first, row)
                if count > 0:
                    for k in range(first, end):
                        if number(moved.items, number(before.items, k)) == 0:
                            copy(pairs, at, before, k, 1)
                            at += 1
                begin = end
                at = number(pairs.first, row + 1)
        copy(pairs, at, before, begin, listed - begin)
        # Each pair that was found goes where its item belongs in its row.
        for n in range(more):
            row = pairs.found[n][0]
            item = pairs.found[n][1]
            v = surface.items[item]
            vertex = (v[3] >> 1) * surface.vertices
            s = wp.vec4i(row, v[0], v[1], v[2])
            d = surface.distance
            if row < vertices:
                d = vertex_cutoff(surface, s, vertex)
            else:
                own_item = surface.items[row - vertices + triangles]
                s = wp.vec4i(own_item[0], own_item[1], v[0], v[1])
                d = edge_cutoff(surface, s, vertex)
            at = pairs.first[row + 1] - pairs.row_counts[row]
            pairs.row_counts[row] = pairs.row_counts[row] - 1
            while at > pairs.first[row] and pairs.items[at - 1] > item:
                pairs.items[at] = pairs.items[at - 1]
                pairs.stencils[at] = pairs.stencils[at - 1]
                pairs.distances[at] = pairs.distances[at - 1]
                at -= 1
            pairs.items[at] = item
            pairs.stencils[at] = s
            pairs.distances[at] = d

    return merge_all_pairs
