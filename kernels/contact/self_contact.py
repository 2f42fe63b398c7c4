"""Factories of the kernels of the energy of self-contact and its derivatives.

U = Σ kA φ(d) over the acting pairs, with the gap d of :mod:`.self_gaps`, the area A of :mod:`.self_pairs`, and φ as for
colliders (:mod:`..terms.contact`). The nearest points minimise ‖y‖, so their motion does not contribute to the gradient
∂U/∂xᵢ = kA φ′ wᵢn, n = y/d (Danskin's theorem). The Hessian is approximated by its semi-definite part kA φ″ wᵢwⱼnnᵀ.

Everything is computed in float64 for every precision of the model, so that positions are exact.
"""

from functools import cache

import warp as wp

from ..memory import load
from ..terms import contact
from ..vectors import types
from .pair_sums import PairForces, PairRow, PairTerm
from .self_gaps import SIDE, ZERO, gap_along, nearest, signed_gap, vertex_of
from .self_pairs import MODULE, StepPairs, module_of, near_pairs
from .self_planes import margin_of, ulp_of

potential, slope, bend, gap_after = contact.potential, contact.slope, contact.bend, contact.gap_after
constraint_slope, constraint_bend = contact.constraint_slope, contact.constraint_bend
# The force of ψ at the least gap, divided by that of φ there.
STEEP = wp.constant(wp.float64(100.0))


@cache
def gap_in_step(dtype):
    """Device function (pairs, step, e, x, correction, always) → whether a pair touches, d, n and w at x, or x + correction.

    The nearest points are found only if d can be below the contact distance, or ``always``; the pair then touches at any d.
    """
    vec3, _ = types(dtype)
    at, _exact = vertex_of(dtype)

    @wp.func
    def gap_of(
        pairs: near_pairs(dtype),
        step: StepPairs,
        e: int,
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        always: bool,
    ):
        s = pairs.stencils[e]
        r = wp.float64(pairs.distances[e])
        a = at(x, correction, s[0])
        b = at(x, correction, s[1])
        c = at(x, correction, s[2])
        d = at(x, correction, s[3])
        of_vertex = e < pairs.counts[0]
        gap = r
        n = wp.vec3d()
        w = wp.vec4d()
        if always or gap_along(of_vertex, step.normal[e], a, b, c, d) < r:
            w, y, inside = nearest(of_vertex, a, b, c, d)
            gap, n = signed_gap(y, step.normal[e], inside)
        return always or gap < r, gap, n, w

    return gap_of


@cache
def least_gap(dtype):
    """Device function (stencil, x, least) → the least gap f [m] that the filter leaves a pair at x: twice its margin."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    ulp = ulp_of(dtype)

    @wp.func
    def least_gap_of(s: wp.vec4i, x: wp.array(dtype=vec3), least: wp.float64):
        far = ZERO
        for i in range(4):
            far = wp.max(far, wp.max(wp.abs(exact(x[s[i]]))))
        return wp.float64(2.0) * margin_of(least, ulp * far)

    return least_gap_of


@cache
def find_forces(dtype, bounded: bool):
    """Kernel over acting pairs: the forces at x, or x + correction; φ = ½(r − d)² if ``bounded``.

    With ``apart`` no pair passes through, so that d is never negative: where cloth slides over an edge, y may turn far from its
    normal at the start of the step. If ``least`` [m], the least gap of the filter, is above 0, ψ is added to φ.
    It begins at d = 2f, where it is C². Where r is below 2f, as far from the origin, ψ is left out.
    """
    vec3, _ = types(dtype)
    gap_of, least_gap_of = gap_in_step(dtype), least_gap(dtype)

    @wp.kernel(module=f"{module_of(dtype)}.{bounded}", enable_backward=False)
    def find_forces_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        step: StepPairs,
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        # parameters
        apart: bool,
        least: wp.float64,
        # out
        forces: PairForces,
    ):
        t = wp.tid()
        if t >= pairs.number[0]:
            return
        e = pairs.acting[t]
        forces.bend[e] = wp.vec2d()
        touches, gap, n, w = gap_of(pairs, step, e, x, correction, False)
        if touches:
            if apart and gap < ZERO:
                gap = -gap
                n = -n
            k = step.stiffness[e]
            r = wp.float64(pairs.distances[e])
            energy = SIDE * k * (r - gap) * (r - gap)
            pull = k * (gap - r)
            curvature = k
            if wp.static(not bounded):
                energy = k * potential(gap, r)
                pull = k * slope(gap, r)
                curvature = k * bend(gap, r)
                if least > ZERO:
                    f = least_gap_of(pairs.stencils[e], x, least)
                    below = wp.float64(2.0) - gap / f
                    if below > ZERO and wp.float64(2.0) * f <= r:
                        more = STEEP * SIDE * SIDE * k * r * r * below
                        energy += more * below * below / wp.float64(3.0)
                        pull -= more * below / f
                        curvature += wp.float64(2.0) * more / (f * f)
            forces.weights[e] = w
            forces.energy[e] = energy
            forces.force[e] = pull * n
            forces.bend[e] = wp.vec2d(curvature, ZERO)
            forces.along[e] = n
            if forces.pressing:
                forces.pressing[wp.atomic_add(forces.count, 0, 1)] = e

    return find_forces_of_pairs


@cache
def find_clearances(dtype):
    """Kernel over acting pairs: clearance = gap at x along n of the start of the step, minus the contact distance."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def find_each_clearance(
        # elements
        pairs: near_pairs(dtype),
        # state in
        x: wp.array(dtype=vec3),
        # in and out
        step: StepPairs,
    ):
        t = wp.tid()
        if t >= pairs.number[0]:
            return
        e = pairs.acting[t]
        s = pairs.stencils[e]
        gap = gap_along(e < pairs.counts[0], step.normal[e], exact(x[s[0]]), exact(x[s[1]]), exact(x[s[2]]), exact(x[s[3]]))
        step.clearance[t] = gap - wp.float64(pairs.distances[e])

    return find_each_clearance


@cache
def near_contact(dtype):
    """The ``near`` of contact. A pair is skipped quickly while corrections are below its ``clearance``, if it has one."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    gap_of, vector = gap_in_step(dtype), load(vec3)
    value, normal, stencil = (load(each) for each in (wp.float64, wp.vec3d, wp.vec4i))

    @wp.func
    def near_of(
        pairs: near_pairs(dtype),
        step: StepPairs,
        turn: int,
        e: int,
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        always: bool,
    ):
        touches = wp.bool(True)
        gap = ZERO
        n = wp.vec3d()
        w = wp.vec4d()
        if step.clearance and not always:
            s = stencil(pairs.stencils, e)
            p0 = exact(vector(correction, s[0]))
            p1 = exact(vector(correction, s[1]))
            p2 = exact(vector(correction, s[2]))
            p3 = exact(vector(correction, s[3]))
            left = value(step.clearance, turn) + gap_along(e < pairs.counts[0], normal(step.normal, e), p0, p1, p2, p3)
            touches = not left > ZERO
        if touches:
            touches, gap, n, w = gap_of(pairs, step, e, x, correction, always)
        return touches, gap * n, n, w

    return near_of


@cache
def push_contact(dtype):
    """The ``push`` of contact: λ = (d* − d)/D of the gap d = v·n, with D at least ``least`` if the pair is ``hard``."""

    @wp.func
    def push_of(
        pairs: near_pairs(dtype),
        step: StepPairs,
        e: int,
        v: wp.vec3d,
        n: wp.vec3d,
        D: wp.float64,
        least: wp.float64,
        h: wp.float64,
        hard: bool,
    ):
        r = wp.float64(pairs.distances[e])
        gap = wp.dot(v, n)
        found = ZERO
        if D > ZERO and gap < r:
            part = D
            compliance = wp.float64(wp.inf)
            if hard:
                part = wp.max(D, least)
            else:
                compliance = D * step.stiffness[e] * h * h
            found = (gap_after(gap, r, compliance) - gap) / part
        return found * n

    return push_of


@cache
def row_of_contact(dtype):
    """The ``row`` of contact: C = −√(2φ(d)), as for contact with colliders. The second has the stiffness −λC″ along n."""
    vec3, _ = types(dtype)
    at, _exact = vertex_of(dtype)

    @wp.func
    def row_of(
        pairs: near_pairs(dtype), step: StepPairs, e: int, x: wp.array(dtype=vec3), d: wp.array(dtype=vec3), held: wp.vec2d
    ):
        found = PairRow()
        found.stiffness = step.stiffness[e]
        if found.stiffness > ZERO:
            s = pairs.stencils[e]
            r = wp.float64(pairs.distances[e])
            a = at(x, d, s[0])
            w, y, inside = nearest(e < pairs.counts[0], a, at(x, d, s[1]), at(x, d, s[2]), at(x, d, s[3]))
            gap, n = signed_gap(y, step.normal[e], inside)
            found.weights = w
            found.held[0] = wp.max(held[0], ZERO)
            found.C[0] = -wp.sqrt(wp.float64(2.0) * potential(gap, r))
            found.first = constraint_slope(gap, r) * n
            found.second = wp.sqrt(wp.max(-found.held[0] * constraint_bend(gap, r), ZERO)) * n
            for i in range(1, 4):
                found.size += wp.abs(w[i]) * wp.length(at(x, d, s[i]) - a)
        return found

    return row_of


CONTACT_OF_PAIRS = PairTerm("self-contact", MODULE, 1, StepPairs, near_contact, push_contact, row_of_contact, isotropic=False)
