"""Factories of the kernels of friction in self-contact: U = Σ kA H(‖u‖), u = (I − nnᵀ)(ξ + Σ wᵢ(xᵢ − xᵢⁿ)).

H is the Huber function of :mod:`..terms.friction` with ε = μN/(kA): a spring with the stiffness of contact and a force of at
most μN. Pairs, w, n, N and kA are those at the start of the step, at the positions xⁿ. ξ is the elongation of the spring there.
A step updates it, ξ ← (I − nnᵀ)(ξ + Σ wᵢ(xᵢ − xᵢⁿ)), and the next one shortens it to at most ε. So a sticking pair does not
creep, and the spring of a sliding pair slides along.

ξ is stored relative to the edge between the last two vertices of a pair, so that it rotates with the cloth. A new pair starts
with the mean ξ of the touching pairs between the same parts, which have a common vertex with it on each side.
"""

from functools import cache

import warp as wp

from ..terms import contact
from ..vectors import types
from .pair_sums import PairSource
from .self_gaps import ONE, SIDE, ZERO, vertex_of
from .self_pairs import StepPairs, near_pairs

slope = contact.slope


@wp.struct
class RubbedPairs:
    """Values of pairs at the start of the step: n, w, kA [N/m], μN [N] (0 without contact), ξ [m], and kA of contact [N/m]."""

    normal: wp.array(dtype=wp.vec3d)
    weights: wp.array(dtype=wp.vec4d)
    stiffness: wp.array(dtype=wp.float64)
    limit: wp.array(dtype=wp.float64)
    contact: wp.array(dtype=wp.float64)
    stretch: wp.array(dtype=wp.vec3d)


@wp.struct
class RubForces:
    """Values of pairs at given positions: kAH [J], ∂U/∂u [N], u/‖u‖, and the second derivatives along and across u [N/m].

    The first three are n, w and μN of :class:`RubbedPairs`.
    """

    normal: wp.array(dtype=wp.vec3d)
    weights: wp.array(dtype=wp.vec4d)
    acting: wp.array(dtype=wp.float64)
    energy: wp.array(dtype=wp.float64)
    pull: wp.array(dtype=wp.vec3d)
    direction: wp.array(dtype=wp.vec3d)
    along: wp.array(dtype=wp.float64)
    across: wp.array(dtype=wp.float64)


MODULE = "warpcloth.self_friction"


def friction_module(dtype):
    return f"{MODULE}.{dtype.__name__}"


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
def begin_friction(dtype, bounded: bool):
    """Kernel over pairs at the start of a step: w, n, kA and μN, and which are acting, that is, have an area or friction.

    kA is that of contact in the last step, from ``kept``, so that the mean of N is the force of contact. It is that of this
    step in three cases: in explicit steps, which evaluate contact at their start; in the first step of a copy; and for a pair
    that is not in ``kept``, if areas changed within the last step because the copy was ``relisted``.
    """

    @wp.kernel(module=f"{friction_module(dtype)}.{bounded}", enable_backward=False)
    def begin_friction_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        lists: near_pairs(dtype),
        # state in
        step: StepPairs,
        kept: near_pairs(dtype),
        slips: wp.array(dtype=wp.vec4d),
        steps: wp.array(dtype=wp.int32),
        relisted: wp.array(dtype=wp.int32),
        # parameters
        per_copy: int,
        friction: wp.float64,
        # out
        rubbed: RubbedPairs,
    ):
        e = wp.tid()
        if e >= lists.counts[0] + lists.counts[1]:
            return
        s = lists.stencils[e]
        r = wp.float64(lists.distances[e])
        gap = step.gap[e]
        k = step.stiffness[e]
        rubbed.contact[e] = k
        limit = ZERO
        if gap < r:
            if wp.static(not bounded):
                if steps[s[0] // per_copy] > 0:
                    if relisted[s[0] // per_copy] == 0:
                        k = ZERO
                    for j in range(kept.first[s[0]], kept.first[s[0] + 1]):
                        q = kept.corners[j] // 4
                        if (q < kept.counts[0]) == (e < lists.counts[0]) and equal(s, kept.stencils[q]):
                            k = slips[q][3]
            if wp.static(bounded):
                limit = friction * k * (r - gap)
            else:
                limit = -friction * k * slope(gap, r)
            rubbed.normal[e] = step.normal[e]
            rubbed.weights[e] = step.weights[e]
            rubbed.stiffness[e] = k
        rubbed.limit[e] = limit
        if rubbed.contact[e] > ZERO or limit > ZERO:
            pairs.acting[wp.atomic_add(pairs.number, 0, 1)] = e
            for i in range(4):
                wp.atomic_add(pairs.corner_counts, s[i], 1)

    return begin_friction_of_pairs


@wp.kernel(module="warpcloth.self_friction", enable_backward=False)
def note_relisted(
    # state in
    copies: wp.array(dtype=wp.int32),
    # in and out
    relisted: wp.array(dtype=wp.int32),
):
    """Kernel over copies: relisted = 1 for the given copies."""
    c = wp.tid()
    relisted[c] = wp.max(relisted[c], copies[c])


@cache
def set_stretch(dtype):
    """Kernel over acting pairs at the start of a step: ξ, from ``kept`` of the last step, if the copy has made ``steps``."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.kernel(module=friction_module(dtype), enable_backward=False)
    def set_stretch_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        x: wp.array(dtype=vec3),
        kept: near_pairs(dtype),
        slips: wp.array(dtype=wp.vec4d),
        steps: wp.array(dtype=wp.int32),
        # parameters
        per_copy: int,
        # in and out
        rubbed: RubbedPairs,
    ):
        turn = wp.tid()
        if turn >= pairs.number[0]:
            return
        e = pairs.acting[turn]
        limit = rubbed.limit[e]
        s = pairs.stencils[e]
        rubbed.stretch[e] = wp.vec3d()
        if limit == ZERO or steps[s[0] // per_copy] == 0:
            return
        n = rubbed.normal[e]
        sides = wp.where(e < pairs.counts[0], 1, 2)
        total = wp.vec3d()
        weight = ZERO
        own = wp.bool(False)
        for side in range(sides):
            for j in range(kept.first[s[side]], kept.first[s[side] + 1]):
                e_kept = kept.corners[j] // 4
                slip = slips[e_kept]
                if slip[2] > ZERO and not own:
                    q = kept.stencils[e_kept]
                    kept_sides = wp.where(e_kept < kept.counts[0], 1, 2)
                    # Some of the other pairs have their sides in the opposite order.
                    way = ZERO
                    if meet(s, 0, sides, q, 0, kept_sides) and meet(s, sides, 4, q, kept_sides, 4):
                        way = ONE
                    elif meet(s, 0, sides, q, kept_sides, 4) and meet(s, sides, 4, q, 0, kept_sides):
                        way = -ONE
                    if way != ZERO:
                        m = way * n
                        t = edge_tangent(exact(x[q[3]]) - exact(x[q[2]]), m)
                        stretch = way * (slip[0] * t + slip[1] * wp.cross(m, t))
                        if kept_sides == sides and equal(s, q):
                            own = True
                            total = stretch
                        else:
                            weight += slip[2]
                            total += slip[2] * stretch
        if not own and weight > ZERO:
            total = total / weight
        pull = rubbed.stiffness[e] * wp.length(total)
        if pull > limit:
            total = limit / pull * total
        rubbed.stretch[e] = total

    return set_stretch_of_pairs


@cache
def set_contact(dtype):
    """Kernel over acting pairs: kA of contact from another list of pairs, 0 for pairs that are not acting there."""

    @wp.kernel(module=friction_module(dtype), enable_backward=False)
    def set_contact_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        others: near_pairs(dtype),
        # state in
        of_others: StepPairs,
        # out
        rubbed: RubbedPairs,
    ):
        turn = wp.tid()
        if turn >= pairs.number[0]:
            return
        e = pairs.acting[turn]
        s = pairs.stencils[e]
        of_vertex = e < pairs.counts[0]
        found = ZERO
        for j in range(others.first[s[0]], others.first[s[0] + 1]):
            other = others.corners[j] // 4
            if (other < others.counts[0]) == of_vertex and equal(s, others.stencils[other]):
                found = of_others.stiffness[other]
        rubbed.contact[e] = found

    return set_contact_of_pairs


@cache
def stretch_of(dtype):
    """Device function (stencil, w, n, ξ, start, x, correction) → u."""
    vec3, _ = types(dtype)
    at, exact = vertex_of(dtype)

    @wp.func
    def stretch(
        s: wp.vec4i,
        w: wp.vec4d,
        n: wp.vec3d,
        before: wp.vec3d,
        start: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
    ):
        u = before
        for i in range(4):
            u += w[i] * (at(x, correction, s[i]) - exact(start[s[i]]))
        return u - wp.dot(n, u) * n

    return stretch


@cache
def find_friction(dtype):
    """Kernel over acting pairs: energy, force and second derivatives at x, or x + correction."""
    vec3, _ = types(dtype)
    stretch = stretch_of(dtype)

    @wp.kernel(module=friction_module(dtype), enable_backward=False)
    def find_friction_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        rubbed: RubbedPairs,
        start: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        # out
        forces: RubForces,
    ):
        turn = wp.tid()
        if turn >= pairs.number[0]:
            return
        e = pairs.acting[turn]
        limit = rubbed.limit[e]
        if limit == ZERO:
            return
        k = rubbed.stiffness[e]
        u = stretch(pairs.stencils[e], rubbed.weights[e], rubbed.normal[e], rubbed.stretch[e], start, x, correction)
        l = wp.length(u)
        least = wp.min(l, limit / k)
        forces.energy[e] = k * least * (l - SIDE * least)
        forces.direction[e] = u / wp.max(l, wp.float64(1e-300))
        if k * l > limit:
            forces.pull[e] = limit / l * u
            forces.along[e] = ZERO
            forces.across[e] = limit / l
        else:
            forces.pull[e] = k * u
            forces.along[e] = k
            forces.across[e] = k

    return find_friction_of_pairs


@cache
def end_friction(dtype):
    """Kernel over acting pairs at the end x of a step: values for the next step.

    These are the components of ξ along t, the edge of the pair in the plane normal to n, and along n × t; kA of friction, 0
    without friction; and kA of contact.
    """
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.kernel(module=friction_module(dtype), enable_backward=False)
    def end_friction_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        rubbed: RubbedPairs,
        start: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        # out
        slips: wp.array(dtype=wp.vec4d),
    ):
        turn = wp.tid()
        if turn >= pairs.number[0]:
            return
        e = pairs.acting[turn]
        slips[e] = wp.vec4d(ZERO, ZERO, ZERO, rubbed.contact[e])
        if rubbed.limit[e] == ZERO:
            return
        s = pairs.stencils[e]
        w = rubbed.weights[e]
        n = rubbed.normal[e]
        u = rubbed.stretch[e]
        for i in range(4):
            u += w[i] * (exact(x[s[i]]) - exact(start[s[i]]))
        u -= wp.dot(n, u) * n
        t = edge_tangent(exact(start[s[3]]) - exact(start[s[2]]), n)
        slips[e] = wp.vec4d(wp.dot(u, t), wp.dot(u, wp.cross(n, t)), rubbed.stiffness[e], rubbed.contact[e])

    return end_friction_of_pairs


@wp.struct
class RubbingPair:
    """Those of :class:`RubForces` and n of a pair."""

    normal: wp.vec3d
    pull: wp.vec3d
    direction: wp.vec3d
    along: wp.float64
    across: wp.float64


@wp.func
def _pair(found: RubForces, e: int):
    own = RubbingPair()
    own.normal = found.normal[e]
    own.pull = found.pull[e]
    own.direction = found.direction[e]
    own.along = found.along[e]
    own.across = found.across[e]
    return own


@wp.func
def _force(own: RubbingPair):
    return own.pull


@wp.func
def _curvature(own: RubbingPair):
    n = own.normal
    flat = wp.identity(n=3, dtype=wp.float64) - wp.outer(n, n)
    return own.across * flat + (own.along - own.across) * wp.outer(own.direction, own.direction)


@wp.func
def _part(own: RubbingPair, w: wp.float64, p: wp.vec3d):
    return w * p


@wp.func
def _product(own: RubbingPair, w: wp.float64, move: wp.vec3d):
    change = own.across * (move - wp.dot(own.normal, move) * own.normal)
    change += (own.along - own.across) * wp.dot(own.direction, move) * own.direction
    return w * change


FRICTION_OF_PAIRS = PairSource("self-friction", MODULE, RubForces, _pair, _force, _curvature, _part, _product)
