"""Factories of the kernels of the energy of self-contact and its derivatives, from the contacts of :mod:`.pair_potential`.

U = Σ kA φ(d) over the contacts, with φ as for colliders (:mod:`..terms.contact`). The nearest points minimise ‖y‖, so their
motion does not contribute to the gradient ∂U/∂xᵢ = kA φ′ wᵢn, n = y/d (Danskin's theorem). The Hessian of a contact is

    kA (φ″ wᵢwⱼ nnᵀ + φ′/d (wᵢwⱼ (1 − nnᵀ) − VᵢᵀG Vⱼ)),  Vᵢ = cᵢ yᵀ + wᵢ (u, v)ᵀ

for nearest points that move along the edges u and v, with cᵢ = ∂wᵢ/∂θ by their parameters θ, and G⁻¹ = LLᵀ the second
derivatives of ½‖y‖² by θ. For two edges with D² = γ(θ)‖y‖², cᵢ also has wᵢ ∂γ/∂θ/γ, and G⁻¹ is that of ½D²/γ. The part of φ′
is negative. Across n it is as large as that of φ″ at small gaps. Its entries that join n with directions across n have the size
of kA φ′ over the length of an edge. The definite part is kA φ″ nnᵀ alone, of contacts over a valley by their share of it. All
is in float64 for every precision.
"""

from functools import cache
from typing import Any

import warp as wp

from ..memory import load
from ..pairs import Pairs
from ..rotation import epsilon
from ..term import PairTerm
from ..terms import contact
from ..vectors import types
from .pair_potential import ENDING, MIDDLE, STARTING, TWO, TWO_EDGES, Contacts
from .pair_sums import PairForces, PairRow, note_pressing
from .self_gaps import ON_EDGE, ONE, SIDE, ZERO, farthest, vertex_of
from .self_pairs import MODULE, module_of
from .self_planes import margin_of, ulp_of

potential, slope, bend, gap_after = contact.potential, contact.slope, contact.bend, contact.gap_after
constraint_slope, constraint_bend = contact.constraint_slope, contact.constraint_bend
# The force of ψ at the least gap, divided by that of φ there.
STEEP = wp.constant(wp.float64(100.0))
ALL = wp.constant(wp.vec4d(1.0, 1.0, 1.0, 1.0))
UNITY = wp.constant(wp.mat33d(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))


@cache
def least_gap(dtype):
    """Device function (stencil, x, least) → the least gap f [m] that the filter leaves a pair at x: twice its margin."""
    vec3, _ = types(dtype)
    ulp = ulp_of(dtype)

    @wp.func
    def least_gap_of(s: wp.vec4i, x: wp.array(dtype=vec3), least: wp.float64):
        return wp.float64(2.0) * margin_of(least, ulp * farthest(x, s))

    return least_gap_of


@wp.func
def slope_of_middles(contacts: Contacts, e: int, own: wp.vec4i, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """∂γ/∂(s, t)/γ of two edges ab and cd, γ that of :func:`.pair_potential.from_middles`.

    The weights of obstacles are not stored: there the other edge and d n give s or t.
    """
    w = contacts.weights[e]
    u = b - a
    v = c - d
    across = contacts.gap[e] * contacts.normal[e] - (a - c)
    s = w[1]
    t = -w[3]
    if own[0] != contacts.parts[e][0]:
        s = wp.dot(across - t * v, u) / wp.dot(u, u)
    if own[2] != contacts.parts[e][2]:
        t = wp.dot(across - s * u, v) / wp.dot(v, v)
    return (TWO * TWO * MIDDLE / (contacts.ratio[e] * contacts.ratio[e])) * wp.vec2d(TWO * s - ONE, TWO * t - ONE)


@cache
def nearest_turns(dtype):
    """Device function (contacts, e, stencil, x, d) → the rows L⁻¹cᵢ and L⁻¹(u, v) of a contact, see the module.

    The nearest points move along u and v, edges of a face or the two edges. Along each one weight grows and one falls. On a
    flat mesh they may be on an edge by rounding alone, and move along the face.
    """
    vec3, _ = types(dtype)
    at = vertex_of(dtype)

    @wp.func
    def turns(contacts: Contacts, e: int, own: wp.vec4i, x: wp.array(dtype=vec3), correction: wp.array(dtype=vec3)):
        s = contacts.parts[e]
        bits = contacts.touching[e]
        n = contacts.normal[e]
        grows = wp.vec2i(-1, -1)
        falls = wp.vec2i(-1, -1)
        edges = wp.int32(0)
        if contacts.code[e] == TWO_EDGES:
            if (bits & 3) == 3:
                grows[0] = 1
                falls[0] = 0
            if (bits & 12) == 12:
                grows[1] = 2
                falls[1] = 3
        else:
            corner = wp.int32(1)
            while corner < 3 and (bits >> corner) & 1 == 0:
                corner += 1
            for i in range(1, 4):
                if i != corner:
                    o = at(x, correction, s[i]) - at(x, correction, s[corner])
                    on = (bits >> i) & 1 == 1 or wp.abs(wp.dot(n, o)) <= ON_EDGE * wp.length(o)
                    if on and wp.length(o) > ZERO:
                        grows[edges] = corner
                        falls[edges] = i
                        edges += 1
        u = wp.vec3d()
        v = wp.vec3d()
        if grows[0] >= 0:
            u = at(x, correction, s[grows[0]]) - at(x, correction, s[falls[0]])
        if grows[1] >= 0:
            v = at(x, correction, s[grows[1]]) - at(x, correction, s[falls[1]])
        # The entries of LLᵀ.
        uu = wp.dot(u, u)
        vv = wp.dot(v, v)
        uv = wp.dot(u, v)
        middle = wp.vec2d()
        if contacts.code[e] == TWO_EDGES:
            a = at(x, correction, s[0])
            b = at(x, correction, s[1])
            middle = slope_of_middles(contacts, e, own, a, b, at(x, correction, s[2]), at(x, correction, s[3]))
            q = contacts.gap[e] * contacts.gap[e]
            free = SIDE / (contacts.ratio[e] * contacts.ratio[e])
            uu += q * (free - middle[0] * middle[0])
            vv += q * (free - middle[1] * middle[1])
            uv -= q * middle[0] * middle[1]
        if grows[0] < 0:
            uu = ONE
            uv = ZERO
            middle[0] = ZERO
        if grows[1] < 0:
            vv = ONE
            uv = ZERO
            middle[1] = ZERO
        first = wp.sqrt(uu)
        lower = uv / first
        square = vv - lower * lower
        inverse = ZERO  # parallel edges give the nearest point one way; 16 ε bounds the rounding of the products in the square
        if square > wp.float64(16.0) * epsilon(vv) * vv:
            inverse = ONE / wp.sqrt(square)
        c = wp.outer(contacts.weights[e], middle)
        for k in range(2):
            if grows[k] >= 0:
                c[grows[k], k] = c[grows[k], k] + ONE
                c[falls[k], k] = c[falls[k], k] - ONE
        for i in range(4):
            c[i, 0] = c[i, 0] / first
            c[i, 1] = (c[i, 1] - lower * c[i, 0]) * inverse
            if own[i] != s[i]:  # an obstacle
                c[i] = wp.vec2d()
        one = u / first
        return c, wp.matrix_from_rows(one, (v - lower * one) * inverse)

    return turns


@cache
def find_forces(dtype, bounded: bool):
    """Kernel over contacts: their forces; φ = ½(r − d)² if ``bounded``.

    If the least gap f of the filter, ``least`` [m], is above 0, ψ is added to φ, from d = 2f on, where it is C², or from r if
    that is less: else cloth would be pressed to f, where one pair stops the whole copy. Of a negative contact the definite
    part lacks what is along n, which is negative, and has half of U′/d across n.
    """
    vec3, _ = types(dtype)
    least_gap_of, turns_of = least_gap(dtype), nearest_turns(dtype)

    @wp.kernel(module=f"{module_of(dtype)}.{bounded}", enable_backward=False)
    def find_forces_of_pairs(
        # elements
        pairs: Pairs,
        # state in
        contacts: Contacts,
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        # parameters
        least: wp.float64,
        # out
        forces: PairForces,
    ):
        for e in range(wp.tid(), pairs.number[0], pairs.threads):
            k = contacts.stiffness[e]
            r = contacts.distance[e]
            gap = contacts.gap[e]
            n = contacts.normal[e]
            energy = SIDE * k * (r - gap) * (r - gap)
            pull = k * (gap - r)
            curvature = k
            if wp.static(not bounded):
                energy = k * potential(gap, r)
                pull = k * slope(gap, r)
                curvature = k * bend(gap, r)
                if least > ZERO:
                    f = least_gap_of(pairs.stencils[e], x, least) / contacts.ratio[e]  # ψ is a function of D, as φ is
                    width = wp.min(f, r - f)
                    below = (f + width) / width - gap / width
                    if width > ZERO and below > ZERO:
                        more = STEEP * SIDE * SIDE * k * r * r * below
                        energy += more * below * below / wp.float64(3.0)
                        pull -= more * below / width
                        curvature += wp.float64(2.0) * more / (width * width)
            forces.weights[e] = contacts.weights[e]
            forces.energy[e] = energy
            forces.force[e] = pull * n
            bend_across = pull / wp.max(gap, wp.float64(1e-300))
            along_n = wp.outer(n, n)
            definite = contacts.share[e] * curvature * along_n
            if k < ZERO:
                definite = SIDE * bend_across * (UNITY - along_n)
            forces.definite[e] = definite
            turns, ways = turns_of(contacts, e, pairs.stencils[e], x, correction)
            across = UNITY - along_n - wp.transpose(ways) * ways
            forces.rest[e] = curvature * along_n + bend_across * across - definite
            forces.turns[e] = turns
            forces.ways[e] = ways
            forces.twist[e] = wp.vec2d(-pull, -pull * gap)
            note_pressing(forces, e, pairs.stencils[e])

    return find_forces_of_pairs


@cache
def near_contact(dtype):
    """The ``near`` of contact, with n and w as last found: v = n n·Σ wᵢ(xᵢ + dᵢ)."""
    vec3, _ = types(dtype)
    at, points = vertex_of(dtype), wp.array(dtype=vec3)
    stencil, normal, weights = load(wp.vec4i), load(wp.vec3d), load(wp.vec4d)

    @wp.func
    def near_of(pairs: Pairs, contacts: Contacts, e: int, x: points, correction: points, always: bool):
        s = stencil(pairs.stencils, e)
        w = weights(contacts.weights, e)
        a = at(x, correction, s[0])
        y = w[1] * (at(x, correction, s[1]) - a) + w[2] * (at(x, correction, s[2]) - a) + w[3] * (at(x, correction, s[3]) - a)
        if pairs.layout.obstacles > 0:  # Σ wᵢ of the cloth is not 0
            y += wp.dot(w, ALL) * a + contacts.offset[e]
        n = normal(contacts.normal, e)
        gap = wp.dot(n, y)
        touches = always or gap < contacts.distance[e] or contacts.followed.mode[0] == STARTING
        return touches, gap * n, n, w

    return near_of


@wp.func
def push_contact(
    contacts: Contacts, e: int, v: wp.vec3d, n: wp.vec3d, D: wp.float64, least: wp.float64, h: wp.float64, hard: bool
):
    """The ``push`` of contact: λ = (d* − d)/D of the gap d = v·n, with D at least ``least`` if the contact is ``hard``.

    The prox is that of the share of the contact; the rest of its force, and that of a negative contact, is ``fixed``.
    """
    k = contacts.stiffness[e]
    mode = contacts.followed.mode[0]
    if mode == ENDING or not D > ZERO:
        return wp.vec3d()
    if mode == STARTING:
        return wp.where(k > ZERO, contacts.followed.start[e], contacts.fixed[e]) * n
    r = contacts.distance[e]
    gap = wp.dot(v, n)
    if hard:
        if gap < r and k > ZERO:
            return (r - gap) / wp.max(D, least) * n
        return wp.vec3d()
    share = wp.where(k > ZERO, contacts.share[e], ZERO)
    fixed = contacts.fixed[e]
    gap += D * fixed
    found = fixed
    if gap < r and share > ZERO:
        found += (gap_after(gap, r, D * share * k * h * h) - gap) / D
    return found * n


@wp.func
def row_of_contact(pairs: Pairs, contacts: Contacts, e: int, x: wp.array(dtype=Any), d: wp.array(dtype=Any)):
    """The ``row`` of contact: C = −√(2φ(d)), as for contact with colliders. The second has the stiffness −λC″ along n.

    C is that of the share of the contact; the rest is ``fixed``.
    """
    found = PairRow()
    k = contacts.stiffness[e]
    r = contacts.distance[e]
    gap = contacts.gap[e]
    n = contacts.normal[e]
    share = wp.where(k > ZERO, contacts.share[e], ZERO)
    found.weights = contacts.weights[e]
    found.size = gap
    found.fixed = -(ONE - share) * k * slope(gap, r)
    found.stiffness = share * k
    found.first = n
    if share > ZERO:
        steep = constraint_slope(gap, r)
        if steep > ZERO:
            found.fixed /= steep
        C = -wp.sqrt(wp.float64(2.0) * potential(gap, r))
        found.C[0] = C
        found.first = constraint_slope(gap, r) * n
        found.second = wp.sqrt(wp.max((found.stiffness * C - found.fixed) * constraint_bend(gap, r), ZERO)) * n
    return found


CONTACT_OF_PAIRS = PairTerm(
    "self-contact", MODULE, 1, Contacts, near_contact, push_contact, row_of_contact, isotropic=False, turns=True
)
