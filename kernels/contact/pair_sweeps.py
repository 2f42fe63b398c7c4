"""Factories of the kernels of Gauss–Seidel and Jacobi sweeps over pairs, for each :class:`..term.PairTerm`.

A sweep removes the λ of a pair and adds that of its prox at what remains: with v̂ without the force of the pair and D = Σ
wᵢ²/mᵢ along n, λ = −hₑ²∂U/∂y(v̂ + Dλ) in closed form, and Δxᵢ = wᵢλ/mᵢ. Then M(x − x̃) = Σ wᵢλ with w at x, and a fixed point
minimises the objective of the step. Without multipliers nothing is removed (PBD).

Where axes of a vertex are locked, a soft pair takes D with all axes free, which does not move the fixed point: by the smaller
D, a pair that cannot open along its free axes would throw the cloth far along them.
"""

from functools import cache

import warp as wp

from ..memory import load
from ..pairs import Pairs
from ..term import PairTerm
from ..vectors import types
from .pair_sums import PairForces, is_single
from .self_gaps import ONE, ZERO

# Smallest D of a hard pair, over its D with all axes free. If n is at an angle ε to the free axes, its vertices would move by
# (r − d)/sin ε. This bounds their moves by (r − d)/√LOCKED, and takes them to 0 where sin ε does.
LOCKED = wp.constant(wp.float64(0.01))


@wp.struct
class SweptPairs:
    """Values of each pair in a Jacobi sweep: whether it touches, v, n and w.

    ``slots`` has the index in ``corners`` of each corner 4·pair + i, and ``moves`` the mΔx of each entry of ``corners`` [kg·m].
    ``touching`` counts the pairs that touch at each vertex; it is 0 between sweeps.
    """

    touches: wp.array(dtype=wp.int32)
    v: wp.array(dtype=wp.vec3d)
    normal: wp.array(dtype=wp.vec3d)
    weights: wp.array(dtype=wp.vec4d)
    slots: wp.array(dtype=wp.int32)
    moves: wp.array(dtype=wp.vec3d)
    touching: wp.array(dtype=wp.int32)


@cache
def mobility(dtype, axes: bool, isotropic: bool):
    """Device functions (inverse masses, i, v) → W v and R v, and (inverse masses, i) → the largest 1/m of the axes of vertex i.

    With ``axes``, inverse masses are vectors. R is that largest 1/m if ``isotropic``, else W.
    """
    vec3, _ = types(dtype)

    @wp.func
    def alike(inverse_mass: wp.array(dtype=dtype), i: int, v: wp.vec3d):
        return wp.float64(inverse_mass[i]) * v

    @wp.func
    def by_axis(inverse_mass: wp.array(dtype=vec3), i: int, v: wp.vec3d):
        return wp.cw_mul(wp.vec3d(inverse_mass[i]), v)

    moved = by_axis if axes else alike

    @wp.func
    def greatest(inverse_mass: wp.array(dtype=vec3 if axes else dtype), i: int):
        return wp.max(moved(inverse_mass, i, wp.vec3d(ONE, ONE, ONE)))

    @wp.func
    def at_most(inverse_mass: wp.array(dtype=vec3 if axes else dtype), i: int, v: wp.vec3d):
        return greatest(inverse_mass, i) * v

    return moved, at_most if isotropic else moved, greatest


@cache
def sweep_pairs(term: PairTerm, dtype, axes: bool):
    """Kernel of one thread, which takes each pair in turn."""
    vec3, _ = types(dtype)
    moved, respond, greatest = mobility(dtype, axes, term.isotropic)
    near, push, stencil = term.near(dtype), term.push, load(wp.vec4i)

    @wp.kernel(module="unique", enable_backward=False)
    def sweep_each_pair(
        # elements
        pairs: Pairs,
        inverse_mass: wp.array(dtype=vec3 if axes else dtype),
        # state in
        data: term.data,
        x: wp.array(dtype=vec3),
        # parameters
        h: wp.float64,
        hard: bool,
        backward: bool,
        # in and out
        multipliers: wp.array(dtype=wp.vec3d),
        forces: PairForces,
        correction: wp.array(dtype=vec3),
    ):
        count = pairs.number[0]
        turn = wp.int32(0)
        while turn < count:
            e = wp.where(backward, count - 1 - turn, turn)
            turn += 1
            before = wp.vec3d()
            if multipliers:
                before = multipliers[e]
            held = not (before == wp.vec3d())
            touches, v, n, w = near(pairs, data, e, x, correction, held)
            if touches:
                s = stencil(pairs.stencils, e)
                D = ZERO
                whole = ZERO
                corners = wp.where(is_single(s), 1, 4)
                for i in range(corners):
                    D += w[i] * w[i] * wp.dot(n, respond(inverse_mass, s[i], n))
                    whole += w[i] * w[i] * greatest(inverse_mass, s[i])
                    if held:
                        v -= w[i] * forces.weights[e][i] * respond(inverse_mass, s[i], before)
                if not hard and D > ZERO:
                    v -= (whole - D) * before
                    D = whole
                after = push(data, e, v, n, D, LOCKED * whole, h, hard)
                for i in range(corners):
                    move = w[i] * after
                    if held:
                        move -= forces.weights[e][i] * before
                    move = moved(inverse_mass, s[i], move)
                    correction[s[i]] = correction[s[i]] + vec3(move)
                if multipliers:
                    multipliers[e] = after
                    forces.weights[e] = w

    return sweep_each_pair


@wp.kernel(module="warpcloth.pair_sweeps", enable_backward=False)
def number_corners(
    # elements
    pairs: Pairs,
    # out
    slots: wp.array(dtype=wp.int32),
):
    """Kernel over entries of ``corners``: the index of each corner."""
    k = wp.tid()
    if k < pairs.first[pairs.first.shape[0] - 1]:
        slots[pairs.corners[k]] = k


@cache
def touch_pairs(term: PairTerm, dtype):
    """Kernel over pairs of a Jacobi sweep: v, n and w of those that touch or have a force, counted at their vertices."""
    vec3, _ = types(dtype)
    near = term.near(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def touch_each_pair(
        # elements
        pairs: Pairs,
        # state in
        data: term.data,
        multipliers: wp.array(dtype=wp.vec3d),
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        # out
        swept: SweptPairs,
    ):
        e = wp.tid()
        if e >= pairs.number[0]:
            return
        swept.touches[e] = 0
        held = wp.bool(False)
        if multipliers:
            held = not (multipliers[e] == wp.vec3d())
        touches, v, n, w = near(pairs, data, e, x, correction, held)
        if touches:
            swept.touches[e] = 1
            swept.v[e] = v
            swept.normal[e] = n
            swept.weights[e] = w
            s = pairs.stencils[e]
            for i in range(4):
                again = wp.bool(False)  # as for obstacles, which the stencil has not
                for j in range(i):
                    again = again or s[j] == s[i]
                if not again:
                    wp.atomic_add(swept.touching, s[i], 1)

    return touch_each_pair


@cache
def press_pairs(term: PairTerm, dtype, axes: bool):
    """Kernel over pairs of a Jacobi sweep: λ of the prox, with D = Σ nᵢwᵢ²/mᵢ, nᵢ the touching pairs of vertex i.

    D ⪰ J W Jᵀ, so the sum of the moves does not overshoot; the fixed point is that of :func:`sweep_pairs`. It stores wᵢλ −
    w′ᵢλ′ for each corner, w′ and λ′ of the last sweep, and then λ and w for the next one.
    """
    _moved, respond, greatest = mobility(dtype, axes, term.isotropic)
    vec3, _ = types(dtype)
    push = term.push

    @wp.kernel(module="unique", enable_backward=False)
    def press_each_pair(
        # elements
        pairs: Pairs,
        inverse_mass: wp.array(dtype=vec3 if axes else dtype),
        # state in
        data: term.data,
        # parameters
        h: wp.float64,
        hard: bool,
        # in and out
        swept: SweptPairs,
        multipliers: wp.array(dtype=wp.vec3d),
        forces: PairForces,
    ):
        e = wp.tid()
        if e >= pairs.number[0]:
            return
        if swept.touches[e] == 0:
            for i in range(4):
                swept.moves[swept.slots[4 * e + i]] = wp.vec3d()
            return
        s = pairs.stencils[e]
        n = swept.normal[e]
        w = swept.weights[e]
        D = ZERO
        whole = ZERO
        for i in range(4):
            share = wp.float64(swept.touching[s[i]]) * w[i] * w[i]
            D += share * wp.dot(n, respond(inverse_mass, s[i], n))
            whole += share * greatest(inverse_mass, s[i])
        if not hard and D > ZERO:
            D = whole
        before = wp.vec3d()
        if multipliers:
            before = multipliers[e]
        after = push(data, e, swept.v[e] - D * before, n, D, LOCKED * whole, h, hard)
        for i in range(4):
            move = w[i] * after
            if not (before == wp.vec3d()):
                move -= forces.weights[e][i] * before
            swept.moves[swept.slots[4 * e + i]] = move
        if multipliers:
            multipliers[e] = after
            forces.weights[e] = w

    return press_each_pair


@cache
def move_by_pairs(dtype, axes: bool):
    """Kernel over vertices of a Jacobi sweep: d += W Σ of the ``moves`` of its corners, in order."""
    vec3, _ = types(dtype)
    moved, _respond, _greatest = mobility(dtype, axes, False)

    @wp.kernel(module="unique", enable_backward=False)
    def move_each_by_pairs(
        # elements
        pairs: Pairs,
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
        correction[i] = correction[i] + vec3(moved(inverse_mass, i, total))

    return move_each_by_pairs
