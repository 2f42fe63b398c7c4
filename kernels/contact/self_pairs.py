"""Factories of the kernels that compute, at the start of a step, the gaps and areas of the pairs of self-contact.

A pair acts if its area A is positive. A stays constant in the step.
"""

from functools import cache

import warp as wp

from ..memory import load
from ..vectors import types
from .proximity import sort
from .self_gaps import ONE, SIDE, ZERO, nearest, vertex_of

# Triangles with a common vertex share the area of a vertex near them. The part of a triangle falls linearly to 0 at a gap that
# exceeds the smallest one by SHARING·r.
SHARING = wp.constant(wp.float64(0.25))
# So many directions must stop at the vertices of pairs of edges before these have their whole area. One does not: the first
# directions of a step may be far from the solution, and the areas would then not be those of other solvers.
STOPPED = wp.constant(2)
# The area of two edges decreases if sin² of their angle is below this, to 0 for parallel edges.
PARALLEL = wp.constant(wp.float64(1e-3))


@cache
def near_pairs(dtype):
    """Returns the struct of near pairs, see :class:`warpcloth.contact.proximity.Proximity`.

    ``counts`` has the numbers of vertex–triangle pairs, which come first, and of edge–edge pairs. The triangles near vertex i
    are in rows ``rows`` [i] to rows[i+1]. Contact of a pair begins at its distance in ``distances`` [m].

    ``acting`` lists the pairs with an area in the step; ``number`` has their number. On the CPU they are in order. ``corners``
    lists 4·pair + corner of the acting pairs at vertex i, from ``first`` [i] to first[i+1], sorted. ``corner_counts`` is
    scratch, 0 between launches. The last three are empty if no kernel sums over vertices.
    """

    @wp.struct
    class Pairs:
        stencils: wp.array(dtype=wp.vec4i)
        counts: wp.array(dtype=wp.int32)
        rows: wp.array(dtype=wp.int32)
        acting: wp.array(dtype=wp.int32)
        number: wp.array(dtype=wp.int32)
        corner_counts: wp.array(dtype=wp.int32)
        first: wp.array(dtype=wp.int32)
        corners: wp.array(dtype=wp.int32)
        distances: wp.array(dtype=dtype)

    return Pairs


@wp.struct
class StepPairs:
    """Normal n, gap d [m], weights w and stiffness kA [N/m] of each pair at the start of a step.

    ``nearest`` is the vertex–triangle pair of each vertex with the smallest gap, or −1. Gauss–Seidel sweeps have the
    ``clearance`` of acting pairs, see :func:`.self_contact.find_clearances`.
    """

    normal: wp.array(dtype=wp.vec3d)
    gap: wp.array(dtype=wp.float64)
    weights: wp.array(dtype=wp.vec4d)
    stiffness: wp.array(dtype=wp.float64)
    nearest: wp.array(dtype=wp.int32)
    clearance: wp.array(dtype=wp.float64)


MODULE = "warpcloth.self_contact"


def module_of(dtype):
    """Returns the name of the module of the kernels that every scene with self-contact launches.

    Warp compiles a module as a whole, and again if other kernels are in it. So kernels that only some scenes launch are in
    modules of their own.
    """
    return f"{MODULE}.{dtype.__name__}"


@cache
def begin_pairs(dtype):
    """Kernel over pairs: n, d and w at the positions x at the start of a step."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def begin_each_pair(
        # elements
        pairs: near_pairs(dtype),
        # state in
        x: wp.array(dtype=vec3),
        # out
        step: StepPairs,
    ):
        e = wp.tid()
        if e >= pairs.counts[0] + pairs.counts[1]:
            return
        s = pairs.stencils[e]
        w, y, _inside = nearest(e < pairs.counts[0], exact(x[s[0]]), exact(x[s[1]]), exact(x[s[2]]), exact(x[s[3]]))
        d = wp.length(y)
        step.gap[e] = d
        step.weights[e] = w
        step.normal[e] = y / wp.max(d, wp.float64(1e-300))

    return begin_each_pair


@wp.func
def share_a_vertex(a: wp.vec4i, b: wp.vec4i):
    """Whether the triangles of two pairs share a vertex."""
    found = wp.bool(False)
    for i in range(1, 4):
        for j in range(1, 4):
            if a[i] == b[j]:
                found = True
    return found


@wp.func
def part_of_area(gap: wp.float64, least: wp.float64, r: wp.float64):
    return wp.max(ONE - (gap - least) / (SHARING * r), ZERO)


@cache
def find_nearest(dtype):
    """Kernel over vertices: the nearest of the vertex–triangle pairs of a vertex, −1 if no gap is finite."""
    value = load(wp.float64)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def find_each_nearest(
        # elements
        pairs: near_pairs(dtype),
        # in and out
        step: StepPairs,
    ):
        i = wp.tid()
        found = wp.int32(-1)
        least = wp.float64(wp.inf)
        for e in range(pairs.rows[i], pairs.rows[i + 1]):
            if value(step.gap, e) < least:
                least = value(step.gap, e)
                found = e
        step.nearest[i] = found

    return find_each_nearest


@cache
def set_areas(dtype):
    """Kernel over pairs, at the start of a step: kA, and the list of acting pairs.

    A vertex gives half of its area to the triangles on each side of it. Triangles with a common vertex share this half if they
    are about equally near. The area of a pair of edges is (A₁ + … + A₄)/12 if the pair is nearer by SHARING·r than the
    vertex–triangle pairs of its vertices on the same side; it falls linearly to 0 where they are as near. It is smaller if the
    edges are nearly parallel. So crossed folds are in contact too, and the areas of all pairs of two flat layers in contact sum
    to the area of one layer.
    """
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    number, value, normal_at, stencil = load(wp.int32), load(wp.float64), load(wp.vec3d), load(wp.vec4i)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def set_each_area(
        # elements
        pairs: near_pairs(dtype),
        areas: wp.array(dtype=wp.float64),
        # state in
        x: wp.array(dtype=vec3),
        stopped: wp.array(dtype=wp.int32),
        # parameters
        stiffness: wp.float64,
        # in and out
        step: StepPairs,
    ):
        e = wp.tid()
        triangles = pairs.counts[0]
        if e >= triangles + pairs.counts[1]:
            return
        s = stencil(pairs.stencils, e)
        r = wp.float64(pairs.distances[e])
        n = normal_at(step.normal, e)
        gap = value(step.gap, e)
        area = ZERO
        if e < triangles:
            first = number(pairs.rows, s[0])
            end = number(pairs.rows, s[0] + 1)
            least = gap
            near = number(step.nearest, s[0])
            found = near == e
            if near >= 0 and not found:  # mostly it is the least of those that share a vertex
                if share_a_vertex(s, stencil(pairs.stencils, near)) and wp.dot(n, normal_at(step.normal, near)) > ZERO:
                    least = value(step.gap, near)
                    found = True
            if not found:
                for other in range(first, end):
                    if value(step.gap, other) < least:
                        if (
                            share_a_vertex(s, stencil(pairs.stencils, other))
                            and wp.dot(n, normal_at(step.normal, other)) > ZERO
                        ):
                            least = value(step.gap, other)
            own = part_of_area(gap, least, r)
            if own > ZERO:
                total = ZERO
                for other in range(first, end):
                    part = part_of_area(value(step.gap, other), least, r)
                    if part > ZERO:
                        if (
                            share_a_vertex(s, stencil(pairs.stencils, other))
                            and wp.dot(n, normal_at(step.normal, other)) > ZERO
                        ):
                            total += part
                area = SIDE * areas[s[0]] * own / total
        else:
            nearer = ONE
            corner = wp.int32(0)
            while corner < 4 and nearer > ZERO:  # most pairs of edges are as near as one of their vertices
                near = number(step.nearest, s[corner])
                if near >= 0:
                    sign = wp.where(corner < 2, ONE, -ONE)
                    if value(step.gap, near) <= gap and sign * wp.dot(n, normal_at(step.normal, near)) > SIDE:
                        nearer = ZERO
                corner += 1
            if nearer > ZERO:
                least = wp.float64(wp.inf)
                for i in range(4):
                    sign = wp.where(i < 2, ONE, -ONE)
                    for other in range(number(pairs.rows, s[i]), number(pairs.rows, s[i] + 1)):
                        if value(step.gap, other) < least and sign * wp.dot(n, normal_at(step.normal, other)) > SIDE:
                            least = value(step.gap, other)
                if least < wp.float64(wp.inf):
                    nearer = wp.clamp((least - gap) / (SHARING * r), ZERO, ONE)
            if stopped:
                if wp.min(wp.min(stopped[s[0]], stopped[s[1]]), wp.min(stopped[s[2]], stopped[s[3]])) == STOPPED:
                    nearer = ONE
            if nearer > ZERO:
                ab = exact(x[s[1]]) - exact(x[s[0]])
                cd = exact(x[s[3]]) - exact(x[s[2]])
                normal = wp.cross(ab, cd)
                z = wp.min(wp.dot(normal, normal) / (PARALLEL * wp.dot(ab, ab) * wp.dot(cd, cd)), ONE)
                total = areas[s[0]] + areas[s[1]] + areas[s[2]] + areas[s[3]]
                area = nearer * z * (wp.float64(2.0) - z) * total / wp.float64(12.0)
        step.stiffness[e] = stiffness * area
        if area > ZERO:
            pairs.acting[wp.atomic_add(pairs.number, 0, 1)] = e
            if pairs.corner_counts:
                for i in range(4):
                    wp.atomic_add(pairs.corner_counts, s[i], 1)

    return set_each_area


@cache
def fill_corners(dtype):
    """Kernel over pairs: lists the corners of acting pairs at each vertex, and counts ``corner_counts`` down to 0."""

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def fill_each_corner(
        # in and out
        pairs: near_pairs(dtype),
    ):
        t = pairs.number[0] - 1 - wp.tid()
        if t >= 0:
            e = pairs.acting[t]
            s = pairs.stencils[e]
            for i in range(4):
                pairs.corners[pairs.first[s[i]] + wp.atomic_sub(pairs.corner_counts, s[i], 1) - 1] = 4 * e + i

    return fill_each_corner


@cache
def sort_corners(dtype):
    """Kernel over vertices: sorts the corners of each vertex."""

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def sort_each(
        # in and out
        pairs: near_pairs(dtype),
    ):
        i = wp.tid()
        sort(pairs.corners, pairs.first[i], pairs.first[i + 1])

    return sort_each


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def note_list(
    # state in
    counts: wp.array(dtype=wp.int32),
    # parameters
    made: int,
    # in and out
    most: wp.array(dtype=wp.int32),
    lists: wp.array(dtype=wp.int32),
    # out
    listed: wp.array(dtype=wp.int32),
):
    """Kernel over copies: the most pairs in any list, the number of lists, to which it adds ``made``, and ``listed``."""
    c = wp.tid()
    if c == 0:
        listed[0] = wp.min(counts[0] + counts[1], 1)
    most[c] = wp.max(most[c], counts[0] + counts[1])
    lists[c] = lists[c] + made
