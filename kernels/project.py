"""Local steps of elements of any term, and Gauss–Seidel sweeps over them.

The step of one element is

    Δλ = (G W Gᵀ + α̃ I)⁻¹ (p(y) − y − α̃ λ),   Δxᵢ = wᵢ-weighted rows of Δλ / mᵢ,   α̃ = 1/(k A h²)

with G the weights of y and W the inverse masses; for a scalar constraint (Macklin et al. 2016, *XPBD*)

    Δλ = −(C + α̃ λ)/(Σ wᵢ‖∇C‖² + α̃),   Δxᵢ = ∇ᵢC Δλ / mᵢ.

or with a prox, s at least the largest eigenvalue of G W Gᵀ (equal for M = 1),

    Δλ = (prox(y − s λ, s/α̃) − y)/s,   prox(v, c) = argmin u(y) + ‖y − v‖²/2c,

or ``prox_from`` if there is one. Else, with finite stiffness, a Newton step of :mod:`.local_minimiser` replaces the prox, with
the same fixed point.

XPBD accumulates Δλ in λ; for PBD λ is 0. With infinite stiffness α̃ = 0; for springs this is Müller et al. 2006 (*Position
based dynamics*). Δx is 0 without free vertices or stiffness. If the matrix is singular, its pseudo-inverse moves y as near to
p(y) as possible.

With locked coordinates, W has a mass per axis, and the first step is computed column by column of y.

The key is (term, dtype, scalar, multipliers, per_step, axes). ``scalar``: the scalar constraint is used. ``multipliers``: there
is λ. ``per_step``: finite stiffness is spread over the sweeps of a step. ``axes``: inverse masses are vectors.
"""

from functools import cache
from typing import Any

import warp as wp

from .assemble import is_clear
from .local import local_coordinate
from .local_minimiser import local_minimiser
from .memory import load, load_shared, store
from .rotation import epsilon
from .term import Term
from .transpose import to_corner
from .vectors import types

# Newton steps of a local problem. More do not save sweeps, because those to come solve it again.
NEWTON_STEPS = wp.constant(1)


def multiplier_type(term: Term, dtype, scalar: bool):
    """Type of λ of one element: a scalar, or a matrix (M, 3)."""
    return dtype if scalar else wp.types.matrix((term.rows, 3), dtype)


@wp.func
def pseudo_inverse2(A: Any):
    """A⁻¹ of a symmetric semi-definite 2×2 A; the pseudo-inverse if the smaller eigenvalue is below 4ε of the larger."""
    trace = wp.trace(A)
    B = A / trace
    determinant = B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0]
    if determinant > A.dtype(4.0) * epsilon(trace):
        B = wp.matrix_from_rows(wp.vector(B[1, 1], -B[0, 1]), wp.vector(-B[1, 0], B[0, 0])) / determinant
    return B / trace


@cache
def spread_compliance(dtype):
    """Device function (w, α̃, n) → α̃′ with which n sweeps move a single constraint as far as one sweep with α̃.

    For s = w/(w + α̃), w/(w + α̃′) = 1 − (1 − s)^(1/n) (Müller et al. 2006), in float64.
    """

    @wp.func
    def spread(w: dtype, compliance: dtype, sweeps: int):
        rest = wp.float64(compliance) / (wp.float64(w) + wp.float64(compliance))
        rest = wp.pow(rest, wp.float64(1.0) / wp.float64(sweeps))
        return dtype(wp.float64(w) * rest / (wp.float64(1.0) - rest))

    return spread


@cache
def prox_step(term: Term, dtype):
    """Device functions A (M, M) → s, the largest row sum, and (y, rest, s, α̃, λ, sweeps) → rows."""
    M, y_type = wp.constant(term.rows), wp.types.matrix((term.rows, 3), dtype)
    rest_type, square = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, term.rows), dtype)
    prox, prox_from, minimise = term.prox, term.prox_from, local_minimiser(term, dtype)

    @wp.func
    def largest_sum(A: square):
        largest = dtype(0.0)
        for m in range(M):
            total = dtype(0.0)
            for n in range(M):
                total += wp.abs(A[m, n])
            largest = wp.max(largest, total)
        return largest

    @wp.func
    def rows_of(y: y_type, r: rest_type, largest: dtype, compliance: dtype, before: y_type, sweeps: int):
        rows = y_type()
        if wp.where(compliance < dtype(wp.inf), largest, dtype(0.0)) != dtype(0.0):
            v = y - largest * before
            if wp.static(prox is None):
                steps = sweeps - sweeps + NEWTON_STEPS  # unknown to the compiler, or it would unroll
                rows = (minimise(v, y, r, compliance / largest, steps) - y) / largest
            elif wp.static(prox_from is None):
                rows = (prox(v, r, largest / compliance) - y) / largest
            else:
                rows = (prox_from(y, v, r, largest / compliance) - y) / largest
        return rows

    return largest_sum, rows_of


@cache
def multiplier(term: Term, dtype, scalar: bool, per_step: bool, multipliers: bool = True):
    """Device function (y, rest, inverse masses w of the corners, α̃, λ, sweeps) → (Δλ, rows (M, 3)).

    Δxᵢ = wᵢ Σ_m weightᵢ[m] rows[m]. Without ``multipliers`` λ is 0. :func:`spread_compliance` takes the mean diagonal of G W Gᵀ
    for w.
    """
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    corners = wp.types.vector(term.vertices, dtype)
    weight, project, prox = term.weight, term.project, term.prox
    constraint, constraint_gradient = term.constraint, term.constraint_gradient
    spread, share_of = spread_compliance(dtype), to_corner(term, dtype)
    largest_sum, rows_of = prox_step(term, dtype)
    if project is not None and prox is None and term.rows > 2:
        raise NotImplementedError(f"{term.name} projects {term.rows} rows; two at most")

    @wp.func
    def of_projection(y: y_type, r: rest_type, w: corners, compliance: dtype, before: y_type, sweeps: int):
        system = w[0] * wp.outer(weight(r, 0), weight(r, 0))
        for i in range(1, K):
            system += w[i] * wp.outer(weight(r, i), weight(r, i))
        mean = wp.trace(system) * dtype(wp.static(1.0 / term.rows))
        rows = y_type()
        if wp.static(per_step):
            compliance = spread(mean, compliance, sweeps)
        moves = wp.where(compliance < dtype(wp.inf), mean, dtype(0.0)) != dtype(0.0)
        gap = project(y, r) - y
        if wp.static(multipliers):
            gap -= compliance * before
        if wp.static(term.rows == 1):  # branch-free, so that a GPU can overlap several constraints
            if wp.static(multipliers):  # a division, for roundings of λ accumulate over sweeps
                rows = wp.where(moves, gap / (system[0, 0] + compliance), rows)
            else:
                rows = wp.where(moves, (dtype(1.0) / (system[0, 0] + compliance)) * gap, rows)
        else:
            if moves:
                for m in range(M):
                    system[m, m] = system[m, m] + compliance
                rows = pseudo_inverse2(system) * gap
        return rows, rows

    @wp.func
    def square_of(r: rest_type, corner: int, g: y_type):
        direction = share_of(r, corner, g)
        return wp.dot(direction, direction)

    @wp.func
    def of_constraint(y: y_type, r: rest_type, w: corners, compliance: dtype, before: dtype, sweeps: int):
        g = constraint_gradient(y, r)
        total = w[0] * square_of(r, 0, g)
        for i in range(1, K):
            total += w[i] * square_of(r, i, g)
        if wp.static(per_step):
            compliance = spread(total, compliance, sweeps)
        moves = wp.where(compliance < dtype(wp.inf), total, dtype(0.0)) != dtype(0.0)
        change = wp.where(moves, -(constraint(y, r) + compliance * before) / (total + compliance), dtype(0.0))
        return change, change * g

    @wp.func
    def of_prox(y: y_type, r: rest_type, w: corners, compliance: dtype, before: y_type, sweeps: int):
        system = w[0] * wp.outer(weight(r, 0), weight(r, 0))
        for i in range(1, K):
            system += w[i] * wp.outer(weight(r, i), weight(r, i))
        if wp.static(per_step):
            compliance = spread(wp.trace(system) * dtype(wp.static(1.0 / term.rows)), compliance, sweeps)
        rows = rows_of(y, r, largest_sum(system), compliance, before, sweeps)
        return rows, rows

    if scalar:
        return of_constraint
    return of_projection if project is not None and prox is None else of_prox


@cache
def multiplier_by_axis(term: Term, dtype, scalar: bool, per_step: bool):
    """:func:`multiplier` with inverse masses (K, 3) by axis."""
    K, M = wp.constant(term.vertices), wp.constant(term.rows)
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    corners, system_type = wp.types.matrix((term.vertices, 3), dtype), wp.types.matrix((term.rows, term.rows), dtype)
    weight, project, prox = term.weight, term.project, term.prox
    constraint, constraint_gradient = term.constraint, term.constraint_gradient
    spread, share_of = spread_compliance(dtype), to_corner(term, dtype)
    largest_sum, rows_of = prox_step(term, dtype)

    @wp.func
    def system_of(r: rest_type, w: corners, axis: int):
        system = system_type()
        for i in range(K):
            system += w[i, axis] * wp.outer(weight(r, i), weight(r, i))
        return system

    @wp.func
    def of_projection(y: y_type, r: rest_type, w: corners, compliance: dtype, before: y_type, sweeps: int):
        rows = y_type()
        gap = project(y, r) - y
        for axis in range(3):
            system = system_of(r, w, axis)
            mean = wp.trace(system) * dtype(wp.static(1.0 / term.rows))
            if wp.where(compliance < dtype(wp.inf), mean, dtype(0.0)) != dtype(0.0):
                own = compliance
                if wp.static(per_step):
                    own = spread(mean, compliance, sweeps)
                if wp.static(term.rows == 1):
                    rows[0, axis] = (gap[0, axis] - own * before[0, axis]) / (system[0, 0] + own)
                else:
                    for m in range(M):
                        system[m, m] = system[m, m] + own
                    inverse = pseudo_inverse2(system)
                    for m in range(M):
                        for n in range(M):
                            rows[m, axis] = rows[m, axis] + inverse[m, n] * (gap[n, axis] - own * before[n, axis])
        return rows, rows

    @wp.func
    def of_constraint(y: y_type, r: rest_type, w: corners, compliance: dtype, before: dtype, sweeps: int):
        g = constraint_gradient(y, r)
        total = dtype(0.0)
        for i in range(K):
            direction = share_of(r, i, g)
            total += wp.dot(wp.cw_mul(w[i], direction), direction)
        if wp.static(per_step):
            compliance = spread(total, compliance, sweeps)
        moves = wp.where(compliance < dtype(wp.inf), total, dtype(0.0)) != dtype(0.0)
        change = wp.where(moves, -(constraint(y, r) + compliance * before) / (total + compliance), dtype(0.0))
        return change, change * g

    @wp.func
    def of_prox(y: y_type, r: rest_type, w: corners, compliance: dtype, before: y_type, sweeps: int):
        largest = dtype(0.0)
        mean = dtype(0.0)
        for axis in range(3):
            system = system_of(r, w, axis)
            mean = wp.max(mean, wp.trace(system) * dtype(wp.static(1.0 / term.rows)))
            largest = wp.max(largest, largest_sum(system))
        if wp.static(per_step):
            compliance = spread(mean, compliance, sweeps)
        rows = rows_of(y, r, largest, compliance, before, sweeps)
        return rows, rows

    if scalar:
        return of_constraint
    return of_projection if project is not None and prox is None else of_prox


@cache
def element_change(term: Term, dtype, scalar: bool, per_step: bool, axes: bool = False):
    """Device function (element data, x̃, d, h, λ, sweeps) → (Δλ, rows) of one element at x̃ + d."""
    vec3, _ = types(dtype)
    K = wp.constant(term.vertices)
    rest_type, mobility = wp.types.vector(term.parameters, dtype), vec3 if axes else dtype
    corners = wp.types.matrix((term.vertices, 3), dtype) if axes else wp.types.vector(term.vertices, dtype)
    change_of = (multiplier_by_axis if axes else multiplier)(term, dtype, scalar, per_step)
    y_of, measure, idle = local_coordinate(term, dtype, True), term.measure, term.idle
    y_type = wp.types.matrix((term.rows, 3), dtype)
    lambda_type, number, vertex = multiplier_type(term, dtype, scalar), load(mobility), load(wp.int32, 2)

    @wp.func
    def change(
        stencil: wp.array2d(dtype=wp.int32),
        e: int,
        stiffness: dtype,
        r: rest_type,
        inverse_mass: wp.array(dtype=mobility),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        h: dtype,
        multipliers: lambda_type,
        sweeps: int,
    ):
        y = y_of(stencil, e, r, x, d)
        if wp.static(idle is not None):
            if idle(y, r, dtype(0.0)) == 1 and multipliers == lambda_type(dtype(0.0)):
                return lambda_type(dtype(0.0)), y_type()
        w = corners()
        for i in range(K):
            w[i] = number(inverse_mass, vertex(stencil, K * e + i))
        compliance = dtype(1.0) / (stiffness * measure(r) * h * h)
        return change_of(y, r, w, compliance, multipliers, sweeps)

    return change


@cache
def sweep_turn(dtype):
    """Struct of a launch of a sweep: elements from ``first`` on, ``each`` per thread; h, sweeps and ω."""

    @wp.struct
    class SweepTurn:
        first: int
        each: int
        h: dtype
        sweeps: int
        relaxation: dtype

    return SweepTurn


@wp.func
def nth_of_thread(first: int, each: int, thread: int, k: int):
    """Index of the k-th element of a thread in a sweep."""
    e = first + thread * wp.abs(each) + k
    if each < 0:
        e = first - (thread + 1) * each - 1 - k
    return e


@cache
def correct_in_place(
    term: Term,
    dtype,
    scalar: bool,
    multipliers: bool = False,
    per_step: bool = False,
    axes: bool = False,
    cleared: bool = False,
):
    """Kernel of a Gauss–Seidel sweep: d += ω Δx, λ += ω Δλ, each element after the moves of those before it.

    A thread takes ``each`` elements in order from first + thread·each on; a negative ``each`` reverses it. On a GPU that is one
    element of a colour, whose elements share no free vertex, or all of a copy; on the CPU all. If ``cleared``, it skips
    elements whose vertex has moved less than ``clear``; one that was not skipped once never is again.
    """
    vec3, _ = types(dtype)
    K = wp.constant(term.vertices)
    rest_type, lambda_type = wp.types.vector(term.parameters, dtype), multiplier_type(term, dtype, scalar)
    change, share_of = element_change(term, dtype, scalar, per_step, axes), to_corner(term, dtype)
    mass_type = vec3 if axes else dtype
    number, shared, vector, vertex = load(mass_type), load_shared(dtype), load(vec3), load(wp.int32, 2)
    rest_of, put, radius_of, put_radius = load(rest_type), store(vec3), load(dtype), store(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def correct(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        clear: wp.array(dtype=dtype),
        # state in
        inverse_mass: wp.array(dtype=mass_type),
        x: wp.array(dtype=vec3),
        # parameters
        turn: sweep_turn(dtype),
        # in and out
        lambdas: wp.array(dtype=lambda_type),
        d: wp.array(dtype=vec3),
    ):
        for k in range(wp.abs(turn.each)):
            e = nth_of_thread(turn.first, turn.each, wp.tid(), k)
            if wp.static(cleared):
                if is_clear(radius_of(clear, e), vector(d, vertex(stencil, e))):
                    continue
                put_radius(clear, e, dtype(0.0))
            r = rest_of(rest, e)
            before = lambda_type(dtype(0.0))
            if wp.static(multipliers):
                before = lambdas[e]
            more, rows = change(stencil, e, shared(stiffness, e), r, inverse_mass, x, d, turn.h, before, turn.sweeps)
            if wp.static(multipliers):
                lambdas[e] = before + turn.relaxation * more
            for i in range(K):
                v = vertex(stencil, K * e + i)
                mobility = number(inverse_mass, v)
                if wp.static(axes):
                    if wp.max(mobility) > dtype(0.0):
                        put(d, v, vector(d, v) + wp.cw_mul(mobility * turn.relaxation, share_of(r, i, rows)))
                else:
                    if mobility > dtype(0.0):
                        put(d, v, vector(d, v) + (mobility * turn.relaxation) * share_of(r, i, rows))

    return correct


@cache
def add_momentum(dtype):
    """Kernel over vertices: out += s mᵢ dᵢ, with s = 1/h² the inertial force [N]."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add(
        # state in
        mass: wp.array(dtype=dtype),
        d: wp.array(dtype=vec3),
        # parameters
        s: dtype,
        # in and out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        out[i] = out[i] + (s * mass[i]) * d[i]

    return add
