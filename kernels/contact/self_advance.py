"""The fraction of a direction along which a pair of self-contact keeps a gap: continuous collision detection."""

from functools import cache

import warp as wp

from ..memory import load
from ..pairs import Pairs
from ..vectors import types
from .local_motion import differences
from .obstacles import copy_of, has_obstacle, vector_within
from .proximity_grid import boxes, boxes_meet, surfaces
from .self_gaps import CORNERS, ONE, ZERO, corners, nearest
from .self_pairs import module_of
from .self_planes import KEPT, WIDE, margin_of, needs_no_cut, part_apart, ulp_of


@cache
def advances(dtype):
    """Struct of the moves ``direction`` [m], the ``fraction`` that each copy may make (B,), and the ``least`` gap [m].

    The direction is that of the cloth (N,), or of all vertices of the surface. ``far`` is 1 for copies that move so far that
    pairs may meet which are not in the list (B,). Of cloth the list has all pairs that may meet while their sides move by at
    most ``alike`` relative to one another, from the positions ``found`` of the list to the end of the direction [m].
    """
    vec3, _ = types(dtype)

    @wp.struct
    class Advance:
        direction: wp.array(dtype=vec3)
        fraction: wp.array(dtype=wp.float64)
        far: wp.array(dtype=wp.int32)
        least: wp.float64
        alike: dtype
        found: wp.array(dtype=vec3)

    return Advance


@cache
def allowed_fraction(dtype):
    """Device function (of_vertex, stencil, x, advance) → the fraction of its moves that a pair may make.

    A pair keeps a tenth of its gap. Where all vertices move by the same fraction, a plane between the sides may move with them:
    they stay apart along y while no vertex of one side comes near the height of one of the other. Where this allows less than
    the direction, as for cloth that slides over an edge, :func:`.self_planes.part_apart` may allow more.
    """
    vec3, _ = types(dtype)
    ulp, vector_or_zero, advance = ulp_of(dtype), vector_within(dtype), advances(dtype)

    @wp.func
    def allowed(of_vertex: bool, s: wp.vec4i, x: wp.array(dtype=vec3), out: advance):
        points = corners(x, s)
        moves = CORNERS()
        far = ZERO
        way = ZERO
        for i in range(4):
            moves[i] = wp.vec3d(vector_or_zero(out.direction, s[i]))
            way = wp.max(way, wp.length(moves[i]))
            if s[i] < out.direction.shape[0]:  # obstacles that stand are not rounded
                far = wp.max(far, wp.max(wp.abs(points[i])))
        far += way
        margin = wp.float64(2.0) * margin_of(out.least, ulp * far)
        _w, y = nearest(of_vertex, points)
        distance = wp.length(y)
        n = y / wp.max(distance, wp.float64(1e-300))
        floor = (ONE - KEPT) * wp.max(distance - margin, ZERO) + wp.min(distance, margin)
        t = ONE
        sides = wp.where(of_vertex, 1, 2)
        for p in range(sides):
            for q in range(sides, 4):
                approach = wp.dot(n, moves[q] - moves[p])
                if approach > ZERO:
                    apart = wp.dot(n, points[p] - points[q]) - floor
                    t = wp.min(t, wp.max(apart, ZERO) / approach)
        if t < ONE:
            t = wp.max(t, part_apart(of_vertex, points, moves, floor))
        return t

    return allowed


@cache
def take_advance(dtype, of_edges: bool):
    """The function of :func:`.proximity.search_pairs` that reduces the ``fraction`` of copies that move ``far``; its struct.

    It leaves out pairs that the list has, and those whose boxes stay apart while they move relative to one another.
    """
    vec3, _ = types(dtype)
    advance, allowed, of_vertex = advances(dtype), allowed_fraction(dtype), wp.constant(not of_edges)
    (box_at, *_), (relative_box, _all_calm) = boxes(dtype), differences(dtype)
    vector, vector_or_zero = load(vec3), vector_within(dtype)

    @wp.func
    def is_listed(x: wp.array(dtype=vec3), s: wp.vec4i, out: advance):
        way = dtype(0.0)
        sides = wp.where(of_vertex, 1, 2)
        for p in range(sides):
            own = vector(x, s[p]) + vector_or_zero(out.direction, s[p]) - vector(out.found, s[p])
            for q in range(sides, 4):
                other = vector(x, s[q]) + vector_or_zero(out.direction, s[q]) - vector(out.found, s[q])
                way = wp.max(way, wp.length(own - other))
        return way <= out.alike

    @wp.func
    def stay_apart(surface: surfaces(dtype), x: wp.array(dtype=vec3), s: wp.vec4i, out: advance):
        j = wp.where(of_vertex, 0, 1)
        k = wp.where(of_vertex, 1, 2)
        a = vector_or_zero(out.direction, s[0])
        b = vector_or_zero(out.direction, s[j])
        low, high, _radius = box_at(surface, x, s[0], s[j], s[j])
        l, h, _radius = box_at(surface, x, s[k], s[wp.where(of_vertex, 2, 3)], s[3])
        c = vector_or_zero(out.direction, s[k])
        d = vector_or_zero(out.direction, s[2])
        e = vector_or_zero(out.direction, s[3])
        m = wp.min(wp.min(c, d), e)
        n = wp.max(wp.max(c, d), e)
        low, high = relative_box(low, high, wp.min(a, b), wp.max(a, b), m, n, dtype(2.0))
        return not boxes_meet(low, high, l, h)

    @wp.func
    def take(surface: surfaces(dtype), x: wp.array(dtype=vec3), s: wp.vec4i, i: int, k: int, triangles: int, out: advance):
        copy = copy_of(surface.layout, s[0])
        if out.far[copy] == 0:
            return
        if stay_apart(surface, x, s, out):
            return
        if not has_obstacle(surface.layout, s):
            if is_listed(x, s, out):
                return
        t = allowed(of_vertex, s, x, out)
        if t < ONE:
            wp.atomic_min(out.fraction, copy, t)

    return take, advance


@cache
def advance_listed(dtype):
    """Kernel over listed pairs: reduces the ``fraction`` of copies.

    Pairs whose ``gap`` at ``begun`` is too wide for the moves of their sides relative to one another are left out.
    """
    vec3, _ = types(dtype)
    allowed, stencil, vertex, ulp = allowed_fraction(dtype), load(wp.vec4i), load(vec3), ulp_of(dtype)
    vector_or_zero, four = vector_within(dtype), wp.types.matrix((4, 3), dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def advance_each_pair(
        # elements
        pairs: Pairs,
        gap: wp.array(dtype=wp.float64),
        # state in
        begun: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        # in and out
        out: advances(dtype),
    ):
        e = wp.tid()
        if e >= wp.min(pairs.counts[0] + pairs.counts[1], pairs.stencils.shape[0]):
            return
        s = stencil(pairs.stencils, e)
        moves = four()
        since = four()
        far = dtype(0.0)
        for i in range(4):
            at = vertex(x, s[i])
            moves[i] = vector_or_zero(out.direction, s[i])
            since[i] = at - vertex(begun, s[i])
            far = wp.max(far, wp.max(wp.abs(at)) + wp.length(moves[i]))
        way = dtype(0.0)
        sides = wp.where(e < pairs.counts[0], 1, 2)
        for p in range(sides):
            for q in range(sides, 4):
                way = wp.max(way, wp.length(moves[q] - moves[p]) + dtype(WIDE) * wp.length(since[q] - since[p]))
        if needs_no_cut(e, wp.float64(way), margin_of(out.least, ulp * wp.float64(far)), gap):
            return
        copy = copy_of(pairs.layout, s[0])
        t = allowed(e < pairs.counts[0], s, x, out)
        if t < ONE:
            wp.atomic_min(out.fraction, copy, t)

    return advance_each_pair
