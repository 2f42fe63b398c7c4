"""Factories of the kernels of Gauss–Seidel and Jacobi sweeps over self-contact pairs."""

from functools import cache

import warp as wp

from ..memory import load
from ..terms import contact
from ..vectors import types
from .self_contact import PairForces, gap_in_step
from .self_gaps import ONE, ZERO, gap_along, vertex_of
from .self_pairs import StepPairs, near_pairs

gap_after = contact.gap_after
# Smallest W of a hard pair, over its W with all axes free. If n is at an angle ε to the free axes, the vertices of the pair
# would move by (r − d)/sin ε. This bounds their moves by (r − d)/√LOCKED, and takes them to 0 where sin ε does.
LOCKED = wp.constant(wp.float64(0.01))


@wp.struct
class SweptPairs:
    """Values of each pair in a Jacobi sweep: whether it touches, n, w and d.

    ``slots`` has the index in ``corners`` of each corner 4·pair + i, and ``moves`` the mΔx of each entry of ``corners`` [kg·m].
    ``touching`` counts the pairs that touch at each vertex; it is 0 between sweeps.
    """

    touches: wp.array(dtype=wp.int32)
    normal: wp.array(dtype=wp.vec3d)
    weights: wp.array(dtype=wp.vec4d)
    gap: wp.array(dtype=wp.float64)
    slots: wp.array(dtype=wp.int32)
    moves: wp.array(dtype=wp.vec3d)
    touching: wp.array(dtype=wp.int32)


@cache
def free_move(dtype, axes: bool):
    """Device function (inverse masses, i, v) → W v, in float64; with ``axes``, inverse masses are vectors."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.func
    def alike(inverse_mass: wp.array(dtype=dtype), i: int, v: wp.vec3d):
        return wp.float64(inverse_mass[i]) * v

    @wp.func
    def by_axis(inverse_mass: wp.array(dtype=vec3), i: int, v: wp.vec3d):
        return wp.cw_mul(exact(inverse_mass[i]), v)

    return by_axis if axes else alike


@wp.func
def press(left: wp.float64, r: wp.float64, W: wp.float64, least: wp.float64, k: wp.float64, h: wp.float64, hard: bool):
    """λ = (d* − d̂)/W of a pair with the gap d̂ = ``left`` without its force, W at least ``least`` if it is ``hard``."""
    after = ZERO
    if W > ZERO and left < r:
        part = W
        compliance = wp.float64(wp.inf)
        if hard:
            part = wp.max(W, least)
        else:
            compliance = W * k * h * h
        after = (gap_after(left, r, compliance) - left) / part
    return after


@cache
def greatest_mobility(dtype, axes: bool):
    """Device function (inverse masses, i) → the largest 1/m of the axes of vertex i."""
    moved = free_move(dtype, axes)
    kind, _ = types(dtype)

    @wp.func
    def greatest(inverse_mass: wp.array(dtype=kind if axes else dtype), i: int):
        return wp.max(moved(inverse_mass, i, wp.vec3d(ONE, ONE, ONE)))

    return greatest


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
        step: StepPairs,
        x: wp.array(dtype=vec3),
        # out
        clearance: wp.array(dtype=wp.float64),
    ):
        t = wp.tid()
        if t >= pairs.number[0]:
            return
        e = pairs.acting[t]
        s = pairs.stencils[e]
        gap = gap_along(e < pairs.counts[0], step.normal[e], exact(x[s[0]]), exact(x[s[1]]), exact(x[s[2]]), exact(x[s[3]]))
        clearance[t] = gap - wp.float64(pairs.distances[e])

    return find_each_clearance


@cache
def sweep_pairs(dtype, axes: bool):
    """Kernel of one thread: for each acting pair in turn, removes its λ, then adds that of the prox at the remaining gap.

    With d̂ = n·Σwᵢxᵢ without the force of the pair and W = Σ wᵢ²/mᵢ, λ = (d* − d̂)/W, where d* solves
    (d* − d̂)/W = −kAhₑ²φ′(d*) in closed form, and Δxᵢ = wᵢ λ n/mᵢ. Then M(x − x̃) = Σ wᵢλn with n and w at x, and a fixed point
    minimises the objective of the step. Without ``multipliers`` nothing is removed (PBD).

    A pair is skipped quickly while corrections are smaller than its ``clearance``, see :func:`find_clearances`.
    """
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    gap_of, moved, greatest = gap_in_step(dtype), free_move(dtype, axes), greatest_mobility(dtype, axes)
    number, value, stencil, normal, vector = (load(each) for each in (wp.int32, wp.float64, wp.vec4i, wp.vec3d, vec3))

    @wp.kernel(module="unique", enable_backward=False)
    def sweep_each_pair(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=vec3 if axes else dtype),
        # state in
        step: StepPairs,
        clearance: wp.array(dtype=wp.float64),
        x: wp.array(dtype=vec3),
        # parameters
        h: wp.float64,
        hard: bool,
        backward: bool,
        # in and out
        multipliers: wp.array(dtype=wp.float64),
        forces: PairForces,
        correction: wp.array(dtype=vec3),
    ):
        count = pairs.number[0]
        vertex_pairs = pairs.counts[0]
        turn = wp.int32(0)
        while turn < count:
            own = wp.where(backward, count - 1 - turn, turn)
            turn += 1
            e = number(pairs.acting, own)
            s = stencil(pairs.stencils, e)
            before = ZERO
            if multipliers:
                before = value(multipliers, e)
            if before == ZERO:
                p0 = exact(vector(correction, s[0]))
                p1 = exact(vector(correction, s[1]))
                p2 = exact(vector(correction, s[2]))
                p3 = exact(vector(correction, s[3]))
                if value(clearance, own) + gap_along(e < vertex_pairs, normal(step.normal, e), p0, p1, p2, p3) > ZERO:
                    continue
            touches, gap, n, w = gap_of(pairs, step, e, x, correction, before != ZERO)
            if touches:
                W = ZERO
                least = ZERO
                left = gap
                for i in range(4):
                    push = w[i] * moved(inverse_mass, s[i], n)
                    W += w[i] * wp.dot(n, push)
                    least += LOCKED * w[i] * w[i] * greatest(inverse_mass, s[i])
                    if before != ZERO:
                        left -= forces.weights[e][i] * before * wp.dot(push, forces.normal[e])
                after = press(left, wp.float64(pairs.distances[e]), W, least, step.stiffness[e], h, hard)
                for i in range(4):
                    move = w[i] * after * n
                    if before != ZERO:
                        move -= forces.weights[e][i] * before * forces.normal[e]
                    move = moved(inverse_mass, s[i], move)
                    correction[s[i]] = correction[s[i]] + vec3(dtype(move[0]), dtype(move[1]), dtype(move[2]))
                if multipliers:
                    multipliers[e] = after
                    forces.weights[e] = w
                    forces.normal[e] = n

    return sweep_each_pair


@cache
def number_corners(dtype):
    """Kernel over entries of ``corners``: stores the index of each corner in ``slots``."""

    @wp.kernel(module="unique", enable_backward=False)
    def number_each_corner(
        # elements
        pairs: near_pairs(dtype),
        # out
        slots: wp.array(dtype=wp.int32),
    ):
        k = wp.tid()
        if k < pairs.first[pairs.first.shape[0] - 1]:
            slots[pairs.corners[k]] = k

    return number_each_corner


@cache
def touch_pairs(dtype):
    """Kernel over acting pairs of a Jacobi sweep: n, w and d of those that touch or have a force, counted at their vertices."""
    vec3, _ = types(dtype)
    gap_of = gap_in_step(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def touch_each_pair(
        # elements
        pairs: near_pairs(dtype),
        # state in
        step: StepPairs,
        multipliers: wp.array(dtype=wp.float64),
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        # out
        swept: SweptPairs,
    ):
        t = wp.tid()
        if t >= pairs.number[0]:
            return
        e = pairs.acting[t]
        swept.touches[e] = 0
        before = ZERO
        if multipliers:
            before = multipliers[e]
        touches, gap, n, w = gap_of(pairs, step, e, x, correction, before != ZERO)
        if touches:
            swept.touches[e] = 1
            swept.gap[e] = gap
            swept.weights[e] = w
            swept.normal[e] = n
            s = pairs.stencils[e]
            for i in range(4):
                wp.atomic_add(swept.touching, s[i], 1)

    return touch_each_pair


@cache
def press_pairs(dtype, axes: bool):
    """Kernel over acting pairs of a Jacobi sweep: λ of the prox, with D = Σ nᵢwᵢ²/mᵢ for W, nᵢ the touching pairs of vertex i.

    D ⪰ J W Jᵀ, so the sum of the moves does not overshoot. The fixed point is that of :func:`sweep_pairs`. It stores
    wᵢ(λn − λ'n') for each corner, λ'n' of the last sweep, and then λ, w and n for the next one.
    """
    moved, greatest = free_move(dtype, axes), greatest_mobility(dtype, axes)
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def press_each_pair(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=vec3 if axes else dtype),
        # state in
        step: StepPairs,
        # parameters
        h: wp.float64,
        hard: bool,
        # in and out
        swept: SweptPairs,
        multipliers: wp.array(dtype=wp.float64),
        forces: PairForces,
    ):
        t = wp.tid()
        if t >= pairs.number[0]:
            return
        e = pairs.acting[t]
        if swept.touches[e] == 0:
            for i in range(4):
                swept.moves[swept.slots[4 * e + i]] = wp.vec3d()
            return
        s = pairs.stencils[e]
        n = swept.normal[e]
        w = swept.weights[e]
        D = ZERO
        least = ZERO
        for i in range(4):
            share = wp.float64(swept.touching[s[i]]) * w[i] * w[i]
            D += share * wp.dot(n, moved(inverse_mass, s[i], n))
            least += LOCKED * share * greatest(inverse_mass, s[i])
        left = swept.gap[e]
        before = ZERO
        if multipliers:
            before = multipliers[e]
            left -= D * before
        after = press(left, wp.float64(pairs.distances[e]), D, least, step.stiffness[e], h, hard)
        for i in range(4):
            move = w[i] * after * n
            if before != ZERO:
                move -= forces.weights[e][i] * before * forces.normal[e]
            swept.moves[swept.slots[4 * e + i]] = move
        if multipliers:
            multipliers[e] = after
            forces.weights[e] = w
            forces.normal[e] = n

    return press_each_pair


@cache
def move_by_pairs(dtype, axes: bool):
    """Kernel over vertices of a Jacobi sweep: d += W Σ of the ``moves`` of its corners, in order."""
    vec3, _ = types(dtype)
    moved = free_move(dtype, axes)

    @wp.kernel(module="unique", enable_backward=False)
    def move_each_by_pairs(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=vec3 if axes else dtype),
        # in and out
        swept: SweptPairs,
        correction: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if swept.touching[i] == 0:
            return
        swept.touching[i] = 0
        total = wp.vec3d()
        for k in range(pairs.first[i], pairs.first[i + 1]):
            total += swept.moves[k]
        move = moved(inverse_mass, i, total)
        correction[i] = correction[i] + vec3(dtype(move[0]), dtype(move[1]), dtype(move[2]))

    return move_each_by_pairs
