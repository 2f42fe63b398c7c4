"""Factories of the kernels that limit the moves of vertices, by a plane between the two sides of each pair."""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from ..memory import load
from ..pairs import Pairs
from ..vectors import types
from .obstacles import copy_of
from .self_gaps import CORNERS, ONE, SIDE, ZERO, corners, nearest
from .self_pairs import module_of

KEPT = wp.constant(wp.float64(0.9))  # fraction of its distance to a plane that a vertex may move in one round of the filter
CLAMPED = wp.constant(wp.float64(0.05))  # smallest distance of each side from the plane, as a fraction of the gap
# A pair needs no plane if its sides approach by less than this fraction of the gap. It is below 0.9²: along y the sides are at
# least 0.9 of the gap apart, and the fraction KEPT of this may be closed.
WIDE = wp.constant(wp.float64(0.75))
# The advances of a pair along a direction end after this number, or when no more than NEAR of the way to its floor is left.
ADVANCES = wp.constant(64)
NEAR = wp.constant(wp.float64(0.05))
ROUNDED = wp.constant(wp.float64(1e-9))  # by which a gap may be below its floor, over the floor, because of rounding


@cache
def ulp_of(dtype):
    """The largest relative unit in the last place of a scalar type, as a constant of kernels in double precision."""
    return wp.constant(wp.float64(np.finfo(wp.dtype_to_numpy(dtype)).eps))


@wp.func
def bounded_share(move: wp.vec3d, most: wp.float64):
    """Returns min(1, most/‖move‖), the fraction of a move that is at most ``most`` long."""
    size = wp.length(move)
    return wp.where(size > most, most / size, ONE)


@wp.func
def wanted(x: wp.array(dtype=Any), target: wp.array(dtype=Any), i: int):
    """The wanted move of vertex i, target − x; 0 for obstacles, which have no target."""
    if i < target.shape[0]:
        return wp.vec3d(target[i]) - wp.vec3d(x[i])
    return wp.vec3d()


@cache
def common_move(dtype):
    """Kernel over copies: the mean of the wanted moves of all vertices [m]."""
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def find_common_move(
        # state in
        x: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        # out
        common: wp.array(dtype=wp.vec3d),
    ):
        copy = wp.tid()
        total = wp.vec3d()
        for i in range(copy * per_copy, (copy + 1) * per_copy):
            total += wanted(x, target, i)
        common[copy] = total / wp.float64(per_copy)

    return find_common_move


@cache
def find_ways(dtype):
    """Kernel over vertices: ``share`` with which the wanted move minus the ``common`` move is at most ``most``, and ``ways``.

    The ways are a bound of what it adds to the approach of a pair [m], its largest coordinate [m], and its share. The bound is
    the length of that move plus WIDE times that of the motion since ``begun``, where gaps were computed, ``relative`` to the
    first vertex of the copy where cloth meets nothing but itself. Obstacles have not moved since.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def find_each_way(
        # state in
        x: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        common: wp.array(dtype=wp.vec3d),
        begun: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        most: wp.float64,
        relative: bool,
        # out
        ways: wp.array(dtype=wp.vec3d),
        share: wp.array(dtype=wp.float64),
        least_share: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        start = wp.vec3d(x[i])
        move = wanted(x, target, i)
        own = move - common[i // per_copy]
        far = wp.max(wp.max(wp.abs(start)), wp.max(wp.abs(start + move)))
        since = start - wp.vec3d(begun[i])
        if relative:
            one = i - i % per_copy
            since -= wp.vec3d(x[one]) - wp.vec3d(begun[one])
        share[i] = bounded_share(own, most)
        ways[i] = wp.vec3d(wp.length(own) + WIDE * wp.length(since), far, share[i])
        least_share[i] = ZERO

    return find_each_way


@wp.func
def margin_of(least: wp.float64, ulp: wp.float64):
    """Half the smallest distance of two sides whose largest coordinate has the unit ``ulp`` in the last place."""
    return SIDE * wp.max(least, wp.float64(4.0) * ulp) + ulp


_value, _way_of = load(wp.float64), load(wp.vec3d)


@wp.func
def ways_of_sides(ways: wp.array(dtype=wp.vec3d), s: wp.vec4i, sides: int):
    """The largest way of each side of a pair, whose first side has ``sides`` vertices, and its largest coordinate."""
    way = wp.vec2d()
    far = ZERO
    for i in range(4):
        each = _way_of(ways, s[i])
        far = wp.max(far, each[1])
        if i < sides:
            way[0] = wp.max(way[0], each[0])
        else:
            way[1] = wp.max(way[1], each[0])
    return way, far


@wp.func
def needs_no_cut(e: int, way: wp.float64, margin: wp.float64, gap: wp.array(dtype=wp.float64)):
    """Whether the ``gap`` of pair e is too wide, however it is divided, for an approach by ``way`` to be shortened."""
    return way <= WIDE * _value(gap, e) - KEPT / CLAMPED * margin


@wp.func
def moved_apart(
    u: wp.vec3d, v: wp.vec3d, w: wp.vec3d, du: wp.vec3d, dv: wp.vec3d, dw: wp.vec3d, floor: wp.float64, most: wp.float64
):
    """A fraction up to ``most`` of the moves du, dv and dw for which |w·(u × v)| surely exceeds ``floor`` times |u × v|.

    The quotient is the distance of two lines along u and v that are w apart, or of a point from a plane. KEPT of the excess of
    the volume, a cubic polynomial, may be used up.
    """
    n = wp.cross(u, v)
    turn = wp.cross(du, v) + wp.cross(u, dv)
    bend = wp.cross(du, dv)
    volume = wp.dot(w, n)
    side = wp.where(volume < ZERO, -ONE, ONE)
    room = KEPT * (side * volume - floor * wp.length(n))
    if room > -ROUNDED * floor * wp.length(n):
        room = wp.max(room, ZERO)
    a = side * (wp.dot(dw, n) + wp.dot(w, turn)) - floor * wp.length(turn)
    b = wp.max(-side * (wp.dot(dw, turn) + wp.dot(w, bend)), ZERO) + floor * wp.length(bend)
    b += most * wp.max(-side * wp.dot(dw, bend), ZERO)
    found = ZERO
    if room >= ZERO:
        found = most
        if room + (a - b * most) * most < ZERO:
            root = wp.sqrt(a * a + wp.float64(4.0) * b * room)
            if a > ZERO:
                found = wp.min(most, (root + a) / (b + b))
            elif room > ZERO:
                found = wp.min(most, (room + room) / (root - a))
            else:
                found = ZERO
    return found


@wp.func
def across(of_vertex: bool, x: CORNERS):
    """Vectors along two edges of a pair, and from a vertex of the first to one of the second, as of :func:`moved_apart`."""
    if of_vertex:
        return x[2] - x[1], x[3] - x[2], x[1] - x[0]
    return x[1] - x[0], x[3] - x[2], x[2] - x[0]


@wp.func
def part_apart(of_vertex: bool, x: CORNERS, moves: CORNERS, floor: wp.float64):
    """The fraction of its ``moves`` for which a pair at x surely stays farther apart than ``floor``.

    The pair advances until its gap could be closed at the relative speed of its sides, finds its gap there, and goes on (Li,
    Kaufman and Jiang 2021, additive continuous collision detection); or farther, by :func:`moved_apart`, where cloth slides.
    """
    mean = SIDE * SIDE * (moves[0] + moves[1] + moves[2] + moves[3])
    relative = wp.matrix_from_rows(moves[0] - mean, moves[1] - mean, moves[2] - mean, moves[3] - mean)
    first = wp.length(relative[0])
    second = wp.max(wp.length(relative[2]), wp.length(relative[3]))
    if of_vertex:
        second = wp.max(second, wp.length(relative[1]))
    else:
        first = wp.max(first, wp.length(relative[1]))
    advanced = ZERO
    _w, y = nearest(of_vertex, x)
    room = wp.length(y) - floor
    enough = NEAR * room
    if room > -ROUNDED * floor:
        du, dv, dw = across(of_vertex, moves)
        now = x
        for turn in range(ADVANCES):
            if room > enough or turn == 0:
                u, v, w = across(of_vertex, now)
                further = moved_apart(u, v, w, du, dv, dw, floor, ONE - advanced)
                further = wp.max(KEPT * wp.max(room, ZERO) / wp.max(first + second, wp.float64(1e-300)), further)
                advanced = wp.min(advanced + further, ONE)
                now = x + advanced * relative
                _w, y = nearest(of_vertex, now)
                room = wp.where(advanced < ONE, wp.length(y) - floor, ZERO)
    return advanced


@cache
def cut_by_planes(dtype):
    """Kernel over pairs: reduces the ``share`` of each vertex, the fraction of its wanted move from x that it may make.

    A pair cuts nothing while its sides stay apart, by a tenth of their gap or more, with the shares that its vertices had
    before: along y, where a plane may move with them, or by :func:`part_apart`. So cloth that falls or turns together moves
    freely. Else a plane normal to y divides their gap, minus the smallest distance, in the ratio of their approaches, not
    counting the ``common`` move of a copy; each side gets at least CLAMPED of it, and shares may fall further. Pairs whose
    ``gap`` is too wide for the moves that :func:`find_ways` bounds have no plane.

    A vertex at the smallest distance from a plane that it does not approach moves by at least ``least_share``, or not at all:
    roundings of shorter moves, which can be equal in many steps, would take it nearer.
    """
    vec3, _ = types(dtype)
    ulp, stencil = ulp_of(dtype), load(wp.vec4i)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def cut_by_each_plane(
        # elements
        pairs: Pairs,
        gap: wp.array(dtype=wp.float64),
        # state in
        x: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        common: wp.array(dtype=wp.vec3d),
        ways: wp.array(dtype=wp.vec3d),
        # parameters
        least: wp.float64,
        # in and out
        share: wp.array(dtype=wp.float64),
        least_share: wp.array(dtype=wp.float64),
    ):
        e = wp.tid()
        if e >= pairs.counts[0] + pairs.counts[1]:
            return
        s = stencil(pairs.stencils, e)
        own = common[copy_of(pairs.layout, s[0])]
        of_vertex = e < pairs.counts[0]
        sides = wp.where(of_vertex, 1, 2)
        way, far = ways_of_sides(ways, s, sides)
        margin = margin_of(least, ulp * far)
        if needs_no_cut(e, way[0] + way[1], margin, gap):
            return
        points = corners(x, s)
        _w, y = nearest(of_vertex, points)
        n = y / wp.max(wp.length(y), wp.float64(1e-300))
        lowest = wp.float64(wp.inf)
        highest = -wp.float64(wp.inf)
        lowest_end = wp.float64(wp.inf)
        highest_end = -wp.float64(wp.inf)
        first = ZERO
        second = ZERO
        position = wp.vec4d()
        approaches = wp.vec4d()
        for i in range(4):
            move = wanted(x, target, s[i])
            approach = wp.dot(n, move - own)
            along = wp.dot(n, points[i] - points[0])
            position[i] = along
            if i < sides:
                approaches[i] = -approach
                lowest = wp.min(lowest, along)
                lowest_end = wp.min(lowest_end, along + ways[s[i]][2] * approach)
                first = wp.max(first, -approach)
            else:
                approaches[i] = approach
                highest = wp.max(highest, along)
                highest_end = wp.max(highest_end, along + ways[s[i]][2] * approach)
                second = wp.max(second, approach)
        part = SIDE
        if first + second > ZERO:
            part = wp.clamp(second / (first + second), CLAMPED, ONE - CLAMPED)
        if lowest - highest < KEPT * wp.length(y):  # because of rounding y does not separate the sides, so they stay
            for i in range(4):
                wp.atomic_min(share, s[i], ZERO)
            return
        between = wp.max(lowest - highest - wp.float64(2.0) * margin, ZERO)
        floor = (ONE - KEPT) * between + wp.float64(2.0) * margin
        if lowest_end - highest_end >= floor:
            return
        moves = CORNERS()
        for i in range(4):
            moves[i] = ways[s[i]][2] * (wanted(x, target, s[i]) - own)
        if part_apart(of_vertex, points, moves, floor) == ONE:
            return
        for i in range(4):
            room = highest - position[i] + part * between
            if i < sides:
                room = position[i] - lowest + (ONE - part) * between
            if approaches[i] > ZERO:
                t = KEPT * room / approaches[i]
                if t < share[s[i]]:
                    wp.atomic_min(share, s[i], t)
            elif room <= ZERO:
                wp.atomic_max(least_share, s[i], ulp * far / wp.max(-approaches[i], wp.float64(1e-300)))

    return cut_by_each_plane


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def note_cuts(
    # state in
    share: wp.array(dtype=wp.float64),
    # in and out
    ways: wp.array(dtype=wp.vec3d),
    # out
    changed: wp.array(dtype=wp.int32),
):
    """Kernel over vertices: takes the share into ``ways``; changed = 1 if one has fallen."""
    i = wp.tid()
    way = ways[i]
    if share[i] < way[2]:
        ways[i] = wp.vec3d(way[0], way[1], share[i])
        changed[0] = 1
