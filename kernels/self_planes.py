"""Factories of the kernels that find how much of its move each vertex may make, by a plane between both sides of each pair."""

from functools import cache

import warp as wp

from .self_gaps import ONE, SIDE, ZERO, nearest, vertex_of
from .self_pairs import module_of, near_pairs
from .vectors import types

# The share of its way to a plane that a vertex may go in one round of the filter.
KEPT = wp.constant(wp.float64(0.9))
CLAMPED = wp.constant(wp.float64(0.05))  # the least share of the gap that lies between either side and the plane
# A pair needs no plane if its sides approach by less than this share of its gap. It is below 0.9²: y separates nine tenths of
# the gap at least, and of these KEPT may be closed.
WIDE = wp.constant(wp.float64(0.75))
ULP = wp.constant(wp.float64(1.1920929e-07))  # of float32, over the number, at most


@cache
def wanted_move(dtype):
    """The device function (x, target, direction, i) → the wanted move of vertex i: its direction, or to its target if None."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.func
    def wanted(x: wp.array(dtype=vec3), target: wp.array(dtype=vec3), direction: wp.array(dtype=vec3), i: int):
        found = wp.vec3d()
        if direction:
            found = exact(direction[i])
        else:
            found = exact(target[i]) - exact(x[i])
        return found

    return wanted


@cache
def common_move(dtype):
    """Kernel over copies: the mean of the moves of all vertices that are wanted [m]."""
    vec3, _ = types(dtype)
    wanted = wanted_move(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def find_common_move(
        # state in
        x: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        # out
        common: wp.array(dtype=wp.vec3d),
    ):
        copy = wp.tid()
        total = wp.vec3d()
        for i in range(copy * per_copy, (copy + 1) * per_copy):
            total += wanted(x, target, direction, i)
        common[copy] = total / wp.float64(per_copy)

    return find_common_move


@cache
def find_ways(dtype):
    """Kernel over vertices: a bound on how much each brings a pair nearer [m], its largest coordinate [m], and a share of 1.

    The bound adds up two lengths: that of the wanted move less the ``common`` move, and WIDE times that of the motion since
    ``begun``, where the gaps were found, less the motion of the first vertex of the copy.
    """
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    wanted = wanted_move(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def find_each_way(
        # state in
        x: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        common: wp.array(dtype=wp.vec3d),
        begun: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        # out
        ways: wp.array(dtype=wp.vec2d),
        share: wp.array(dtype=wp.float64),
        least_share: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        start = exact(x[i])
        move = wanted(x, target, direction, i)
        far = wp.max(wp.max(wp.abs(start)), wp.max(wp.abs(start + move)))
        one = i - i % per_copy
        since = start - exact(begun[i]) - (exact(x[one]) - exact(begun[one]))
        ways[i] = wp.vec2d(wp.length(move - common[i // per_copy]) + WIDE * wp.length(since), far)
        share[i] = ONE
        least_share[i] = ZERO

    return find_each_way


@wp.func
def margin_of(least: wp.float64, far: wp.float64):
    """Half the distance that two sides keep, where no coordinate is above ``far``.

    So 4 units in the last place of float32 remain between the sides; frames are stored in float32.
    """
    ulp = ULP * far
    return SIDE * wp.max(least, wp.float64(4.0) * ulp) + ulp


@cache
def cut_by_planes(dtype):
    """Kernel over pairs: lowers the ``share`` of its wanted move from x that each vertex may make.

    A plane normal to y lies between the two sides, and divides their gap, less the distance that they keep, in the ratio of
    their approaches; each side has at least CLAMPED of it. The ``common`` move of all vertices of a copy does not count as an
    approach. A pair that is ``open`` gets no plane, nor does one whose ``gap`` is so wide that no plane would cut the moves
    that :func:`find_ways` bounds.

    A vertex that is as near to a plane as it may be, and does not approach it, moves by the ``least_share`` or more, or not at
    all: the roundings of shorter moves, which are alike in many steps, would take it nearer.
    """
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    wanted = wanted_move(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def cut_by_each_plane(
        # elements
        pairs: near_pairs(dtype),
        gap: wp.array(dtype=wp.float64),
        open: wp.array(dtype=wp.int32),
        # state in
        x: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        common: wp.array(dtype=wp.vec3d),
        ways: wp.array(dtype=wp.vec2d),
        # parameters
        per_copy: int,
        least: wp.float64,
        # in and out
        share: wp.array(dtype=wp.float64),
        least_share: wp.array(dtype=wp.float64),
    ):
        e = wp.tid()
        if e >= pairs.counts[0] + pairs.counts[1]:
            return
        s = pairs.stencils[e]
        of_vertex = e < pairs.counts[0]
        sides = wp.where(of_vertex, 1, 2)
        way = wp.vec2d()
        far = ZERO
        for i in range(4):
            each = ways[s[i]]
            far = wp.max(far, each[1])
            if i < sides:
                way[0] = wp.max(way[0], each[0])
            else:
                way[1] = wp.max(way[1], each[0])
        margin = margin_of(least, far)
        if gap:
            # However the gap is divided, approaches that add up to so much or less are not cut.
            if way[0] + way[1] <= WIDE * gap[e] - KEPT / CLAMPED * margin:
                return
        if open:
            if open[e] != 0:
                return
        origin = exact(x[s[0]])
        _w, y, _inside = nearest(of_vertex, origin, exact(x[s[1]]), exact(x[s[2]]), exact(x[s[3]]))
        n = y / wp.max(wp.length(y), wp.float64(1e-300))
        lowest = wp.float64(wp.inf)
        highest = -wp.float64(wp.inf)
        first = ZERO
        second = ZERO
        position = wp.vec4d()
        approaches = wp.vec4d()
        for i in range(4):
            move = wanted(x, target, direction, s[i])
            approach = wp.dot(n, move - common[s[i] // per_copy])
            along = wp.dot(n, exact(x[s[i]]) - origin)
            position[i] = along
            if i < sides:
                approaches[i] = -approach
                lowest = wp.min(lowest, along)
                first = wp.max(first, -approach)
            else:
                approaches[i] = approach
                highest = wp.max(highest, along)
                second = wp.max(second, approach)
        part = SIDE
        if first + second > ZERO:
            part = wp.clamp(second / (first + second), CLAMPED, ONE - CLAMPED)
        if lowest - highest < KEPT * wp.length(y):  # by rounding y does not separate the sides, which then stay
            for i in range(4):
                wp.atomic_min(share, s[i], ZERO)
            return
        between = wp.max(lowest - highest - wp.float64(2.0) * margin, ZERO)
        for i in range(4):
            room = highest - position[i] + part * between
            if i < sides:
                room = position[i] - lowest + (ONE - part) * between
            if approaches[i] > ZERO:
                t = KEPT * room / approaches[i]
                if t < share[s[i]]:
                    wp.atomic_min(share, s[i], t)
            elif room <= ZERO:
                wp.atomic_max(least_share, s[i], ULP * far / wp.max(-approaches[i], wp.float64(1e-300)))

    return cut_by_each_plane
