"""Kernels of the line search on φ(d) = s/2‖d‖²_M + U(base + d) − load·Σ m g·d along p in every copy."""

from functools import cache

import warp as wp

from .reduce import block_largest, block_sums, larger
from .vectors import types

MODULE = "warpcloth.search"
# The part of the slope by which φ must fall, below ½, by which a quadratic falls at its minimum (Goldstein 1965).
# A jump over a kink of friction, which 1e-4 accepts for ever, lowers φ by 3 % of the slope.
ENOUGH = wp.constant(wp.float64(0.25))
# Change of an objective, relative to its summands, that counts as rounding.
NOISE = wp.constant(wp.float64(1e-10))
# Rows of the sums over vertices that a trial needs, and their number.
WORK, SLOPE, SQUARE, MAX_NORM, ROWS = 0, 1, 2, 3, 4


@wp.struct
class LineSearch:
    """The line search of each copy, (B,), and of all, (1,).

    ``energy`` is φ at d [J], ``before`` that at the start, ``slope`` its derivative along p, ``step`` the trial length. At the
    trial they are ``trial_energy`` and ``trial_slope``, with ``square``, ‖∇φ‖² [N²], and ``acceleration``, max ‖∇φᵢ‖/mᵢ [m/s²].
    ``other`` is an energy outside the parts. ``searching`` is 1 until a step is found, ``proceed`` if another trial is needed,
    ``moved`` where the last search changed d; ``trials`` counts.
    """

    energy: wp.array(dtype=wp.float64)
    before: wp.array(dtype=wp.float64)
    slope: wp.array(dtype=wp.float64)
    step: wp.array(dtype=wp.float64)
    trial_energy: wp.array(dtype=wp.float64)
    trial_slope: wp.array(dtype=wp.float64)
    square: wp.array(dtype=wp.float64)
    acceleration: wp.array(dtype=wp.float64)
    other: wp.array(dtype=wp.float64)
    searching: wp.array(dtype=wp.int32)
    moved: wp.array(dtype=wp.int32)
    trials: wp.array(dtype=wp.int32)
    proceed: wp.array(dtype=wp.int32)


@cache
def inertia_struct(dtype):
    """Struct of the quadratic part of φ; ``mobility`` is None without locked coordinates, ``shared`` vertices have one g."""
    vec3, _ = types(dtype)

    @wp.struct
    class InertiaOfVertices:
        mass: wp.array(dtype=dtype)
        inverse_mass: wp.array(dtype=dtype)
        mobility: wp.array(dtype=vec3)
        gravity: wp.array(dtype=vec3)
        shared: int
        s: dtype
        load: dtype

    return InertiaOfVertices


@cache
def begin_search(dtype, block: int):
    """Kernel over (copies, lanes): the first trial d + p of active copies, else d; parts of φ′; the gradient is 0."""
    vec3, _ = types(dtype)
    store, _add_up = block_sums(block)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def begin(
        # state in
        correction: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        lanes: int,
        # in and out
        gradient: wp.array(dtype=vec3),
        # out
        search: LineSearch,
        trial: wp.array(dtype=vec3),
        slopes: wp.array2d(dtype=wp.float64),
    ):
        copy, lane = wp.tid()
        step, slope = dtype(active[copy]), wp.float64(0.0)
        for j in range(lane, per_copy, lanes):
            i = copy * per_copy + j
            slope += wp.float64(wp.dot(gradient[i], direction[i]))
            trial[i] = correction[i] + step * direction[i]
            gradient[i] = vec3()
        store(lane, slope, slopes, copy)
        if lane == 0:
            search.step[copy] = wp.float64(active[copy])
            search.searching[copy] = active[copy]
            search.moved[copy] = 0
            search.before[copy] = search.energy[copy]
            search.other[copy] = wp.float64(0.0)
            if copy == 0:
                search.trials[0] = 1
                search.proceed[0] = 0

    return begin


@cache
def set_trial(dtype):
    """Kernel over vertices: trial = d + step·p, the gradient becomes 0; counts the trial."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def set_each_trial(
        # state in
        correction: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        # in and out
        search: LineSearch,
        # out
        trial: wp.array(dtype=vec3),
        gradient: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        copy = i // per_copy
        if i == copy * per_copy:
            search.other[copy] = wp.float64(0.0)
            if copy == 0:
                search.trials[0] = search.trials[0] + 1
                search.proceed[0] = 0
        trial[i] = correction[i] + dtype(search.step[copy]) * direction[i]
        gradient[i] = vec3()

    return set_each_trial


@cache
def finish_gradient(dtype, block: int):
    """Kernel over (copies, lanes): gradient += s m d − load m g, 0 at pins and along locks; parts of ``ROWS`` sums.

    ``WORK`` is Σ s/2 m d·d − load m g·d [J], ``SLOPE`` ∇φ·p, ``SQUARE`` ‖∇φ‖², and ``MAX_NORM`` max ‖∇φᵢ‖/mᵢ.
    """
    vec3, _ = types(dtype)
    (store, _add_up), (store_largest, _find) = block_sums(block), block_largest(block)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def finish(
        # elements
        inertia: inertia_struct(dtype),
        # state in
        trial: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        lanes: int,
        # in and out
        gradient: wp.array(dtype=vec3),
        # out
        parts: wp.array3d(dtype=wp.float64),
    ):
        copy, lane = wp.tid()
        work, slope = wp.float64(0.0), wp.float64(0.0)
        square, largest = wp.float64(0.0), wp.float64(0.0)
        for j in range(lane, per_copy, lanes):
            i = copy * per_copy + j
            g = vec3()
            if inertia.inverse_mass[i] > dtype(0.0):
                d = trial[i]
                pull = inertia.load * inertia.gravity[i // inertia.shared]
                g = gradient[i] + inertia.mass[i] * (inertia.s * d - pull)
                work += wp.float64(inertia.mass[i]) * wp.float64(wp.dot(dtype(0.5) * inertia.s * d - pull, d))
            if inertia.mobility:
                for axis in range(3):
                    if inertia.mobility[i][axis] == dtype(0.0):
                        g[axis] = dtype(0.0)
            gradient[i] = g
            slope += wp.float64(wp.dot(g, direction[i]))
            square += wp.float64(wp.dot(g, g))
            largest = larger(largest, wp.float64(inertia.inverse_mass[i]) * wp.float64(wp.length(g)))
        store(lane, work, parts[WORK], copy)
        store(lane, slope, parts[SLOPE], copy)
        store(lane, square, parts[SQUARE], copy)
        store_largest(lane, largest, parts[MAX_NORM], copy)

    return finish


@cache
def add_trial(block: int):
    """Device function (copy, lane, of vertices, of terms, search) that adds up a trial."""
    (_store, add_up), (_store_largest, find) = block_sums(block), block_largest(block)

    @wp.func
    def add(
        copy: int,
        lane: int,
        of_vertices: wp.array3d(dtype=wp.float64),
        of_terms: wp.array3d(dtype=wp.float64),
        search: LineSearch,
    ):
        energy = add_up(lane, of_vertices[WORK], copy)
        for k in range(of_terms.shape[0]):
            energy += add_up(lane, of_terms[k], copy)
        slope = add_up(lane, of_vertices[SLOPE], copy)
        square = add_up(lane, of_vertices[SQUARE], copy)
        largest = find(lane, of_vertices[MAX_NORM], copy)
        if lane == 0:
            search.trial_energy[copy] = energy + search.other[copy]
            search.trial_slope[copy] = slope
            search.square[copy] = square
            search.acceleration[copy] = largest

    return add


@cache
def measure_start(block: int):
    """Kernel over (copies, lanes of one block): φ and the sums of :class:`LineSearch` at d."""
    add = add_trial(block)

    @wp.kernel(module=MODULE, enable_backward=False)
    def measure(
        # state in
        of_vertices: wp.array3d(dtype=wp.float64),
        of_terms: wp.array3d(dtype=wp.float64),
        # out
        search: LineSearch,
    ):
        copy, lane = wp.tid()
        add(copy, lane, of_vertices, of_terms, search)
        if lane == 0:
            search.energy[copy] = search.trial_energy[copy]

    return measure


@cache
def work_of_guess(dtype, block: int):
    """Kernel over (copies, lanes): trial = d + p, parts of ``WORK`` there and ``SQUARE`` of p."""
    vec3, _ = types(dtype)
    store, _add_up = block_sums(block)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def find_work(
        # elements
        inertia: inertia_struct(dtype),
        # state in
        correction: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        lanes: int,
        # out
        trial: wp.array(dtype=vec3),
        parts: wp.array3d(dtype=wp.float64),
    ):
        copy, lane = wp.tid()
        work, square = wp.float64(0.0), wp.float64(0.0)
        for j in range(lane, per_copy, lanes):
            i = copy * per_copy + j
            d = correction[i] + direction[i]
            trial[i] = d
            square += wp.float64(wp.dot(direction[i], direction[i]))
            if inertia.inverse_mass[i] > dtype(0.0):
                pull = inertia.load * inertia.gravity[i // inertia.shared]
                work += wp.float64(inertia.mass[i]) * wp.float64(wp.dot(dtype(0.5) * inertia.s * d - pull, d))
        store(lane, work, parts[WORK], copy)
        store(lane, square, parts[SQUARE], copy)

    return find_work


@cache
def bound_guess(block: int):
    """Kernel over (copies, lanes of one block): ``hopeful`` is 1 in ``active`` copies where a guess may lower φ, else 0;
    ``some`` if any.

    As pairs have no negative energy, it may not if φ without them is as high there as φ at d.
    """
    _store, add_up = block_sums(block)

    @wp.kernel(module=MODULE, enable_backward=False)
    def bound(
        # state in
        of_vertices: wp.array3d(dtype=wp.float64),
        of_terms: wp.array3d(dtype=wp.float64),
        search: LineSearch,
        # parameters
        active: wp.array(dtype=wp.int32),
        # out
        hopeful: wp.array(dtype=wp.int32),
        some: wp.array(dtype=wp.int32),
    ):
        copy, lane = wp.tid()
        energy = add_up(lane, of_vertices[WORK], copy)
        for k in range(of_terms.shape[0]):
            energy += add_up(lane, of_terms[k], copy)
        square = add_up(lane, of_vertices[SQUARE], copy)
        if lane == 0:
            hopeful[copy] = 0
            if active[copy] == 1 and energy < search.energy[copy] and square > wp.float64(0.0):
                hopeful[copy] = 1
                some[0] = 1

    return bound


@cache
def check_guess(block: int):
    """Kernel over (copies, lanes of one block): the step to a guess becomes 0 unless φ is lower there; ``proceed`` if a trial
    is set again.
    """
    add = add_trial(block)

    @wp.kernel(module=MODULE, enable_backward=False)
    def check(
        # state in
        of_vertices: wp.array3d(dtype=wp.float64),
        of_terms: wp.array3d(dtype=wp.float64),
        # in and out
        search: LineSearch,
    ):
        copy, lane = wp.tid()
        add(copy, lane, of_vertices, of_terms, search)
        if lane == 0 and search.searching[copy] == 1:
            search.searching[copy] = 0
            if not (search.trial_energy[copy] < search.energy[copy]):
                search.step[copy] = wp.float64(0.0)
                search.proceed[0] = 1

    return check


@cache
def check_trial(block: int):
    """Kernel over (copies, lanes of one block): accepts a trial step or halves it; after ``most`` trials it is 0, which one
    last trial measures.

    A step is accepted if φ(α) ≤ φ(0) + α φ'(0)/4 (Armijo), and φ(α) < φ(0) if φ'(0) ≥ 0; or, under rounding, if φ(α) ≤ φ(0) +
    noise and φ'(α) ≤ −(1 − 2e-4)·φ'(0) (approximate Wolfe, Hager and Zhang 2005). NaN is never accepted.
    """
    (_store, add_up), add = block_sums(block), add_trial(block)

    @wp.kernel(module=MODULE, enable_backward=False)
    def check(
        # state in
        of_vertices: wp.array3d(dtype=wp.float64),
        of_terms: wp.array3d(dtype=wp.float64),
        slopes: wp.array2d(dtype=wp.float64),
        # parameters
        noise: wp.float64,
        most: int,
        # in and out
        search: LineSearch,
    ):
        copy, lane = wp.tid()
        add(copy, lane, of_vertices, of_terms, search)
        slope = add_up(lane, slopes, copy)
        if lane == 0:
            search.slope[copy] = slope
            if search.searching[copy] == 1:
                start = search.energy[copy]
                trial = search.trial_energy[copy]
                decrease = trial <= start + ENOUGH * search.step[copy] * slope and (slope < wp.float64(0.0) or trial < start)
                level = trial <= start + noise * wp.abs(start)
                flat = search.trial_slope[copy] <= -wp.float64(1.0 - 2.0e-4) * slope
                if decrease or (level and flat):
                    search.searching[copy] = 0
                else:
                    search.step[copy] = wp.float64(0.5) * search.step[copy]
                    if search.trials[0] <= most:
                        search.proceed[0] = 1
                    if search.trials[0] >= most:
                        search.step[copy] = wp.float64(0.0)

    return check


@cache
def take_trial(dtype):
    """Kernel over vertices: d = the trial, with its φ."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def take(
        # state in
        trial: wp.array(dtype=vec3),
        # in and out
        search: LineSearch,
        # out
        correction: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if wp.max(wp.abs(correction[i] - trial[i])) > dtype(0.0):
            search.moved[i // (trial.shape[0] // search.moved.shape[0])] = 1
        correction[i] = trial[i]
        if i < search.energy.shape[0]:
            search.energy[i] = search.trial_energy[i]

    return take


@wp.kernel(module=MODULE, enable_backward=False)
def check_quadratic(
    # state in
    pull: wp.array(dtype=wp.float64),
    fraction: wp.array(dtype=wp.float64),
    # parameters
    most: int,
    # in and out
    search: LineSearch,
):
    """Kernel over copies: :func:`check_trial` for φ(d) = ½dᵀAd − cᵀd + U(d), U measured at d and at the trial.

    U is ``energy`` plus ``other``, p·∂U/∂x ``pull`` and ``trial_slope``, φ′(0) ``slope``, and pᵀAp ``square`` before p was
    shortened to a ``fraction``. A step is accepted if φ falls by 1e-4 of the slope's prediction, or if the change is rounding
    and the slope has fallen to 0.8. A copy without descent keeps its step, as does the last trial.
    """
    copy = wp.tid()
    if search.searching[copy] == 0:
        return
    step, slope, part = search.step[copy], search.slope[copy], fraction[copy]
    linear, curved = slope - pull[copy], step * part * part * search.square[copy]
    change = search.other[copy] - search.energy[copy] + step * (linear + wp.float64(0.5) * curved)
    level = wp.abs(change) <= NOISE * (wp.abs(search.energy[copy]) + step * wp.abs(linear))
    flat = curved + linear + search.trial_slope[copy] <= -wp.float64(0.8) * slope
    lower = change <= wp.float64(1.0e-4) * step * slope or (level and flat)
    if lower or not slope < wp.float64(0.0):
        search.searching[copy] = 0
    else:
        search.step[copy] = wp.float64(0.5) * step
        if search.trials[0] < most:
            search.proceed[0] = 1
