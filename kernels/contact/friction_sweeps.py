"""Factories of the kernels that sweep over self-contact pairs with friction, see :mod:`.self_friction`, Gauss–Seidel or Jacobi.

u = Σ wᵢxᵢ + … is linear in positions, so the local step is that of a vector constraint. û is u without the force of the pair
and W = Σ wᵢ²/mᵢ. Then λ = −hₑ²∂U/∂u(u*) at u* = û + Wλ, and Δxᵢ = wᵢλ/mᵢ. If vertices have locked axes, W is that of a free
axis; the fixed point is the same.
"""

from functools import cache

import warp as wp

from ..vectors import types
from .self_friction import RubbedPairs, friction_module, stretch_of
from .self_gaps import ONE, ZERO
from .self_pairs import near_pairs
from .self_sweeps import free_move, greatest_mobility


@wp.func
def multiplier_after(u: wp.vec3d, D: wp.float64, k: wp.float64, limit: wp.float64, h: wp.float64):
    """λ = −h²∂U/∂u(u*) at u* = u + Dλ, in the closed form of :func:`..terms.friction.prox`."""
    found = wp.vec3d()
    l = wp.length(u)
    if D > ZERO and l > ZERO:
        c = D * k * h * h
        most = wp.min(k * h * h * l / (ONE + c), limit * h * h)
        found = -most / l * u
    return found


@cache
def local_step(dtype):
    """Device function (pairs, rubbed, start, x, correction, e, D, h, multipliers) → Δλ of the prox at the remaining u."""
    vec3, _ = types(dtype)
    stretch = stretch_of(dtype)

    @wp.func
    def step(
        pairs: near_pairs(dtype),
        rubbed: RubbedPairs,
        start: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        e: int,
        D: wp.float64,
        h: wp.float64,
        multipliers: wp.array(dtype=wp.vec3d),
    ):
        before = multipliers[e]
        u = stretch(pairs.stencils[e], rubbed.weights[e], rubbed.normal[e], rubbed.stretch[e], start, x, correction)
        after = multiplier_after(u - D * before, D, rubbed.stiffness[e], rubbed.limit[e], h)
        multipliers[e] = after
        return after - before

    return step


@cache
def sweep_friction(dtype, axes: bool):
    """Kernel of one thread: for each acting pair in turn, removes its λ and adds that of the prox at the remaining u.

    M(x − x̃) = Σ wᵢλ always holds, and a fixed point minimises the objective of the step.
    """
    vec3, _ = types(dtype)
    step, moved, greatest = local_step(dtype), free_move(dtype, axes), greatest_mobility(dtype, axes)

    @wp.kernel(module="unique", enable_backward=False)
    def sweep_friction_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=vec3 if axes else dtype),
        # state in
        rubbed: RubbedPairs,
        start: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        # parameters
        h: wp.float64,
        backward: bool,
        # in and out
        multipliers: wp.array(dtype=wp.vec3d),
        correction: wp.array(dtype=vec3),
    ):
        count = pairs.number[0]
        for turn in range(count):
            e = pairs.acting[wp.where(backward, count - 1 - turn, turn)]
            if rubbed.limit[e] > ZERO:
                s = pairs.stencils[e]
                w = rubbed.weights[e]
                D = ZERO
                for i in range(4):
                    D += w[i] * w[i] * greatest(inverse_mass, s[i])
                change = step(pairs, rubbed, start, x, correction, e, D, h, multipliers)
                for i in range(4):
                    move = moved(inverse_mass, s[i], w[i] * change)
                    correction[s[i]] = correction[s[i]] + vec3(dtype(move[0]), dtype(move[1]), dtype(move[2]))

    return sweep_friction_of_pairs


@cache
def count_rubbing(dtype):
    """Kernel over vertices: rubbing = number of pairs of the vertex with friction."""

    @wp.kernel(module=friction_module(dtype), enable_backward=False)
    def count_rubbing_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        rubbed: RubbedPairs,
        # out
        rubbing: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        total = ZERO
        for k in range(pairs.first[i], pairs.first[i + 1]):
            if rubbed.limit[pairs.corners[k] // 4] > ZERO:
                total += ONE
        rubbing[i] = total

    return count_rubbing_pairs


@cache
def rub_pairs(dtype, axes: bool):
    """Kernel over acting pairs of a Jacobi sweep: λ of the prox with D = Σ nᵢwᵢ²/mᵢ for W, nᵢ = ``rubbing`` of vertex i."""
    vec3, _ = types(dtype)
    step, greatest = local_step(dtype), greatest_mobility(dtype, axes)

    @wp.kernel(module="unique", enable_backward=False)
    def rub_each_pair(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=vec3 if axes else dtype),
        # state in
        rubbed: RubbedPairs,
        start: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        rubbing: wp.array(dtype=wp.float64),
        # parameters
        h: wp.float64,
        # in and out
        multipliers: wp.array(dtype=wp.vec3d),
        # out
        changes: wp.array(dtype=wp.vec3d),
    ):
        turn = wp.tid()
        if turn >= pairs.number[0]:
            return
        e = pairs.acting[turn]
        if rubbed.limit[e] == ZERO:
            return
        s = pairs.stencils[e]
        w = rubbed.weights[e]
        D = ZERO
        for i in range(4):
            D += rubbing[s[i]] * w[i] * w[i] * greatest(inverse_mass, s[i])
        changes[e] = step(pairs, rubbed, start, x, correction, e, D, h, multipliers)

    return rub_each_pair


@cache
def move_by_friction(dtype, axes: bool):
    """Kernel over vertices of a Jacobi sweep: d += W Σ wᵢΔλ."""
    vec3, _ = types(dtype)
    moved = free_move(dtype, axes)

    @wp.kernel(module="unique", enable_backward=False)
    def move_each_by_friction(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=vec3 if axes else dtype),
        # state in
        rubbed: RubbedPairs,
        changes: wp.array(dtype=wp.vec3d),
        # in and out
        correction: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        total = wp.vec3d()
        for k in range(pairs.first[i], pairs.first[i + 1]):
            e = pairs.corners[k] // 4
            if rubbed.limit[e] > ZERO:
                total += rubbed.weights[e][pairs.corners[k] - 4 * e] * changes[e]
        move = moved(inverse_mass, i, total)
        correction[i] = correction[i] + vec3(dtype(move[0]), dtype(move[1]), dtype(move[2]))

    return move_each_by_friction
