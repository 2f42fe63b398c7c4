"""Factories of the kernels of friction in self-contact: U = Σ kA H(‖u‖), u = (I − nnᵀ)(Σ wᵢxᵢ − a), a = Σ wᵢxᵢⁿ − ξ.

H is that of :mod:`..coulomb`, with ε = μN/(kA): a spring with the stiffness of contact and a force of at most μN. Contacts, w,
n, kA and N = −kAφ′ times their share are those at the start of the step, at the positions xⁿ. ξ is the elongation of the spring
there. A step updates it, ξ ← u, and the next one shortens it to at most ε. So a sticking pair does not creep, and the spring of
a sliding pair slides along.

ξ is stored relative to the edge between the last two vertices of a pair, so that it rotates with the cloth. A new pair starts
with the mean ξ of the touching pairs between the same parts, which have a common vertex with it on each side.
"""

from functools import cache, partial

import warp as wp

from ..coulomb import Law
from ..terms import contact
from ..vectors import types
from .obstacles import Layout, copy_of, in_copy
from .pair_potential import TWO_EDGES, Contacts
from .pair_sums import PairForces, PairRow, PairTerm
from .self_gaps import ONE, ZERO, perpendicular, vertex_of
from .self_pairs import near_pairs


@wp.struct
class RubbedPairs:
    """Values of contacts at the start of the step: n, w, kA [N/m], ε [m], the anchor a [m], and the vertices on the first side.

    t is the direction of the edge of the last two vertices in the plane normal to n. ``parts`` are the vertices of the surface,
    and ``travel`` the part of y that obstacles add by the end of the step, of which forces see the fraction ``ahead``.
    """

    normal: wp.array(dtype=wp.vec3d)
    weights: wp.array(dtype=wp.vec4d)
    stiffness: wp.array(dtype=wp.float64)
    limit: wp.array(dtype=wp.float64)
    sides: wp.array(dtype=wp.int32)
    anchor: wp.array(dtype=wp.vec3d)
    tangent: wp.array(dtype=wp.vec3d)
    parts: wp.array(dtype=wp.vec4i)
    travel: wp.array(dtype=wp.vec3d)
    ahead: wp.float64


MODULE = "warpcloth.self_friction"


def friction_module(dtype, law=None):
    """Returns the name of the module of kernels, of those for a law if that is given."""
    return ".".join([MODULE, *([law.name] if law else []), dtype.__name__])


@wp.func
def edge_tangent(edge: wp.vec3d, n: wp.vec3d):
    """Direction of an edge in the plane normal to n; 0 for an edge along n."""
    t = edge - wp.dot(n, edge) * n
    return t / wp.max(wp.length(t), wp.float64(1e-300))


@wp.func
def equal(s: wp.vec4i, q: wp.vec4i):
    return s[0] == q[0] and s[1] == q[1] and s[2] == q[2] and s[3] == q[3]


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
        if has(q, s[i], q_first, q_last):
            found = True
    return found


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
        t = wp.tid()
        if t >= touching.number[0]:
            return
        e = touching.acting[t]
        k = contacts.share[e] * contacts.stiffness[e]
        if not (k > ZERO and contacts.gap[e] < contacts.distance[e]):
            return
        own = wp.int32(0)
        for i in range(4):
            if contacts.parts[e][i] >= touching.layout.cloth:
                own = 1 + in_copy(touching.layout, contacts.parts[e][i]) - touching.layout.per_copy
        limit = limit_of(-slope(contacts.gap[e], contacts.distance[e]), friction[own])
        if limit == ZERO:
            return
        s = touching.stencils[e]
        rubbed.parts[e] = contacts.parts[e]
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
    """Kernel over acting pairs at the start of a step: a and t; ξ is from ``kept`` of the last step, if there are ``steps``."""
    vec3, _ = types(dtype)
    (_at, exact), y_of, kept_of = vertex_of(dtype), difference_of(dtype), law.kept

    @wp.kernel(module=friction_module(dtype, law), enable_backward=False)
    def set_anchor_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        x: wp.array(dtype=vec3),
        kept: near_pairs(dtype),
        slips: wp.array(dtype=wp.vec4d),
        steps: wp.array(dtype=wp.int32),
        # in and out
        rubbed: RubbedPairs,
    ):
        turn = wp.tid()
        if turn >= pairs.number[0]:
            return
        e = pairs.acting[turn]
        limit = rubbed.limit[e]
        s = rubbed.parts[e]
        n = rubbed.normal[e]
        sides = rubbed.sides[e]
        total = wp.vec3d()
        weight = ZERO
        own = wp.bool(False)
        side = wp.where(s[0] < pairs.layout.cloth, 0, sides)
        end = wp.where(s[0] < pairs.layout.cloth, sides, 4)
        if steps[copy_of(pairs.layout, s[0])] == 0:
            end = side
        while side < end:
            side += 1
            for j in range(kept.first[s[side - 1]], kept.first[s[side - 1] + 1]):
                e_kept = kept.corners[j] // 4
                kept_slip = slips[e_kept]
                if kept_slip[2] > ZERO and not own:
                    q = kept.stencils[e_kept]
                    kept_sides = wp.int32(kept_slip[3])
                    # Some of the other pairs have their sides in the opposite order.
                    way = ZERO
                    if meet(s, 0, sides, q, 0, kept_sides) and meet(s, sides, 4, q, kept_sides, 4):
                        way = ONE
                    elif meet(s, 0, sides, q, kept_sides, 4) and meet(s, sides, 4, q, 0, kept_sides):
                        way = -ONE
                    if way != ZERO:
                        m = way * n
                        t = edge_tangent(exact(x[q[3]]) - exact(x[q[2]]), m)
                        stretch = way * (kept_slip[0] * t + kept_slip[1] * wp.cross(m, t))
                        if kept_sides == sides and equal(s, q):
                            own = True
                            total = stretch
                        else:
                            weight += kept_slip[2]
                            total += kept_slip[2] * stretch
        if not own and weight > ZERO:
            total = total / weight
        total = kept_of(wp.length(total), limit) * total
        rubbed.anchor[e] = y_of(pairs.layout, pairs.stencils[e], rubbed.weights[e], x) - total
        rubbed.tangent[e] = edge_tangent(exact(x[s[3]]) - exact(x[s[2]]), n)

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
        turn = wp.tid()
        if turn >= pairs.number[0]:
            return
        e = pairs.acting[turn]
        limit = rubbed.limit[e]
        forces.bend[e] = wp.vec2d()
        if limit == ZERO:
            return
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
        if forces.pressing:
            forces.pressing[wp.atomic_add(forces.count, 0, 1)] = e

    return find_friction_of_pairs


@cache
def end_friction(dtype):
    """Kernel over acting pairs at the end x of a step: values for the next step.

    These are the components of ξ along t and n × t, kA, and the number of vertices on the first side.
    """
    vec3, _ = types(dtype)
    y_of = difference_of(dtype)

    @wp.kernel(module=friction_module(dtype), enable_backward=False)
    def end_friction_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        rubbed: RubbedPairs,
        x: wp.array(dtype=vec3),
        # out
        slips: wp.array(dtype=wp.vec4d),
    ):
        turn = wp.tid()
        if turn >= pairs.number[0]:
            return
        e = pairs.acting[turn]
        u = slip_from(pairs.layout, rubbed, e, y_of(pairs.layout, pairs.stencils[e], rubbed.weights[e], x), ONE)
        t = rubbed.tangent[e]
        slips[e] = wp.vec4d(
            wp.dot(u, t), wp.dot(u, wp.cross(rubbed.normal[e], t)), rubbed.stiffness[e], wp.float64(rubbed.sides[e])
        )

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
    """The ``row`` of friction: C = (u·t, u·(n × t)). Those of a sliding pair are of a softer spring with the same force."""
    vec3, _ = types(dtype)
    slip_of, secant = slip_at(dtype), law.secant

    @wp.func
    def row_of(pairs: near_pairs(dtype), rubbed: RubbedPairs, e: int, x: wp.array(dtype=vec3), d: wp.array(dtype=vec3)):
        found = PairRow()
        if rubbed.limit[e] > ZERO:
            u = slip_of(pairs, rubbed, e, x, d)
            found.weights = rubbed.weights[e]
            found.first = rubbed.tangent[e]
            found.second = wp.cross(rubbed.normal[e], rubbed.tangent[e])
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
