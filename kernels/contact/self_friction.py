"""Factories of the kernels of friction in self-contact: U = Σ kA H(‖u‖), u = (I − nnᵀ)(Σ wᵢxᵢ − a), a = Σ wᵢxᵢⁿ − ξ.

H is that of :mod:`..coulomb`, with ε = μN/(kA): a spring with the stiffness of contact and a force of at most μN. Contacts, w,
n, kA and N = −kAφ′ times their share are those at the start of the step, at the positions xⁿ. ξ is the elongation of the spring
there. A step updates it, ξ ← u, and the next one shortens it to at most ε. So a sticking pair does not creep, and the spring of
a sliding pair slides along.

At the end of a step ξ turns about n with the edges of the pair, so that it rotates with the cloth about n. Where the cloth
turns n itself by an angle, a contact that sticks slips by that angle times its gap. A pair takes the ξ of the contact between
the same vertices, those of nonzero w, in the last step. Without one it takes the mean of those that the vertex had with a part
of the same face, or else the mean of the contacts with a common vertex on each side.
"""

from functools import cache, partial

import warp as wp

from ..coulomb import Law
from ..terms import contact
from ..vectors import types
from .obstacles import Layout, copy_of, in_copy
from .pair_potential import TWO_EDGES, Contacts
from .pair_sums import PairForces, PairRow, PairTerm, note_pressing
from .self_gaps import ONE, ZERO, perpendicular, vertex_of
from .self_pairs import near_pairs


@wp.struct
class RubbedPairs:
    """Values of contacts at the start of the step: n, w, kA [N/m], ε [m], the anchor a [m], and the vertices on the first side.

    ``parts`` are the vertices of the surface, −1 where w is 0. ``travel`` is the part of y that obstacles add by the end of the
    step, of which forces see the fraction ``ahead``.
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
        if s[i] == vertex:
            found = True
    return found


@wp.func
def meet(s: wp.vec4i, s_first: int, s_last: int, q: wp.vec4i, q_first: int, q_last: int):
    """Whether two sides, given by their ranges of corners, have a common vertex."""
    found = wp.bool(False)
    for i in range(s_first, s_last):
        if s[i] >= 0 and has(q, s[i], q_first, q_last):
            found = True
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


@wp.func
def joins(s: wp.vec4i, sides: int, i: int, j: int):
    """Whether corners i < j of a pair are on one side, which has an edge between them."""
    return (i < sides) == (j < sides)


@cache
def turned(dtype):
    """Device function (layout, s, t, sides, n, u, start, moves, x) → u of a pair turned about n by the edges of its sides.

    The turn from ``start`` to x is that which fits the edges best. ``moves`` are those of obstacles. s has −1 for vertices that
    do not touch. A contact of two vertices turns with the edges of all vertices t of its pair.
    """
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.func
    def turn(
        layout: Layout,
        s: wp.vec4i,
        t: wp.vec4i,
        sides: int,
        n: wp.vec3d,
        u: wp.vec3d,
        start: wp.array(dtype=vec3),
        moves: wp.array(dtype=wp.vec3d),
        x: wp.array(dtype=vec3),
    ):
        q = s
        some = wp.bool(False)
        for i in range(4):
            for j in range(i + 1, 4):
                some = some or (joins(s, sides, i, j) and wp.min(s[i], s[j]) >= 0)
        if not some:
            q = t
        cosine = ZERO
        sine = ZERO
        for i in range(4):
            for j in range(i + 1, 4):
                if joins(q, sides, i, j) and wp.min(q[i], q[j]) >= 0:
                    before = exact(start[q[j]]) - exact(start[q[i]])
                    after = before
                    if q[i] < layout.cloth and q[j] < layout.cloth:
                        after = exact(x[q[j]]) - exact(x[q[i]])
                    elif q[i] >= layout.cloth and q[j] >= layout.cloth:
                        after += moves[q[j] - layout.cloth] - moves[q[i] - layout.cloth]
                    before -= wp.dot(n, before) * n
                    cosine += wp.dot(before, after)
                    sine += wp.dot(n, wp.cross(before, after))
        size = wp.sqrt(cosine * cosine + sine * sine)
        found = u
        if size > ZERO:
            found = (cosine * u + sine * wp.cross(n, u)) / size
        return found

    return turn


@cache
def difference_of(dtype):
    """Device function (layout, stencil, w, x) → Σ wᵢxᵢ over the cloth, without obstacles relative to the first vertex."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.func
    def difference(layout: Layout, s: wp.vec4i, w: wp.vec4d, x: wp.array(dtype=vec3)):
        y = wp.vec3d()
        for i in range(1, 4):
            y += w[i] * (exact(x[s[i]]) - exact(x[s[0]]))
        if layout.obstacles > 0:
            y += (w[0] + w[1] + w[2] + w[3]) * exact(x[s[0]])
        return y

    return difference


@wp.func
def slip_from(layout: Layout, rubbed: RubbedPairs, e: int, y: wp.vec3d, ahead: wp.float64):
    """Returns u of a pair, after the fraction ``ahead`` of the step."""
    u = y - rubbed.anchor[e]
    if layout.obstacles > 0:
        u += ahead * rubbed.travel[e]
    return u - wp.dot(rubbed.normal[e], u) * rubbed.normal[e]


@cache
def slip_at(dtype):
    """Device function (pairs, rubbed, e, x, d) → u at x, or at x + d."""
    vec3, _ = types(dtype)
    y_of = difference_of(dtype)

    @wp.func
    def slip_of(pairs: near_pairs(dtype), rubbed: RubbedPairs, e: int, x: wp.array(dtype=vec3), d: wp.array(dtype=vec3)):
        s = pairs.stencils[e]
        y = y_of(pairs.layout, s, rubbed.weights[e], x)
        if d:
            y += y_of(pairs.layout, s, rubbed.weights[e], d)
        return slip_from(pairs.layout, rubbed, e, y, rubbed.ahead)

    return slip_of


@cache
def begin_friction(dtype, law: Law, bounded: bool):
    """Kernel over contacts at the start of a step: w, n, kA and ε of those with a force and friction, which act.

    μ is the first one of ``friction`` for cloth with cloth, and then that of each obstacle of a copy.
    """
    slope, limit_of = contact.bounded_slope if bounded else contact.slope, law.limit

    @wp.kernel(module=f"{friction_module(dtype, law)}.{bounded}", enable_backward=False)
    def begin_friction_of_pairs(
        # elements
        touching: near_pairs(dtype),
        # state in
        contacts: Contacts,
        # parameters
        friction: wp.array(dtype=wp.float64),
        # out
        pairs: near_pairs(dtype),
        rubbed: RubbedPairs,
    ):
        for t in range(wp.tid(), touching.number[0], touching.threads):
            e = touching.acting[t]
            k = contacts.share[e] * contacts.stiffness[e]
            if not (k > ZERO and contacts.gap[e] < contacts.distance[e]):
                continue
            own = wp.int32(0)
            for i in range(4):
                if contacts.parts[e][i] >= touching.layout.cloth:
                    own = 1 + in_copy(touching.layout, contacts.parts[e][i]) - touching.layout.per_copy
            limit = limit_of(-slope(contacts.gap[e], contacts.distance[e]), friction[own])
            if limit == ZERO:
                continue
            s = touching.stencils[e]
            parts = contacts.parts[e]
            for i in range(4):
                if (contacts.touching[e] & (1 << i)) == 0:
                    parts[i] = -1
            rubbed.parts[e] = parts
            pairs.stencils[e] = s
            rubbed.limit[e] = limit
            if touching.layout.obstacles > 0:
                rubbed.travel[e] = contacts.travel[e]
            rubbed.normal[e] = contacts.normal[e]
            rubbed.weights[e] = contacts.weights[e]
            rubbed.stiffness[e] = k
            rubbed.sides[e] = wp.where(contacts.code[e] == TWO_EDGES, 2, 1)
            pairs.acting[wp.atomic_add(pairs.number, 0, 1)] = e
            for i in range(4):
                wp.atomic_add(pairs.corner_counts, s[i], 1)

    return begin_friction_of_pairs


@cache
def set_anchors(dtype, law: Law):
    """Kernel over acting pairs at the start of a step: a; ξ is from ``kept`` of the last step, if there are ``steps``."""
    vec3, _ = types(dtype)
    y_of, kept_of = difference_of(dtype), law.kept

    @wp.kernel(module=friction_module(dtype, law), enable_backward=False)
    def set_anchor_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        x: wp.array(dtype=vec3),
        kept: near_pairs(dtype),
        slips: wp.array(dtype=SLIP),
        steps: wp.array(dtype=wp.int32),
        # in and out
        rubbed: RubbedPairs,
    ):
        for turn in range(wp.tid(), pairs.number[0], pairs.threads):
            e = pairs.acting[turn]
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
            rubbed.anchor[e] = y_of(pairs.layout, pairs.stencils[e], rubbed.weights[e], x) - total

    return set_anchor_of_pairs


@cache
def find_friction(dtype, law: Law):
    """Kernel over acting pairs: the forces at x, or x + correction."""
    vec3, _ = types(dtype)
    slip_of, energy, secant, bend = slip_at(dtype), law.energy, law.secant, law.bend

    @wp.kernel(module=friction_module(dtype, law), enable_backward=False)
    def find_friction_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        rubbed: RubbedPairs,
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        # out
        forces: PairForces,
    ):
        for turn in range(wp.tid(), pairs.number[0], pairs.threads):
            e = pairs.acting[turn]
            limit = rubbed.limit[e]
            forces.bend[e] = wp.vec2d()
            if limit == ZERO:
                continue
            n = rubbed.normal[e]
            w = rubbed.weights[e]
            k = rubbed.stiffness[e]
            u = slip_of(pairs, rubbed, e, x, correction)
            l = wp.length(u)
            across = k * secant(l, limit)
            along = perpendicular(n)
            if l > ZERO:
                along = u / l
            forces.weights[e] = w
            forces.energy[e] = k * energy(l, limit)
            forces.force[e] = across * u
            forces.bend[e] = wp.vec2d(k * bend(l, limit), across)
            forces.along[e] = along
            forces.across[e] = wp.cross(n, along)
            note_pressing(forces, e, pairs.stencils[e])

    return find_friction_of_pairs


@cache
def end_friction(dtype):
    """Kernel over acting pairs at the end x of a step: what the next step takes over.

    The pairs ``kept`` are those of the step, with the vertices of the surface, but for ``first``.
    """
    vec3, _ = types(dtype)
    y_of, turn_of = difference_of(dtype), turned(dtype)

    @wp.kernel(module=friction_module(dtype), enable_backward=False)
    def end_friction_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        rubbed: RubbedPairs,
        start: wp.array(dtype=vec3),
        moves: wp.array(dtype=wp.vec3d),
        x: wp.array(dtype=vec3),
        # out
        kept: near_pairs(dtype),
        slips: wp.array(dtype=SLIP),
    ):
        for turn in range(wp.tid(), pairs.number[0], pairs.threads):
            e = pairs.acting[turn]
            kept.stencils[e] = rubbed.parts[e]
            for i in range(4 * turn, 4 * turn + 4):
                kept.corners[i] = pairs.corners[i]
            s = pairs.stencils[e]
            sides = rubbed.sides[e]
            u = slip_from(pairs.layout, rubbed, e, y_of(pairs.layout, s, rubbed.weights[e], x), ONE)
            u = turn_of(pairs.layout, rubbed.parts[e], s, sides, rubbed.normal[e], u, start, moves, x)
            slips[e] = SLIP(u[0], u[1], u[2], rubbed.stiffness[e], wp.float64(sides))

    return end_friction_of_pairs


@cache
def near_friction(dtype):
    """The ``near`` of friction, with v = u."""
    vec3, _ = types(dtype)
    slip_of = slip_at(dtype)

    @wp.func
    def near_of(
        pairs: near_pairs(dtype),
        rubbed: RubbedPairs,
        e: int,
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        always: bool,
    ):
        u = wp.vec3d()
        rubs = rubbed.limit[e] > ZERO
        if rubs:
            u = slip_of(pairs, rubbed, e, x, correction)
        return rubs, u, rubbed.normal[e], rubbed.weights[e]

    return near_of


@cache
def push_friction(dtype, law: Law):
    """The ``push`` of friction by the prox of the law."""
    prox = law.prox

    @wp.func
    def push_of(
        pairs: near_pairs(dtype),
        rubbed: RubbedPairs,
        e: int,
        u: wp.vec3d,
        n: wp.vec3d,
        D: wp.float64,
        least: wp.float64,
        h: wp.float64,
        hard: bool,
    ):
        found = wp.vec3d()
        l = wp.length(u)
        if D > ZERO and l > ZERO:
            found = -prox(l, rubbed.limit[e], D * rubbed.stiffness[e] * h * h) / D * u
        return found

    return push_of


@cache
def row_of_friction(dtype, law: Law):
    """The ``row`` of friction: C = (u·t, u·(n × t)), t normal to n. A sliding pair has a softer spring with the same force."""
    vec3, _ = types(dtype)
    slip_of, secant = slip_at(dtype), law.secant

    @wp.func
    def row_of(pairs: near_pairs(dtype), rubbed: RubbedPairs, e: int, x: wp.array(dtype=vec3), d: wp.array(dtype=vec3)):
        found = PairRow()
        if rubbed.limit[e] > ZERO:
            u = slip_of(pairs, rubbed, e, x, d)
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
    """Returns the :class:`.pair_sums.PairTerm` of friction by a law."""
    push, row = (partial(make, law=law) for make in (push_friction, row_of_friction))
    return PairTerm("self-friction", f"{MODULE}.{law.name}", 2, RubbedPairs, near_friction, push, row, isotropic=True)
