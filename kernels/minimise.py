"""Kernels that minimise φ(d) = s/2‖d‖²_M + U(base + d) − load·Σ m g·d over free vertices of each copy.

Implicit Euler has base = x̃, s = 1/h², load = 0; equilibria have base = the start, s = 0, load = 1.
"""

from enum import IntEnum
from functools import cache

import warp as wp

from .reduce import block_largest, block_sums
from .search import LineSearch
from .term import HessianPolicy
from .vectors import types

MODULE = "warpcloth.minimise"  # of the kernels over copies

# Number of roundings in a force: of lengths, strain, products, and the sum over the elements of a vertex.
ROUNDINGS = wp.constant(wp.float64(4.0))
# Typical rounding of the energy relative to its worst case, because roundings add up like a random walk.
TYPICAL = wp.constant(wp.float64(0.1))
# Largest relative tolerance of a linear system; the smallest one over that by which the residual must still fall.
LOOSEST, LEFT = wp.constant(wp.float64(0.03)), wp.constant(wp.float64(0.5))
# Iterations after which the loop on the device returns to the host, which can then be interrupted.
AT_ONCE = wp.constant(8)
RAW = wp.constant(wp.float64(HessianPolicy.RAW))
# The factor of the negative part falls by this where the matrix is found to be indefinite. Of one step of 1/60 s of a folding
# cloth of 48² vertices, quarters take 46 iterations, halves 51, and 0 at once 63.
FALL = wp.constant(wp.float64(0.25))


class End(IntEnum):
    """How the minimisation of a copy ended, named as in :class:`warpcloth.core.status.Result`."""

    ITERATIONS_USED_UP = 0
    CONVERGED = 1
    ROUNDED = 2
    STALLED = 3
    DIVERGED = 4


USED_UP, CONVERGED, ROUNDED = (wp.constant(int(end)) for end in (End.ITERATIONS_USED_UP, End.CONVERGED, End.ROUNDED))
STALLED, DIVERGED = wp.constant(int(End.STALLED)), wp.constant(int(End.DIVERGED))


@wp.struct
class DescentState:
    """The minimisation of each copy, (B,), and flags of all, (1,).

    ``residual`` is the largest unbalanced acceleration over the scale, ``previous`` that before, or 0; ``end`` is an
    :class:`End`. ``proceed`` is 1 if a copy is active, ``more`` if it iterates before the host looks, ``stays`` where d is that
    of the start of the step.
    """

    active: wp.array(dtype=wp.int32)
    stays: wp.array(dtype=wp.int32)
    end: wp.array(dtype=wp.int32)
    iterations: wp.array(dtype=wp.int32)
    residual: wp.array(dtype=wp.float64)
    previous: wp.array(dtype=wp.float64)
    proceed: wp.array(dtype=wp.int32)
    more: wp.array(dtype=wp.int32)


@wp.struct
class Limits:
    """Tolerance of the residual, maximum iterations, (1,), and scale of each copy [m/s²], (B,)."""

    tolerance: wp.array(dtype=wp.float64)
    iterations: wp.array(dtype=wp.int32)
    scale: wp.array(dtype=wp.float64)


@wp.func
def look(progress: DescentState, limits: Limits, copy: int, acceleration: wp.float64, end: int):
    """Notes residual and end of an active copy; ``end`` holds if the residual is finite and too large."""
    residual = acceleration / limits.scale[copy]
    found = end
    if not wp.isfinite(residual):
        found = DIVERGED
    elif residual <= limits.tolerance[0]:
        found = CONVERGED
    progress.residual[copy] = residual
    progress.end[copy] = found
    done = progress.iterations[copy]
    if found != USED_UP or done >= limits.iterations[0]:
        progress.active[copy] = 0
    else:
        progress.active[copy] = 1
        progress.proceed[0] = 1
        if (done + 1) % AT_ONCE != 0:
            progress.more[0] = 1


@cache
def begin_descent():
    """Kernel over copies: the :class:`DescentState` at the start; ``proceed`` and ``more`` are 0 before.

    Cloth that stays iterates once even below the tolerance, or small motion and loads would be lost; ``previous`` is then −1.
    """

    @wp.kernel(module=MODULE, enable_backward=False)
    def begin(
        # state in
        acceleration: wp.array(dtype=wp.float64),
        # parameters
        limits: Limits,
        # out
        progress: DescentState,
    ):
        copy = wp.tid()
        progress.previous[copy] = wp.float64(0.0)
        progress.iterations[copy] = 0
        look(progress, limits, copy, acceleration[copy], USED_UP)
        if progress.stays[copy] == 1 and progress.end[copy] == CONVERGED:
            progress.previous[copy] = wp.float64(-1.0)
            progress.active[copy] = 1
            progress.proceed[0] = 1
            progress.more[0] = 1

    return begin


@cache
def note_stay():
    """Kernel over copies: ``stays`` = ``value`` where the search moved d, 1 where a ``fraction`` (B,) is below 1, else 0."""

    @wp.kernel(module=MODULE, enable_backward=False)
    def note(
        # state in
        moved: wp.array(dtype=wp.int32),
        fraction: wp.array(dtype=wp.float64),
        # parameters
        value: int,
        # in and out
        progress: DescentState,
    ):
        copy = wp.tid()
        if fraction:
            progress.stays[copy] = wp.where(fraction[copy] < wp.float64(1.0), 1, 0)
        elif moved[copy] == 1:
            progress.stays[copy] = value

    return note


@cache
def begin_newton():
    """Kernel over copies: sets the tolerance of the linear system, and if ``adaptive`` is 1 the factor of the negative part.

    That is RAW at first, later FALL above that of the last matrix.

    The tolerance is 0.9 (residual/previous)², choice 2 of Eisenstat and Walker (1996), at most LOOSEST, at least LEFT times
    limit/residual.
    """

    @wp.kernel(module=MODULE, enable_backward=False)
    def begin(
        # parameters
        adaptive: int,
        limits: Limits,
        # in and out
        progress: DescentState,
        # out
        policy: wp.array(dtype=wp.float64),
        tolerance: wp.array(dtype=wp.float64),
        wanted: wp.array(dtype=wp.int32),
        unsolved: wp.array(dtype=wp.int32),
    ):
        copy = wp.tid()
        progress.proceed[0] = 0
        progress.more[0] = 0
        unsolved[0] = 1
        wanted[copy] = progress.active[copy]
        if adaptive == 1:
            policy[copy] = wp.where(progress.iterations[copy] == 0, RAW, wp.min(policy[copy] + FALL, RAW))
        if progress.active[copy] == 1:
            residual = progress.residual[copy]
            forcing = LOOSEST
            if progress.previous[copy] < wp.float64(0.0):
                forcing = limits.tolerance[0]
            if progress.previous[copy] > wp.float64(0.0):
                ratio = residual / progress.previous[copy]
                forcing = wp.max(wp.float64(0.9) * ratio * ratio, LEFT * limits.tolerance[0] / residual)
            tolerance[copy] = wp.clamp(forcing, wp.float64(1.0e-12), LOOSEST)
            progress.previous[copy] = residual

    return begin


@cache
def find_indefinite():
    """Kernel over copies: those with an indefinite matrix are solved again, with a lower factor in ``policy``, down to 0, which
    is definite.

    ``unsolved`` becomes 1 if there are any, and their coarse matrices ``outdated`` (B,), which may be None.
    """

    @wp.kernel(module=MODULE, enable_backward=False)
    def find(
        # state in
        negative: wp.array(dtype=wp.int32),
        # in and out
        policy: wp.array(dtype=wp.float64),
        outdated: wp.array(dtype=wp.int32),
        # out
        wanted: wp.array(dtype=wp.int32),
        unsolved: wp.array(dtype=wp.int32),
    ):
        copy = wp.tid()
        wanted[copy] = 0
        if negative[copy] == 1 and policy[copy] > wp.float64(0.0):
            wanted[copy] = 1
            policy[copy] = wp.max(policy[copy] - FALL, wp.float64(0.0))
            if outdated:
                outdated[copy] = 1
            unsolved[0] = 1

    return find


@cache
def end_newton(block: int):
    """Kernel over (copies, lanes of one block): finds whether an active copy has ended.

    Rounding ends it if the gradient is within its rounding, and no step was found or φ fell by no more than its rounding. It is
    stuck without a step or a descent direction. Pairs leave a ``fraction`` (B,), or None, of the direction. A list with
    ``most`` pairs (B,) in less ``room`` ends the descent: the step is repeated.
    """
    (_store, add_up), (_store_largest, find) = block_sums(block), block_largest(block)

    @wp.kernel(module=MODULE, enable_backward=False)
    def end(
        # state in
        search: LineSearch,
        roundings: wp.array3d(dtype=wp.float64),
        fraction: wp.array(dtype=wp.float64),
        most: wp.array(dtype=wp.int32),
        # parameters
        room: int,
        resolution: wp.float64,
        limits: Limits,
        # in and out
        progress: DescentState,
    ):
        copy, lane = wp.tid()
        rounding = add_up(lane, roundings[0], copy)
        lost = add_up(lane, roundings[1], copy)
        of_sums = find(lane, roundings[2], copy)
        if lane > 0 or progress.active[copy] == 0:
            return
        progress.iterations[copy] = progress.iterations[copy] + 1
        before = search.before[copy]
        rounding += of_sums * wp.abs(before)
        noisy = search.square[copy] <= ROUNDINGS * ROUNDINGS * rounding
        level = before - search.energy[copy] <= resolution * wp.abs(before) + TYPICAL * lost
        stuck = search.step[copy] == wp.float64(0.0) or not (search.slope[copy] < wp.float64(0.0))
        # A step so short that rounding undoes it would be repeated for ever.
        undone = search.moved[copy] == 0 and search.step[copy] > wp.float64(0.0) and search.slope[copy] < wp.float64(0.0)
        if fraction:
            undone = undone and fraction[copy] == wp.float64(1.0)
        ended = USED_UP
        if undone or (noisy and (stuck or level)):
            ended = ROUNDED
        elif stuck and not noisy:
            ended = STALLED
        if most:
            if most[copy] > room:
                ended = STALLED
        look(progress, limits, copy, search.acceleration[copy], ended)

    return end


@cache
def mean_parts(dtype, block: int):
    """Kernel over (copies, lanes): parts of Σ mᵢ(dᵢ + pᵢ) by axis [kg·m]."""
    vec3, _ = types(dtype)
    store, _add_up = block_sums(block)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def sum_moments(
        # elements
        mass: wp.array(dtype=dtype),
        # state in
        correction: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        lanes: int,
        # out
        parts: wp.array3d(dtype=wp.float64),
    ):
        copy, lane = wp.tid()
        total = wp.vec3d()
        for k in range(lane, per_copy, lanes):
            i = copy * per_copy + k
            total += wp.float64(mass[i]) * (wp.vec3d(correction[i]) + wp.vec3d(direction[i]))
        for axis in range(3):
            store(lane, total[axis], parts[axis], copy)

    return sum_moments


@cache
def take_mean(dtype, block: int):
    """Kernel over (copies, lanes): p −= Σ m(d + p)/Σ m along axes of ``inverse``, (B,) vectors 1/Σ m or 0 [1/kg], unless a
    collider may be ``near`` (B,).
    """
    vec3, _ = types(dtype)
    _store, add_up = block_sums(block)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def take_mean_of_copies(
        # elements
        inverse: wp.array(dtype=wp.vec3d),
        near: wp.array(dtype=wp.int32),
        # state in
        parts: wp.array3d(dtype=wp.float64),
        # parameters
        per_copy: int,
        lanes: int,
        # in and out
        direction: wp.array(dtype=vec3),
    ):
        copy, lane = wp.tid()
        if near:
            if near[copy] != 0:
                return
        total = wp.vec3d(add_up(lane, parts[0], copy), add_up(lane, parts[1], copy), add_up(lane, parts[2], copy))
        mean = vec3(wp.cw_mul(inverse[copy], total))
        for k in range(lane, per_copy, lanes):
            direction[copy * per_copy + k] -= mean

    return take_mean_of_copies


@cache
def add_inertia(dtype):
    """Kernel over vertices: gradient += s m d − load m g, 0 at pins; work[i] = s/2 m d·d − load m g·d [J]."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def add(
        # elements
        mass: wp.array(dtype=dtype),
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        # state in
        correction: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        s: dtype,
        load: dtype,
        # in and out
        gradient: wp.array(dtype=vec3),
        # out
        work: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        if inverse_mass[i] > dtype(0.0):
            d = correction[i]
            pull = load * gravity[i // per_copy]
            gradient[i] = gradient[i] + mass[i] * (s * d - pull)
            work[i] = wp.float64(mass[i]) * wp.float64(wp.dot(dtype(0.5) * s * d - pull, d))
        else:
            gradient[i] = vec3()
            work[i] = wp.float64(0.0)

    return add
