"""Kernels that find vertex–triangle pairs and edge–edge pairs near one another, in a hashed grid."""

from functools import cache

import warp as wp

from ..memory import load
from ..vectors import types
from .local_motion import bucket_of, differences, motions
from .obstacles import CLOTH, OBSTACLE, copy_of, has_obstacle, in_copy, vector_within
from .proximity_grid import MODULE, box_tests, boxes, boxes_meet, code_of, grids, surfaces
from .self_gaps import nearest_of_face

MAX_COUNT = wp.constant(1 << 29)  # largest number of pairs of a kind that is counted


@wp.struct
class PairList:
    """The pairs: ``counts`` (2,) of those found, and unordered (row, item) of those within the capacity.

    Rows are vertices, then edges. Row i has the sorted items from ``first`` [i] on, which makes the order of pairs fixed.
    ``row_counts`` is 0 between launches.
    """

    counts: wp.array(dtype=wp.int32)
    found: wp.array(dtype=wp.vec2i)
    row_counts: wp.array(dtype=wp.int32)
    first: wp.array(dtype=wp.int32)
    items: wp.array(dtype=wp.int32)
    stencils: wp.array(dtype=wp.vec4i)
    distances: wp.array(dtype=wp.float64)


@cache
def distance_of(dtype, of_edges: bool):
    """Device function (x₀, x₁, x₂, x₃) → the distance of vertex x₀ and triangle x₁x₂x₃, or of edges x₀x₁ and x₂x₃ [m]."""
    vec3, _ = types(dtype)
    zero, one = dtype(0.0), dtype(1.0)

    @wp.func
    def on_segment(along: dtype, squared: dtype):
        return wp.where(squared > zero, wp.clamp(along / squared, zero, one), zero)

    @wp.func
    def of_two_edges(a: vec3, b: vec3, c: vec3, d: vec3):
        """Ericson 2004, *Real-time collision detection*, 5.1.9; then s again, which is rounding for parallel edges."""
        e = b - a
        f = d - c
        r = a - c
        ee = wp.dot(e, e)
        ff = wp.dot(f, f)
        ef = wp.dot(e, f)
        er = wp.dot(e, r)
        fr = wp.dot(f, r)
        det = ee * ff - ef * ef
        s = zero
        if det > zero:
            s = wp.clamp((ef * fr - er * ff) / det, zero, one)
        t = on_segment(ef * s + fr, ff)
        s = on_segment(ef * t - er, ee)
        return wp.length(r + s * e - t * f)

    @wp.func
    def of_vertex(p: vec3, a: vec3, b: vec3, c: vec3):
        A = wp.vec3d(a) - wp.vec3d(p)
        B = wp.vec3d(b) - wp.vec3d(p)
        C = wp.vec3d(c) - wp.vec3d(p)
        _code, w = nearest_of_face(A, B, C)
        return dtype(wp.length(w[0] * A + w[1] * B + w[2] * C))

    return of_two_edges if of_edges else of_vertex


@cache
def cutoffs(dtype, of_edges: bool):
    """Device function (surface, stencil) → contact distance of a pair [m], in one piece at most half the rest distance."""
    distance = distance_of(dtype, of_edges)

    @wp.func
    def cutoff(surface: surfaces(dtype), s: wp.vec4i):
        found = surface.distance
        a = in_copy(surface.layout, s[0])
        d = in_copy(surface.layout, s[3])
        if has_obstacle(surface.layout, s):
            found = surface.of_meshes
        elif surface.piece[a] == surface.piece[d]:
            if not (wp.length(surface.rest[a] - surface.rest[d]) > surface.far):
                b = in_copy(surface.layout, s[1])
                c = in_copy(surface.layout, s[2])
                apart = distance(surface.rest[a], surface.rest[b], surface.rest[c], surface.rest[d])
                found = wp.min(found, dtype(0.5) * apart)
        return found

    return cutoff


@cache
def take_near(dtype, of_edges: bool):
    """Returns the ``take`` of :func:`search_pairs` that lists pairs nearer than contact distance + skin, and its struct."""
    vec3, _ = types(dtype)
    corner = load(vec3)
    distance, cutoff = distance_of(dtype, of_edges), cutoffs(dtype, of_edges)
    KIND = wp.constant(int(of_edges))

    @wp.func
    def take(surface: surfaces(dtype), x: wp.array(dtype=vec3), s: wp.vec4i, i: int, k: int, triangles: int, pairs: PairList):
        d = distance(corner(x, s[0]), corner(x, s[1]), corner(x, s[2]), corner(x, s[3]))
        if d < surface.max_distance + surface.skin:
            r = dtype(0.0)
            if not d < surface.skin:
                r = cutoff(surface, s)
                if has_obstacle(surface.layout, s) and (wp.static(of_edges) or s[0] >= surface.layout.cloth):
                    r = surface.close
            if d < surface.skin + r:
                if pairs.counts[KIND] < MAX_COUNT:
                    slot = wp.atomic_add(pairs.counts, KIND, 1)
                    row = i
                    item = k
                    if wp.static(of_edges):
                        slot += pairs.counts[0]
                        row = wp.min(i, k) + x.shape[0]
                        item = wp.max(i, k)
                    if slot < pairs.found.shape[0]:
                        wp.atomic_add(pairs.row_counts, row, 1)
                        pairs.found[slot] = wp.vec2i(row, item + triangles)

    return take, PairList


@cache
def search_pairs(dtype, of_edges: bool, take, name: str):
    """Kernel over vertices, or edges: calls ``take`` for pairs with triangles, or with edges, whose boxes meet.

    ``take`` (dtype, of_edges) returns a device function (surface, x, s, i, k, triangles, out) and the struct of ``out``; s is
    the stencil, i its vertex or edge, and k its triangle or other edge. Boxes are at x, or along moves ``p`` of the cloth or of
    all vertices. Calm cloth has its boxes at x on level 0, and meets the box that an element sweeps relative to all calm cloth
    nearby. No pair is missed: a box meets those of its level and above, and that of a vertex that moves, which may be larger,
    those of all levels. Of two edges of one level only one finds the other, by the order of cells along z and y, or of indices.
    ``shares`` threads share a search.
    """
    vec3, _ = types(dtype)
    box_at, box_along, stored_box, cell_of, _level_of = boxes(dtype)
    relative_box, _all_calm = differences(dtype)
    vector, vector_or_zero = load(vec3), vector_within(dtype)
    number, four = load(wp.int32), load(wp.vec4i)
    visit, out_type = take(dtype, of_edges)
    ends_of, next_meeting = box_tests(dtype)
    KIND = wp.constant(int(of_edges))

    # Separate modules: graphs on the CPU find kernels of a module by name, and both kinds have the same name.
    @wp.kernel(module=f"{MODULE}.{name}.{dtype.__name__}.{KIND}", enable_backward=False)
    def find_each_pair(
        # elements
        surface: surfaces(dtype),
        # state in
        x: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
        motion: motions(dtype),
        grid: grids(dtype),
        # parameters
        triangles: int,
        shares: int,
        # in and out
        out: out_type,
    ):
        i, share = wp.tid()
        if wp.static(of_edges):
            own = surface.items[triangles + i]
            copy = own[3] >> 1
            group = surface.groups[triangles + i]
        else:
            copy = copy_of(surface.layout, i)
            own = wp.vec4i(i, i, i, 0)
            j = in_copy(surface.layout, i)
            if surface.piece[j] < 0:
                return
            group = surface.vertex_groups[j]
        low, high, level = stored_box(surface, motion, x, p, grid.size, own[0], own[1], own[1])
        if level < 0:
            return
        centre = cell_of(grid.size, level, dtype(0.5) * (low + high))
        near = low
        far = high
        calm = wp.bool(False)
        apart = wp.bool(False)
        if p:
            calm = surface.itself
            if calm:
                # Level 0 has the boxes at x of calm elements; this one moves relative to them.
                m = vector(motion.low, own[0])
                n = vector(motion.high, own[0])
                apart = m[0] > n[0]
                a = vector_or_zero(p, own[0])
                b = vector_or_zero(p, own[1])
                near, far, _radius = box_at(surface, x, own[0], own[1], own[1])
                near, far = relative_box(near, far, wp.min(a, b), wp.max(a, b), m, n, dtype(4.0))
                low, high = box_along(surface, x, p, own[0], own[1], own[1])
        if group == OBSTACLE:
            if not boxes_meet(low, high, surface.lowest[copy], surface.highest[copy]):
                return
        lowest = level
        buckets = grid.counts.shape[0]
        if wp.static(not of_edges):
            if p:
                lowest = 0
        for kind in range(KIND, KIND + 4, 2):
            # Among edges of one level, those of cloth find those of obstacles, and one of two of the cloth finds the other.
            ordered = kind == KIND and group != OBSTACLE
            if (kind != KIND and group != CLOTH) or (ordered and not surface.itself):
                continue
            level = lowest
            if wp.static(of_edges):
                if group == OBSTACLE:
                    level += 1
            present = grid.levels[kind] >> level
            while present != 0:
                of_calm = calm and level == 0 and kind == KIND
                if (present & 1) != 0 and not (of_calm and apart):
                    l = wp.where(of_calm, near, low)
                    h = wp.where(of_calm, far, high)
                    ends = ends_of(h, l)
                    code = code_of(copy, kind, level)
                    # Those with the centres of boxes that meet this one, half of which is in the extent.
                    extent = grid.extents[kind, level]
                    one = cell_of(grid.size, level, l - extent)
                    two = cell_of(grid.size, level, h + extent)
                    if wp.static(of_edges):
                        within = ordered and level == lowest
                        if within:
                            one[2] = centre[2]
                    width = wp.min(two[0] - one[0] + 1, buckets)
                    height = two[1] - one[1] + 1
                    rows = wp.int64(height) * wp.int64(two[2] - one[2] + 1)
                    everywhere = rows * wp.int64(width) > wp.int64(buckets)
                    if everywhere:
                        rows = wp.int64(1)
                        width = buckets
                    # Many rows are divided among the threads. Of few rows the entries are, for most of these rows may be empty.
                    by_rows = rows >= wp.int64(shares * shares)
                    stride = wp.where(by_rows, 1, shares)
                    skipped = wp.where(by_rows, 0, share)
                    for line in range(share - skipped, wp.int32(rows), shares // stride):
                        cz = one[2] + line // height
                        cy = one[1] + line - height * (cz - one[2])
                        if wp.static(of_edges):
                            if within and not everywhere and cz == centre[2] and cy < centre[1]:
                                continue
                        run = wp.int32(0)
                        if not everywhere:
                            run = bucket_of(one[0], cy, cz, code, buckets)
                        begin = number(grid.first, run)
                        end = number(grid.first, wp.min(run + width, buckets))
                        # A sequence beyond the last bucket continues at the first.
                        more = number(grid.first, wp.max(run + width - buckets, 0))
                        at = next_meeting(grid.boxes, begin + skipped, end, more, stride, ends)
                        while at < end + more:
                            slot = wp.where(at < end, at, at - end)
                            at = next_meeting(grid.boxes, at + stride, end, more, stride, ends)
                            entry = four(grid.entries, slot)
                            if everywhere:
                                cy = entry[1]
                                cz = entry[2]
                                if cz < one[2]:
                                    continue
                            if entry[1] != cy or entry[2] != cz or entry[3] != code:
                                continue
                            if group == OBSTACLE and number(surface.groups, entry[0]) != CLOTH:
                                continue
                            other = four(surface.items, entry[0])
                            if other[0] == own[0] or other[1] == own[0] or other[0] == own[1] or other[1] == own[1]:
                                continue
                            s = wp.vec4i(own[0], own[1], other[0], other[1])
                            k = entry[0] - triangles
                            if wp.static(of_edges):
                                if within and cz == centre[2] and (cy < centre[1] or (cy == centre[1] and k <= i)):
                                    continue
                                if k < i:
                                    s = wp.vec4i(other[0], other[1], own[0], own[1])
                            elif other[2] == own[0]:
                                continue
                            else:
                                s = wp.vec4i(own[0], other[0], other[1], other[2])
                            visit(surface, x, s, i, k, triangles, out)
                present = present >> 1
                level += 1

    return find_each_pair


@wp.func
def sort(values: wp.array(dtype=wp.int32), first: int, end: int):
    """Sorts a range (Shell 1959)."""
    gap = wp.int32(0)
    for k in range(first + 1, end):
        if values[k - 1] > values[k]:
            gap = 1
            break
    if gap > 0:
        while 3 * gap + 1 < end - first:
            gap = 3 * gap + 1
    while gap > 0:
        for k in range(first + gap, end):
            value = values[k]
            at = k
            while at >= first + gap and values[at - gap] > value:
                values[at] = values[at - gap]
                at -= gap
            values[at] = value
        gap = gap // 3


@wp.kernel(module="warpcloth.proximity", enable_backward=False)
def fill_rows(
    # in and out
    pairs: PairList,
):
    """Kernel over the capacity: the items of each row; counts ``row_counts`` down to 0."""
    capacity = pairs.found.shape[0]
    k = capacity - 1 - wp.tid()
    if k < wp.min(wp.min(pairs.counts[0], capacity) + pairs.counts[1], capacity):
        row = pairs.found[k][0]
        slot = pairs.first[row] + wp.atomic_sub(pairs.row_counts, row, 1) - 1
        pairs.items[slot] = pairs.found[k][1]


@cache
def write_pairs(dtype):
    """Kernel over rows: their sorted pairs, with the contact distance of each [m]."""
    vertex_cutoff, edge_cutoff = (cutoffs(dtype, each) for each in (False, True))

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def write_each_pair(
        # elements
        surface: surfaces(dtype),
        # parameters
        vertices: int,
        triangles: int,
        # out
        pairs: PairList,
    ):
        row = wp.tid()
        first = pairs.first[row]
        end = pairs.first[row + 1]
        if first == end:
            return
        sort(pairs.items, first, end)
        for k in range(first, end):
            v = surface.items[pairs.items[k]]
            if row < vertices:
                s = wp.vec4i(row, v[0], v[1], v[2])
                d = vertex_cutoff(surface, s)
            else:
                own = surface.items[row - vertices + triangles]
                s = wp.vec4i(own[0], own[1], v[0], v[1])
                d = edge_cutoff(surface, s)
            pairs.stencils[k] = s
            pairs.distances[k] = wp.float64(d)

    return write_each_pair
