"""Factories of the kernels of the energy of self-contact and its derivatives.

U = Σ kA φ(d) over the acting pairs, with the gap d of :mod:`.self_gaps`, the area A of :mod:`.self_pairs`, and φ as for
colliders (:mod:`..terms.contact`). The nearest points minimise ‖y‖, so their motion does not contribute to the gradient
∂U/∂xᵢ = kA φ′ wᵢn, n = y/d (Danskin's theorem). The Hessian is approximated by its semi-definite part kA φ″ wᵢwⱼnnᵀ.

Everything is computed in float64 for every precision of the model, so that positions are exact.
"""

from functools import cache

import warp as wp

from ..terms import contact
from ..vectors import types
from .pair_sums import PairSource
from .self_gaps import SIDE, ZERO, gap_along, nearest, signed_gap, vertex_of
from .self_pairs import MODULE, StepPairs, module_of, near_pairs
from .self_planes import margin_of

potential, slope, bend = contact.potential, contact.slope, contact.bend
# The force of ψ at the least gap, divided by that of φ there.
STEEP = wp.constant(wp.float64(100.0))


@wp.struct
class PairForces:
    """n, w, kAφ [J], kAφ′ [N] and, in ``acting``, kAφ″ [N/m] of each pair at some positions.

    On the CPU ``pressing`` lists the ``count`` (1,) pairs with a force, in order.
    """

    normal: wp.array(dtype=wp.vec3d)
    weights: wp.array(dtype=wp.vec4d)
    energy: wp.array(dtype=wp.float64)
    slope: wp.array(dtype=wp.float64)
    acting: wp.array(dtype=wp.float64)
    pressing: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)


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

    @wp.func
    def least_gap_of(s: wp.vec4i, x: wp.array(dtype=vec3), least: wp.float64):
        far = ZERO
        for i in range(4):
            far = wp.max(far, wp.max(wp.abs(exact(x[s[i]]))))
        return wp.float64(2.0) * margin_of(least, far)

    return least_gap_of


@cache
def find_forces(dtype, bounded: bool):
    """Kernel over acting pairs: kAφ, kAφ′, kAφ″, w and n at x, or x + correction; φ = ½(r − d)² if ``bounded``.

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
        forces.energy[e] = ZERO
        forces.slope[e] = ZERO
        forces.acting[e] = ZERO
        touches, gap, n, w = gap_of(pairs, step, e, x, correction, False)
        if touches:
            if apart and gap < ZERO:
                gap = -gap
                n = -n
            k = step.stiffness[e]
            r = wp.float64(pairs.distances[e])
            forces.normal[e] = n
            forces.weights[e] = w
            if wp.static(bounded):
                forces.energy[e] = SIDE * k * (r - gap) * (r - gap)
                forces.slope[e] = k * (gap - r)
                forces.acting[e] = k
            else:
                forces.energy[e] = k * potential(gap, r)
                forces.slope[e] = k * slope(gap, r)
                forces.acting[e] = k * bend(gap, r)
                if least > ZERO:
                    f = least_gap_of(pairs.stencils[e], x, least)
                    below = wp.float64(2.0) - gap / f
                    if below > ZERO and wp.float64(2.0) * f <= r:
                        more = STEEP * SIDE * SIDE * k * r * r * below
                        forces.energy[e] = forces.energy[e] + more * below * below / wp.float64(3.0)
                        forces.slope[e] = forces.slope[e] - more * below / f
                        forces.acting[e] = forces.acting[e] + wp.float64(2.0) * more / (f * f)
            if forces.pressing:
                forces.pressing[wp.atomic_add(forces.count, 0, 1)] = e

    return find_forces_of_pairs


@wp.struct
class PressingPair:
    """n, kAφ′ and kAφ″ of a pair."""

    normal: wp.vec3d
    slope: wp.float64
    bend: wp.float64


@wp.func
def _pair(found: PairForces, e: int):
    own = PressingPair()
    own.normal = found.normal[e]
    own.slope = found.slope[e]
    own.bend = found.acting[e]
    return own


@wp.func
def _force(own: PressingPair):
    return own.slope * own.normal


@wp.func
def _curvature(own: PressingPair):
    return own.bend * wp.outer(own.normal, own.normal)


@wp.func
def _part(own: PressingPair, w: wp.float64, p: wp.vec3d):
    return w * wp.dot(own.normal, p)


@wp.func
def _product(own: PressingPair, w: wp.float64, along: wp.float64):
    return own.bend * w * along * own.normal


CONTACT_OF_PAIRS = PairSource("self-contact", MODULE, PairForces, _pair, _force, _curvature, _part, _product)
