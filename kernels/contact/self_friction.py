"""Factories of the kernels of friction in self-contact: U = Σ kA H(‖u‖), u = (I − nnᵀ)(Σ wᵢxᵢ − a), a = Σ wᵢxᵢⁿ − ξ.

H is that of :mod:`..coulomb`, with ε = μN/(kA). Contacts, w, n, kA and N = −kAφ′ times their share are those at the start xⁿ of
the step. A step updates the elongation ξ of the spring, ξ ← u, and the next one shortens it to at most ε: a sticking pair does
not creep, and the spring of a sliding pair slides along. A pair takes the ξ of the contact between the same vertices, those of
nonzero w, in the last step; without one, the mean of those that the vertex had with a part of the same face, or else of those
with a common vertex on each side.

At the end of a step ξ rotates with the cloth or the mesh, and u is without what turns the gap d: R of :func:`turn_of` moves one
side by d(Rn − n) relative to the other. That of meshes is known, so u is without it in the whole step.
"""

from functools import cache
from typing import Any

import warp as wp

from ..coulomb import Law
from ..pairs import Layout, Pairs
from ..rotation import nearest_rotation
from ..term import PairTerm
from ..terms import contact
from ..vectors import types
from .obstacles import copy_of, in_copy, obstacle_of
from .pair_potential import TWO_EDGES, Contacts
from .pair_sums import PairForces, PairRow, note_pressing
from .self_gaps import ONE, ZERO, perpendicular
from .self_pairs import take_slot


@wp.struct
class RubbedPairs:
    """Values of contacts at the start of the step: n, w, kA [N/m], ε [m], the anchor a [m], and the vertices on the first side.

    ``parts`` are vertices of the surface, −1 where w is 0. ``travel`` is what obstacles add to y in the step; forces see the
    fraction ``ahead`` of it.
    """

    normal: wp.array(dtype=wp.vec3d)
    weights: wp.array(dtype=wp.vec4d)
    stiffness: wp.array(dtype=wp.float64)
    limit: wp.array(dtype=wp.float64)
    sides: wp.array(dtype=wp.int32)
    anchor: wp.array(dtype=wp.vec3d)
    parts: wp.array(dtype=wp.vec4i)
    travel: wp.array(dtype=wp.vec3d)
    ahead: wp.float64


# ξ [m], kA [N/m], and the number of vertices on the first side, of a contact that the next step takes over.
SLIP = wp.types.vector(5, wp.float64)
MODULE = "warpcloth.self_friction"


def friction_module(dtype, law=None):
    """Returns the name of the module of kernels, of those for a law if that is given."""
    return ".".join([MODULE, *([law.name] if law else []), dtype.__name__])


@wp.func
def has(s: wp.vec4i, vertex: int, first: int, last: int):
    found = wp.bool(False)
    for i in range(first, last):
        found = found or s[i] == vertex
    return found


@wp.func
def meet(s: wp.vec4i, s_first: int, s_last: int, q: wp.vec4i, q_first: int, q_last: int):
    """Whether two sides, given by their ranges of corners, have a common vertex."""
    found = wp.bool(False)
    for i in range(s_first, s_last):
        found = found or (s[i] >= 0 and has(q, s[i], q_first, q_last))
    return found


@wp.func
def same_vertices(s: wp.vec4i, q: wp.vec4i, sides: int):
    """Whether two contacts are between the same vertices on each side, in any order."""
    found = wp.bool(True)
    for i in range(4):
        first = wp.where(i < sides, 0, sides)
        last = wp.where(i < sides, sides, 4)
        found = found and (s[i] < 0 or has(q, s[i], first, last)) and (q[i] < 0 or has(s, q[i], first, last))
    return found


@wp.struct
class Rings:
    """The ``vertices`` first[i] to first[i + 1] share a triangle with vertex i, all numbered as in a copy."""

    first: wp.array(dtype=wp.int32)
    vertices: wp.array(dtype=wp.int32)


POINTS, VECTORS = wp.array(dtype=Any), wp.array(dtype=wp.vec3d)


@wp.func
def turn_of_edge(layout: Layout, i: int, j: int, start: POINTS, moves: VECTORS, x: POINTS):
    before = wp.vec3d(start[j]) - wp.vec3d(start[i])
    after = before
    if i < layout.cloth:
        after = wp.vec3d(x[j]) - wp.vec3d(x[i])
    else:
        after += moves[j - layout.cloth] - moves[i - layout.cloth]
    return wp.outer(after, before), wp.dot(before, before)


@wp.func
def turn_of(layout: Layout, rings: Rings, s: wp.vec4i, w: wp.vec4d, sides: int, start: POINTS, moves: VECTORS, x: POINTS):
    """The rotation R of a contact from ``start`` to x.

    It fits the edges at its vertices s (−1: none) best, each with |w| (Kabsch 1976): of a mesh by the ``moves`` of its
    vertices, else of the cloth. Vertices without a triangle have the edges of the contact.
    """
    of_mesh = obstacle_of(layout, s) >= 0
    A = wp.mat33d()
    if of_mesh and not moves:
        return wp.identity(n=3, dtype=wp.float64)
    for i in range(4):
        if s[i] < 0 or (of_mesh and s[i] < layout.cloth):
            continue
        own = wp.mat33d()
        size = ZERO
        v = in_copy(layout, s[i])
        for k in range(rings.first[v], rings.first[v + 1]):
            one, square = turn_of_edge(layout, s[i], s[i] + rings.vertices[k] - v, start, moves, x)
            own += one
            size += square
        for j in range(4):
            if rings.first[v] == rings.first[v + 1] and s[j] >= 0 and (i < sides) == (j < sides):
                one, square = turn_of_edge(layout, s[i], s[j], start, moves, x)
                own += one
                size += square
        if size > ZERO:
            A += wp.where(of_mesh, ONE, wp.abs(w[i])) / size * own
    return nearest_rotation(A)


@wp.func
def difference(layout: Layout, s: wp.vec4i, w: wp.vec4d, x: wp.array(dtype=Any)):
    """Σ wᵢxᵢ over the cloth, without obstacles relative to the first vertex."""
    y = wp.vec3d()
    for i in range(1, 4):
        y += w[i] * (wp.vec3d(x[s[i]]) - wp.vec3d(x[s[0]]))
    if layout.obstacles > 0:
        y += (w[0] + w[1] + w[2] + w[3]) * wp.vec3d(x[s[0]])
    return y


@wp.func
def slip_from(layout: Layout, rubbed: RubbedPairs, e: int, y: wp.vec3d, ahead: wp.float64):
    """Returns u of a pair, after the fraction ``ahead`` of the step."""
    u = y - rubbed.anchor[e]
    if layout.obstacles > 0:
        u += ahead * rubbed.travel[e]
    return u - wp.dot(rubbed.normal[e], u) * rubbed.normal[e]


@wp.func
def slip_at(pairs: Pairs, rubbed: RubbedPairs, e: int, x: wp.array(dtype=Any), d: wp.array(dtype=Any)):
    """u at x, or at x + d."""
    s = pairs.stencils[e]
    y = difference(pairs.layout, s, rubbed.weights[e], x)
    if d:
        y += difference(pairs.layout, s, rubbed.weights[e], d)
    return slip_from(pairs.layout, rubbed, e, y, rubbed.ahead)


@cache
def begin_friction(dtype, law: Law, bounded: bool):
    """Kernel over contacts at the start of a step: w, n, kA and ε of those with a force and friction, for which there is room.

    ``friction`` has μ of cloth with cloth, then that of each obstacle of a copy.
    """
    vec3, _ = types(dtype)
    slope, limit_of = contact.bounded_slope if bounded else contact.slope, law.limit

    @wp.kernel(module=f"{friction_module(dtype, law)}.{bounded}", enable_backward=False)
    def begin_friction_of_pairs(
        # elements
        touching: Pairs,
        # state in
        contacts: Contacts,
        x: wp.array(dtype=vec3),
        moves: wp.array(dtype=wp.vec3d),
        # parameters
        rings: Rings,
        friction: wp.array(dtype=wp.float64),
        # out
        pairs: Pairs,
        rubbed: RubbedPairs,
    ):
        for e in range(wp.tid(), touching.number[0], touching.threads):
            k = contacts.share[e] * contacts.stiffness[e]
            if not (k > ZERO and contacts.gap[e] < contacts.distance[e]):
                continue
            parts = contacts.parts[e]
            own = 1 + obstacle_of(touching.layout, parts)
            limit = limit_of(-slope(contacts.gap[e], contacts.distance[e]), friction[own])
            if limit == ZERO:
                continue
            for i in range(4):
                if (contacts.touching[e] & (1 << i)) == 0:
                    parts[i] = -1
            slot = take_slot(pairs, touching.keys[e], touching.stencils[e])
            rubbed.parts[slot] = parts
            rubbed.limit[slot] = limit
            n = contacts.normal[e]
            w = contacts.weights[e]
            sides = wp.where(contacts.code[e] == TWO_EDGES, 2, 1)
            if touching.layout.obstacles > 0:
                rubbed.travel[slot] = contacts.travel[e]
                if own > 0 and moves:
                    R = turn_of(touching.layout, rings, parts, w, sides, x, moves, x)
                    rubbed.travel[slot] -= contacts.gap[e] * (R * n - n)
            rubbed.normal[slot] = n
            rubbed.weights[slot] = w
            rubbed.stiffness[slot] = k
            rubbed.sides[slot] = sides

    return begin_friction_of_pairs


@cache
def set_anchors(dtype, law: Law):
    """Kernel over pairs at the start of a step: a; ξ is from ``kept`` of the last step, if there are ``steps``."""
    vec3, _ = types(dtype)
    kept_of = law.kept

    @wp.kernel(module=friction_module(dtype, law), enable_backward=False)
    def set_anchor_of_pairs(
        # elements
        pairs: Pairs,
        # state in
        x: wp.array(dtype=vec3),
        kept: Pairs,
        slips: wp.array(dtype=SLIP),
        steps: wp.array(dtype=wp.int32),
        # in and out
        rubbed: RubbedPairs,
    ):
        for e in range(wp.tid(), pairs.number[0], pairs.threads):
            s = rubbed.parts[e]
            n = rubbed.normal[e]
            sides = rubbed.sides[e]
            total = wp.vec3d()
            weight = ZERO
            best = wp.int32(0)
            for i in range(4):
                v = s[i]
                if v < 0 or v >= pairs.layout.cloth:
                    continue
                end = kept.first[v + 1]
                if steps[copy_of(pairs.layout, v)] == 0:
                    end = 0
                for j in range(kept.first[v], end):
                    code = kept.corners[j]
                    slip = slips[code // 4]
                    q = kept.stencils[code // 4]
                    if slip[3] > ZERO and q[code % 4] == v:
                        kept_sides = wp.int32(slip[4])
                        # Some of the other pairs have their sides in the opposite order.
                        way = ZERO
                        if meet(s, 0, sides, q, 0, kept_sides) and meet(s, sides, 4, q, kept_sides, 4):
                            way = ONE
                        elif meet(s, 0, sides, q, kept_sides, 4) and meet(s, sides, 4, q, 0, kept_sides):
                            way = -ONE
                        rank = wp.int32(0)
                        if way != ZERO:
                            rank = 1
                            if sides == 2 and way < ZERO:
                                q = wp.vec4i(q[2], q[3], q[0], q[1])
                            if sides == kept_sides and (sides == 2 or way > ZERO) and same_vertices(s, q, sides):
                                rank = 3
                            elif sides == 1 and kept_sides == 1 and s[0] == q[0]:
                                rank = 2
                        if rank > best:
                            best = rank
                            weight = ZERO
                            total = wp.vec3d()
                        if rank > 0 and rank == best:
                            weight += slip[3]
                            total += slip[3] * way * wp.vec3d(slip[0], slip[1], slip[2])
            if weight > ZERO:
                total = total / weight
            total -= wp.dot(n, total) * n
            total = kept_of(wp.length(total), rubbed.limit[e]) * total
            rubbed.anchor[e] = difference(pairs.layout, pairs.stencils[e], rubbed.weights[e], x) - total

    return set_anchor_of_pairs


@cache
def find_friction(dtype, law: Law):
    """Kernel over pairs: the forces at x, or x + correction."""
    vec3, _ = types(dtype)
    energy, secant, bend = law.energy, law.secant, law.bend

    @wp.kernel(module=friction_module(dtype, law), enable_backward=False)
    def find_friction_of_pairs(
        # elements
        pairs: Pairs,
        # state in
        rubbed: RubbedPairs,
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        # out
        forces: PairForces,
    ):
        for e in range(wp.tid(), pairs.number[0], pairs.threads):
            limit = rubbed.limit[e]
            n = rubbed.normal[e]
            w = rubbed.weights[e]
            k = rubbed.stiffness[e]
            u = slip_at(pairs, rubbed, e, x, correction)
            l = wp.length(u)
            pull = k * secant(l, limit)
            along = perpendicular(n)
            if l > ZERO:
                along = u / l
            across = wp.cross(n, along)
            forces.weights[e] = w
            forces.energy[e] = k * energy(l, limit)
            forces.force[e] = pull * u
            forces.definite[e] = k * bend(l, limit) * wp.outer(along, along) + pull * wp.outer(across, across)
            note_pressing(forces, e, pairs.stencils[e])

    return find_friction_of_pairs


@cache
def end_friction(dtype):
    """Kernel over pairs at the end x of a step: pairs ``kept`` for the next step, all but ``first``, and their ξ."""
    vec3, _ = types(dtype)

    @wp.kernel(module=friction_module(dtype), enable_backward=False)
    def end_friction_of_pairs(
        # elements
        pairs: Pairs,
        # state in
        rubbed: RubbedPairs,
        start: wp.array(dtype=vec3),
        moves: wp.array(dtype=wp.vec3d),
        x: wp.array(dtype=vec3),
        # parameters
        rings: Rings,
        # out
        kept: Pairs,
        slips: wp.array(dtype=SLIP),
    ):
        for e in range(wp.tid(), pairs.number[0], pairs.threads):
            parts = rubbed.parts[e]
            kept.stencils[e] = parts
            for i in range(4 * e, 4 * e + 4):
                kept.corners[i] = pairs.corners[i]
            s = pairs.stencils[e]
            sides = rubbed.sides[e]
            w = rubbed.weights[e]
            R = turn_of(pairs.layout, rings, parts, w, sides, start, moves, x)
            y = difference(pairs.layout, s, w, x)
            if obstacle_of(pairs.layout, parts) < 0:
                before = difference(pairs.layout, s, w, start)
                y -= R * before - before
            u = R * slip_from(pairs.layout, rubbed, e, y, ONE)
            slips[e] = SLIP(u[0], u[1], u[2], rubbed.stiffness[e], wp.float64(sides))

    return end_friction_of_pairs


@cache
def near_friction(dtype):
    """The ``near`` of friction, with v = u."""
    vec3, _ = types(dtype)
    points = wp.array(dtype=vec3)

    @wp.func
    def near_of(pairs: Pairs, rubbed: RubbedPairs, e: int, x: points, correction: points, always: bool):
        return True, slip_at(pairs, rubbed, e, x, correction), rubbed.normal[e], rubbed.weights[e]

    return near_of


@cache
def push_friction(law: Law):
    """The ``push`` of friction by the prox of the law."""
    prox = law.prox

    @wp.func
    def push_of(
        rubbed: RubbedPairs, e: int, u: wp.vec3d, n: wp.vec3d, D: wp.float64, least: wp.float64, h: wp.float64, hard: bool
    ):
        l = wp.length(u)
        if D > ZERO and l > ZERO:
            return -prox(l, rubbed.limit[e], D * rubbed.stiffness[e] * h * h) / D * u
        return wp.vec3d()

    return push_of


@cache
def row_of_friction(law: Law):
    """The ``row`` of friction: C = (u·t, u·(n × t)), t normal to n. A sliding pair has a softer spring with the same force."""
    secant = law.secant

    @wp.func
    def row_of(pairs: Pairs, rubbed: RubbedPairs, e: int, x: wp.array(dtype=Any), d: wp.array(dtype=Any)):
        found = PairRow()
        u = slip_at(pairs, rubbed, e, x, d)
        found.weights = rubbed.weights[e]
        found.first = perpendicular(rubbed.normal[e])
        found.second = wp.cross(rubbed.normal[e], found.first)
        found.C = wp.vec2d(wp.dot(u, found.first), wp.dot(u, found.second))
        found.size = wp.length(u)
        found.stiffness = rubbed.stiffness[e] * secant(found.size, rubbed.limit[e])
        return found

    return row_of


@cache
def friction_of_pairs(law: Law):
    """Returns the :class:`..term.PairTerm` of friction by a law."""
    push, row = push_friction(law), row_of_friction(law)
    return PairTerm("self-friction", f"{MODULE}.{law.name}", 2, RubbedPairs, near_friction, push, row, isotropic=True)
