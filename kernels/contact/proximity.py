"""Factories of the kernels that find vertex–triangle pairs and edge–edge pairs that are near one another.

The *items* are the triangles and then the edges of all copies. Their bounding boxes are sorted by centre into the cells of a
hierarchical grid (count, scan, fill). Level l has boxes with half sizes up to ``size``·2ˡ, so a box meets only boxes whose
centres are at most this far from it, in its own level and those above. Cells are hashed to buckets such that a row along x is a
sequence of buckets. So cells are a quarter as long as wide (measured on waves: 0.75 of the time with cubes).
"""

from functools import cache

import warp as wp

from ..memory import load
from ..rotation import epsilon
from ..vectors import types
from .mesh_colliders import geometry

LEVELS = wp.constant(30)  # levels of the grid; the last has one cell
MOST = wp.constant(1 << 29)  # largest number of pairs of a kind that is counted
FARTHEST = 1e9  # largest cell coordinate; the outermost cells contain everything beyond
MODULE = "warpcloth.proximity"


@cache
def surfaces(dtype):
    """Struct of the cloths: the vertices of each item (the last vertex of an edge twice), with 2·copy + kind.

    A copy has n ``vertices``. ``rest`` is the rest position of each [m], and ``piece`` its connected piece, −1 without an
    element. ``distance`` is the contact distance and ``skin`` the skin [m]. Elements whose first vertices are more than ``far``
    apart at rest are surely at least twice the contact distance apart [m].
    """
    vec3, _ = types(dtype)

    @wp.struct
    class Surface:
        items: wp.array(dtype=wp.vec4i)
        vertices: wp.int32
        rest: wp.array(dtype=vec3)
        piece: wp.array(dtype=wp.int32)
        distance: dtype
        skin: dtype
        far: dtype

    return Surface


@cache
def grids(dtype):
    """Struct of the grid: ``size``, the half size of the largest boxes of level 0 [m], and 2ᵏ buckets of entries.

    Bucket b has the entries first[b] to first[b+1]. An entry is a box and (item, y, z, code), with y and z of the cell; the
    code combines kind, copy and level. ``counts`` and ``keys`` are scratch. ``levels`` has a bit for each level with triangles,
    and one for each level with edges.
    """
    vec3, _ = types(dtype)

    @wp.struct
    class Grid:
        size: dtype
        levels: wp.array(dtype=wp.int32)
        counts: wp.array(dtype=wp.int32)
        keys: wp.array(dtype=wp.int32)
        first: wp.array(dtype=wp.int32)
        entries: wp.array(dtype=wp.vec4i)
        lower: wp.array(dtype=vec3)
        upper: wp.array(dtype=vec3)

    return Grid


@cache
def pair_lists(dtype):
    """Struct of the pairs: ``counts`` (2,) of those found, and unordered (row, item) of those within the capacity.

    Rows are vertices, then edges. Row i has the items from ``first`` [i] on, sorted. ``row_counts`` is scratch, and 0 between
    launches.
    """

    @wp.struct
    class PairList:
        counts: wp.array(dtype=wp.int32)
        found: wp.array(dtype=wp.vec2i)
        row_counts: wp.array(dtype=wp.int32)
        first: wp.array(dtype=wp.int32)
        items: wp.array(dtype=wp.int32)
        stencils: wp.array(dtype=wp.vec4i)
        distances: wp.array(dtype=dtype)

    return PairList


@cache
def closest_points(dtype, of_edges: bool):
    """Device function (x₀, x₁, x₂, x₃) → (w, y): y = Σ wᵢ xᵢ is the shortest vector between two primitives.

    It goes from triangle x₁ x₂ x₃ to vertex x₀, or from edge x₂ x₃ to edge x₀ x₁.
    """
    vec3, mat33 = types(dtype)
    vec4 = wp.types.vector(4, dtype)
    _corners, from_triangle, _carry = geometry(dtype)
    zero, one = dtype(0.0), dtype(1.0)

    @wp.func
    def on_segment(along: dtype, squared: dtype):
        """The parameter of the nearest point of a segment; 0 for a segment without length."""
        return wp.where(squared > zero, wp.clamp(along / squared, zero, one), zero)

    @wp.func
    def of_two_edges(a: vec3, b: vec3, c: vec3, d: vec3):
        """Ericson 2004, *Real-time collision detection*, 5.1.9; then s once more, for parallel edges leave it to rounding."""
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
        return vec4(one - s, s, t - one, -t), r + s * e - t * f

    @wp.func
    def of_vertex(p: vec3, a: vec3, b: vec3, c: vec3):
        d, away, w = from_triangle(p, mat33(a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]))
        return vec4(one, -w[0], -w[1], -w[2]), d * away

    return of_two_edges if of_edges else of_vertex


@cache
def boxes(dtype):
    """Device functions on boxes: ``box_of``, ``level_of``, ``cell_at``, ``cells_about``."""
    vec3, _ = types(dtype)
    half, farthest = dtype(0.5), dtype(FARTHEST)

    @wp.func
    def box_of(surface: surfaces(dtype), a: vec3, b: vec3, c: vec3):
        """The box of three points, enlarged by half of the contact distance and the skin, and by a margin for rounding."""
        low = wp.min(wp.min(a, b), c)
        high = wp.max(wp.max(a, b), c)
        more = half * (surface.distance + surface.skin)
        more += dtype(4.0) * epsilon(more) * wp.max(wp.max(wp.abs(low)), wp.max(wp.abs(high)))
        # min and max ignore NaN; these products do not.
        more += wp.dot(a, vec3()) + wp.dot(b, vec3()) + wp.dot(c, vec3())
        edge = vec3(more, more, more)
        return low - edge, high + edge

    @wp.func
    def level_of(size: dtype, low: vec3, high: vec3):
        """The level of a box; −1 if the box is not finite."""
        own = half * wp.max(high - low)
        level = wp.int32(-1)
        if own < dtype(wp.inf):
            level = wp.int32(0)
            while level < LEVELS and own > size:
                own *= half
                level += 1
        return level

    @wp.func
    def cell_of(size: dtype, p: vec3):
        q = vec3(dtype(2.0) * p[0], half * p[1], half * p[2]) / size
        cell = wp.vec3i()
        for i in range(3):
            cell[i] = wp.int32(wp.floor(wp.clamp(q[i], -farthest, farthest)))
        return cell

    @wp.func
    def cell_at(size: dtype, low: vec3, high: vec3, level: int):
        """The cell of the centre of a box."""
        found = wp.vec3i()
        if level < LEVELS:
            found = cell_of(size * dtype(1 << level), half * (low + high))
        return found

    @wp.func
    def cells_about(size: dtype, low: vec3, high: vec3, level: int):
        """The first and last cells of a level that can contain the centres of boxes that meet a box."""
        first = wp.vec3i()
        last = wp.vec3i()
        if level < LEVELS:
            most = size * dtype(1 << level)
            edge = vec3(most, most, most)
            first = cell_of(most, low - edge)
            last = cell_of(most, high + edge)
        return first, last

    return box_of, level_of, cell_at, cells_about


@wp.func
def bucket_of(x: int, y: int, z: int, code: int, buckets: int):
    key = wp.uint32(x) + wp.uint32(y) * wp.uint32(73856093) + wp.uint32(z) * wp.uint32(19349663)
    return wp.int32((key + wp.uint32(code) * wp.uint32(83492791)) & wp.uint32(buckets - 1))


@cache
def count_items(dtype):
    """Kernel over items: counts of buckets, the bucket of each item or −1, and the levels that exist."""
    vec3, _ = types(dtype)
    box_of, level_of, cell_at, _about = boxes(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def count_each_item(
        # elements
        surface: surfaces(dtype),
        # state in
        x: wp.array(dtype=vec3),
        # in and out
        grid: grids(dtype),
    ):
        item = wp.tid()
        v = surface.items[item]
        low, high = box_of(surface, x[v[0]], x[v[1]], x[v[2]])
        level = level_of(grid.size, low, high)
        key = wp.int32(-1)
        if level >= 0:
            if (grid.levels[v[3] & 1] & (1 << level)) == 0:
                wp.atomic_or(grid.levels, v[3] & 1, 1 << level)
            cell = cell_at(grid.size, low, high, level)
            key = bucket_of(cell[0], cell[1], cell[2], v[3] * 32 + level, grid.counts.shape[0])
            wp.atomic_add(grid.counts, key, 1)
        grid.keys[item] = key

    return count_each_item


@cache
def fill_buckets(dtype):
    """Kernel over items: the entries of the buckets; counts ``counts`` down to 0."""
    vec3, _ = types(dtype)
    box_of, level_of, cell_at, _about = boxes(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def fill_each_bucket(
        # elements
        surface: surfaces(dtype),
        # state in
        x: wp.array(dtype=vec3),
        # in and out
        grid: grids(dtype),
    ):
        item = wp.tid()
        key = grid.keys[item]
        if key < 0:
            return
        v = surface.items[item]
        low, high = box_of(surface, x[v[0]], x[v[1]], x[v[2]])
        level = level_of(grid.size, low, high)
        cell = cell_at(grid.size, low, high, level)
        slot = grid.first[key] + wp.atomic_sub(grid.counts, key, 1) - 1
        grid.entries[slot] = wp.vec4i(item, cell[1], cell[2], v[3] * 32 + level)
        grid.lower[slot] = low
        grid.upper[slot] = high

    return fill_each_bucket


@cache
def cutoffs(dtype, of_edges: bool):
    """Device function (surface, stencil, first vertex of the copy) → contact distance of a pair [m].

    For two elements of one piece, it is at most half the rest distance.
    """
    closest = closest_points(dtype, of_edges)

    @wp.func
    def cutoff(surface: surfaces(dtype), s: wp.vec4i, first: int):
        found = surface.distance
        a = s[0] - first
        d = s[3] - first
        if surface.piece[a] == surface.piece[d]:
            if not (wp.length(surface.rest[a] - surface.rest[d]) > surface.far):
                _w, y = closest(surface.rest[a], surface.rest[s[1] - first], surface.rest[s[2] - first], surface.rest[d])
                found = wp.min(found, dtype(0.5) * wp.length(y))
        return found

    return cutoff


@cache
def find_pairs(dtype, of_edges: bool):
    """Kernel over vertices, or edges: pairs with triangles, or with edges, of the same level and those above.

    Of two edges of one level, only one finds the other, by the order of their cells along z, or of their indices.
    """
    vec3, _ = types(dtype)
    box_of, level_of, cell_at, cells_about = boxes(dtype)
    number, corner, four = load(wp.int32), load(vec3), load(wp.vec4i)
    closest, cutoff = closest_points(dtype, of_edges), cutoffs(dtype, of_edges)
    KIND = wp.constant(int(of_edges))

    # Separate modules: graphs on the CPU find kernels of a module by name, and both kinds have the same name.
    @wp.kernel(module=f"{MODULE}.{dtype.__name__}.{KIND}", enable_backward=False)
    def find_each_pair(
        # elements
        surface: surfaces(dtype),
        # state in
        x: wp.array(dtype=vec3),
        grid: grids(dtype),
        # parameters
        triangles: int,
        # out
        pairs: pair_lists(dtype),
    ):
        i = wp.tid()
        if wp.static(of_edges):
            own = surface.items[triangles + i]
            copy = own[3] >> 1
        else:
            copy = i // surface.vertices
            own = wp.vec4i(i, i, i, 0)
            if surface.piece[i - copy * surface.vertices] < 0:
                return
        a = x[own[0]]
        b = x[own[1]]
        low, high = box_of(surface, a, b, b)
        level = level_of(grid.size, low, high)
        if level < 0:
            return
        lowest = level
        layer = cell_at(grid.size, low, high, level)[2]
        buckets = grid.counts.shape[0]
        radius = surface.distance + surface.skin
        present = grid.levels[KIND] >> level
        while present != 0:
            if (present & 1) != 0:
                code = (2 * copy + KIND) * 32 + level
                one, two = cells_about(grid.size, low, high, level)
                if wp.static(of_edges):
                    if level == lowest:
                        one[2] = layer
                width = two[0] - one[0] + 1
                for cz in range(one[2], two[2] + 1):
                    for cy in range(one[1], two[1] + 1):
                        run = bucket_of(one[0], cy, cz, code, buckets)
                        begin = number(grid.first, run)
                        end = number(grid.first, wp.min(run + width, buckets))
                        # A sequence beyond the last bucket continues at the first.
                        for at in range(begin, end + number(grid.first, wp.max(run + width - buckets, 0))):
                            slot = wp.where(at < end, at, at - end)
                            l = corner(grid.lower, slot)
                            u = corner(grid.upper, slot)
                            if (
                                l[0] > high[0]
                                or u[0] < low[0]
                                or l[1] > high[1]
                                or u[1] < low[1]
                                or l[2] > high[2]
                                or u[2] < low[2]
                            ):
                                continue
                            entry = four(grid.entries, slot)
                            other = four(surface.items, entry[0])
                            if other[0] == own[0] or other[1] == own[0] or other[0] == own[1] or other[1] == own[1]:
                                continue
                            s = wp.vec4i(own[0], own[1], other[0], other[1])
                            k = entry[0] - triangles
                            if wp.static(of_edges):
                                if level == lowest and cz == layer and k <= i:
                                    continue
                            elif other[2] == own[0]:
                                continue
                            else:
                                s = wp.vec4i(own[0], other[0], other[1], other[2])
                            if entry[1] != cy or entry[2] != cz or entry[3] != code:
                                continue
                            _w, y = closest(corner(x, s[0]), corner(x, s[1]), corner(x, s[2]), corner(x, s[3]))
                            d = wp.length(y)
                            if d < radius:
                                if d < surface.skin or d < surface.skin + cutoff(surface, s, copy * surface.vertices):
                                    if pairs.counts[KIND] >= MOST:
                                        return
                                    slot = wp.atomic_add(pairs.counts, KIND, 1)
                                    row = i
                                    if wp.static(of_edges):
                                        slot += pairs.counts[0]
                                        row = wp.min(i, k) + x.shape[0]
                                        k = wp.max(i, k)
                                    if slot < pairs.found.shape[0]:
                                        wp.atomic_add(pairs.row_counts, row, 1)
                                        pairs.found[slot] = wp.vec2i(row, k + triangles)
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


@wp.func
def kept(counts: wp.array(dtype=wp.int32), capacity: int):
    """The number of pairs within the capacity."""
    return wp.min(wp.min(counts[0], capacity) + counts[1], capacity)


@cache
def fill_rows(dtype):
    """Kernel over the capacity: the items of each row; counts ``row_counts`` down to 0."""

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def fill_each_row(
        # in and out
        pairs: pair_lists(dtype),
    ):
        capacity = pairs.found.shape[0]
        k = capacity - 1 - wp.tid()
        if k < kept(pairs.counts, capacity):
            row = pairs.found[k][0]
            slot = pairs.first[row] + wp.atomic_sub(pairs.row_counts, row, 1) - 1
            pairs.items[slot] = pairs.found[k][1]

    return fill_each_row


@cache
def write_pairs(dtype):
    """Kernel over rows: their sorted pairs, with the contact distance of each."""
    vertex_cutoff, edge_cutoff = (cutoffs(dtype, each) for each in (False, True))

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def write_each_pair(
        # elements
        surface: surfaces(dtype),
        # parameters
        vertices: int,
        triangles: int,
        # out
        pairs: pair_lists(dtype),
    ):
        row = wp.tid()
        first = pairs.first[row]
        end = pairs.first[row + 1]
        if first == end:
            return
        sort(pairs.items, first, end)
        for k in range(first, end):
            v = surface.items[pairs.items[k]]
            vertex = (v[3] >> 1) * surface.vertices
            if row < vertices:
                s = wp.vec4i(row, v[0], v[1], v[2])
                d = vertex_cutoff(surface, s, vertex)
            else:
                own = surface.items[row - vertices + triangles]
                s = wp.vec4i(own[0], own[1], v[0], v[1])
                d = edge_cutoff(surface, s, vertex)
            pairs.stencils[k] = s
            pairs.distances[k] = d

    return write_each_pair


@cache
def pieces(dtype):
    """Struct of the connected pieces of all copies: the piece of each vertex, or −1, and the middle vertex of each piece.

    If a copy has more than one piece (``per_copy``), each also has a box, and the largest motion of its vertices relative to
    the middle vertex [m].
    """
    vec3, _ = types(dtype)

    @wp.struct
    class Pieces:
        piece: wp.array(dtype=wp.int32)
        centre: wp.array(dtype=wp.int32)
        per_copy: wp.int32
        lower: wp.array(dtype=vec3)
        upper: wp.array(dtype=vec3)
        motion: wp.array(dtype=dtype)

    return Pieces


@cache
def begin_boxes(dtype):
    """Kernel over pieces: sets the box to the middle vertex."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def begin_each_box(
        # state in
        x: wp.array(dtype=vec3),
        # in and out
        pieces: pieces(dtype),
    ):
        p = wp.tid()
        pieces.lower[p] = x[pieces.centre[p]]
        pieces.upper[p] = x[pieces.centre[p]]

    return begin_each_box


@cache
def extend_boxes(dtype):
    """Kernel over vertices: extends the boxes of their pieces."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def extend_each_box(
        # state in
        x: wp.array(dtype=vec3),
        # in and out
        pieces: pieces(dtype),
    ):
        i = wp.tid()
        p = pieces.piece[i]
        if p >= 0:
            if wp.max(wp.max(pieces.lower[p] - x[i], x[i] - pieces.upper[p])) > dtype(0.0):  # few are
                wp.atomic_min(pieces.lower, p, x[i])
                wp.atomic_max(pieces.upper, p, x[i])

    return extend_each_box


@wp.func
def note_moved(active: wp.array(dtype=wp.int32), copy: int, moved: wp.array(dtype=wp.int32), some: wp.array(dtype=wp.int32)):
    found = wp.bool(True)
    if active:
        found = active[copy] != 0
    if found:
        moved[copy] = 1
        some[0] = 1


@cache
def take_moved(dtype):
    """Kernel over vertices: out = x in copies that have ``moved``."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def take_each_moved(
        # state in
        x: wp.array(dtype=vec3),
        moved: wp.array(dtype=wp.int32),
        # parameters
        per_copy: int,
        # out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if moved[i // per_copy] != 0:
            out[i] = x[i]

    return take_each_moved


@cache
def find_motion(dtype):
    """Kernel over vertices: finds copies in which a vertex has moved by more than ``most`` since ``found``.

    The motion is relative to the middle vertex of the piece. moved = 1 for such copies, among the ``active`` ones if given;
    some = 1 if there is one; stale = 1 if the pairs were not listed at ``found``.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def find_each_motion(
        # state in
        x: wp.array(dtype=vec3),
        found: wp.array(dtype=vec3),
        listed: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
        most: dtype,
        # in and out
        pieces: pieces(dtype),
        # out
        moved: wp.array(dtype=wp.int32),
        some: wp.array(dtype=wp.int32),
        stale: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        if not (wp.length_sq(found[i] - listed[i]) <= dtype(0.0)):
            stale[0] = 1
        p = pieces.piece[i]
        if p >= 0:
            c = pieces.centre[p]
            own = wp.length((x[i] - found[i]) - (x[c] - found[c]))
            if not (own <= most):
                note_moved(active, p // pieces.per_copy, moved, some)
            if pieces.per_copy > 1:
                if own > pieces.motion[p]:
                    wp.atomic_max(pieces.motion, p, own)

    return find_each_motion


@cache
def compare_motions(dtype):
    """Kernel over pieces: moved and some as in :func:`find_motion`, if the piece and a later one of its copy may be too near.

    That is, if their approach may exceed ``most`` plus the excess of the distance of their boxes over ``radius``, up to which
    pairs are listed.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def compare_each_motion(
        # state in
        x: wp.array(dtype=vec3),
        found: wp.array(dtype=vec3),
        pieces: pieces(dtype),
        # parameters
        active: wp.array(dtype=wp.int32),
        radius: dtype,
        most: dtype,
        # out
        moved: wp.array(dtype=wp.int32),
        some: wp.array(dtype=wp.int32),
    ):
        p = wp.tid()
        c = pieces.centre[p]
        for q in range(p + 1, (p // pieces.per_copy + 1) * pieces.per_copy):
            a = pieces.centre[q]
            nearer = wp.length((x[a] - found[a]) - (x[c] - found[c])) + pieces.motion[p] + pieces.motion[q]
            gap = wp.max(pieces.lower[p] - pieces.upper[q], pieces.lower[q] - pieces.upper[p])
            gap = wp.max(gap, vec3())
            if not (nearer <= most + wp.max(wp.length(gap) - radius, dtype(0.0))):
                note_moved(active, p // pieces.per_copy, moved, some)

    return compare_each_motion
