"""Factories of the constraint rows of a term: their values, their Jacobian J and its transpose, one element after another.

A term with a scalar constraint C has one row an element, whose covector over y is ∂C/∂y, and when ``curved`` those of
``stiffening``, whose value is 0 and whose compliance is 1: with tension −λ they add BᵀB ⪰ −λ∂²C to the masses. A term without
has the 3M rows y − p(y), whose Jacobian is the constant G of weights, with p held. The rows of all terms are numbers of one
array, copy after copy and in each term after term: those of element e start at :func:`first_row`.

A row that binds nothing is inactive: no stiffness, no gradient, within the range of a limit. Its covector is 0, its value 0,
its compliance 1 and its λ 0.

The factories share the key (term, dtype, scalar, curved).
"""

from functools import cache

import warp as wp

from .assemble import local_coordinate, types
from .reduce import left_out
from .rotation import epsilon
from .term import Term

# Roundings that a row takes: of the places, of y, of C and of the force.
ROUNDINGS = wp.constant(4.0)


def rows_of(term: Term, scalar: bool, curved: bool):
    """Rows of one element."""
    if not scalar:
        return 3 * term.rows
    return 1 + (term.stiffening_rows if curved else 0)


def slope_type(term: Term, dtype, scalar: bool, curved: bool):
    """What an element keeps of its Jacobian: covectors (rows, 3M), or of constant ones whether they are active, 0 or 1."""
    return wp.types.matrix((rows_of(term, scalar, curved), 3 * term.rows), dtype) if scalar else dtype


@wp.func
def first_row(e: int, per_copy: int, first: int, rows_per_copy: int, rows: int):
    copy = e // per_copy
    return copy * rows_per_copy + first + (e - copy * per_copy) * rows


@cache
def linearise(term: Term, dtype, scalar: bool, curved: bool):
    """Kernel over elements at x̃ + d: gap = C + α̃λ, the Jacobian, α̃ = 1/(kAh²), the inverse diagonal of J W Jᵀ + α̃.

    α̃ is no less than ``least`` of the diagonal of J W Jᵀ, or redundant hard rows would leave λ undetermined; carried [m] is the
    move of a vertex by which that holds them open, next to nothing but where they contradict one another.
    residual [m] is the move of a vertex that closes the gap by itself, rounding [m] what of that and of the force precision
    does not hold. Of a hard row without direction the residual is |C|.
    """
    vec3, _ = types(dtype)
    K, M, N = wp.constant(term.vertices), wp.constant(term.rows), wp.constant(term.stiffening_rows)
    Q = wp.constant(rows_of(term, scalar, curved))
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    slope = slope_type(term, dtype, scalar, curved)
    y_of, weight, measure, slack = local_coordinate(term, dtype, True), term.weight, term.measure, term.slack
    gradient, constraint, constraint_gradient = term.gradient, term.constraint, term.constraint_gradient
    stiffening = term.stiffening

    @wp.func
    def size_of(stencil: wp.array2d(dtype=wp.int32), e: int, r: rest_type, x: wp.array(dtype=vec3), d: wp.array(dtype=vec3)):
        """What y is a sum of, and so rounds to ε of."""
        size = dtype(0.0)
        for i in range(K):
            away = x[stencil[e, i]]
            if wp.static(term.vertices > 1):
                away = away - x[stencil[e, 0]]
            size += wp.length(weight(r, i)) * (wp.length(away) + wp.length(d[stencil[e, i]]))
        return size

    @wp.kernel(module="unique", enable_backward=False)
    def linearise_constraints(
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        inverse_mass: wp.array(dtype=dtype),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        h: dtype,
        least: dtype,
        per_copy: int,
        first: int,
        rows_per_copy: int,
        # in and out
        lambdas: wp.array(dtype=dtype),
        # out
        slopes: wp.array(dtype=slope),
        gap: wp.array(dtype=dtype),
        compliance: wp.array(dtype=dtype),
        inverse: wp.array(dtype=dtype),
        residual: wp.array(dtype=wp.float64),
        rounding: wp.array(dtype=wp.float64),
        carried: wp.array(dtype=wp.float64),
    ):
        e = wp.tid()
        s = first_row(e, per_copy, first, rows_per_copy, Q)
        r = rest[e]
        y = y_of(stencil, e, r, x, d)
        alpha = dtype(1.0) / (stiffness[e] * measure(r) * h * h)
        g = constraint_gradient(y, r)
        c = constraint(y, r)
        steep = wp.sqrt(wp.ddot(g, g))
        covectors = slope()
        held = lambdas[s]
        left = wp.float64(0.0)
        if wp.isfinite(alpha) and steep == dtype(0.0):
            left = wp.where(alpha == dtype(0.0), wp.float64(wp.abs(c)), wp.float64(0.0))
        if not wp.isfinite(alpha) or steep == dtype(0.0):
            held = dtype(0.0)
            alpha = dtype(1.0)
            c = dtype(0.0)
        else:
            for m in range(M):
                for a in range(3):
                    covectors[0, 3 * m + a] = g[m, a]
            if wp.static(curved):
                more = stiffening(y, r, -held)
                for n in range(N):
                    covectors[1 + n] = more[n]
        for j in range(1, Q):
            lambdas[s + j] = dtype(0.0)
            gap[s + j] = dtype(0.0)
            compliance[s + j] = dtype(1.0)
        slopes[e] = covectors
        lost = dtype(0.0)
        for j in range(Q):
            total = dtype(0.0)
            most = dtype(0.0)
            for i in range(K):
                w = weight(r, i)
                direction = vec3()
                for m in range(M):
                    direction += w[m] * vec3(covectors[j, 3 * m], covectors[j, 3 * m + 1], covectors[j, 3 * m + 2])
                free = inverse_mass[stencil[e, i]]
                total += free * wp.dot(direction, direction)
                most = wp.max(most, free * wp.length(direction))
            if j == 0:
                excess = wp.max(least * total - alpha, dtype(0.0))
                alpha += excess
                lambdas[s] = held
                gap[s] = c + alpha * held
                compliance[s] = alpha
            total += compliance[s + j]
            inverse[s + j] = wp.where(total == dtype(0.0), dtype(0.0), dtype(1.0) / total)
            if j == 0:
                carried[s] = wp.float64(most * excess * wp.abs(held) * inverse[s])
                left += wp.float64(most * wp.abs(gap[s]) * inverse[s])
                lost = most * (steep * size_of(stencil, e, r, x, d) * inverse[s] + wp.abs(held))
        residual[s] = left
        rounding[s] = wp.float64(dtype(ROUNDINGS) * epsilon(lost) * lost)

    @wp.kernel(module="unique", enable_backward=False)
    def linearise_projections(
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        inverse_mass: wp.array(dtype=dtype),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        h: dtype,
        least: dtype,
        per_copy: int,
        first: int,
        rows_per_copy: int,
        # in and out
        lambdas: wp.array(dtype=dtype),
        # out
        slopes: wp.array(dtype=slope),
        gap: wp.array(dtype=dtype),
        compliance: wp.array(dtype=dtype),
        inverse: wp.array(dtype=dtype),
        residual: wp.array(dtype=wp.float64),
        rounding: wp.array(dtype=wp.float64),
        carried: wp.array(dtype=wp.float64),
    ):
        e = wp.tid()
        s = first_row(e, per_copy, first, rows_per_copy, Q)
        r = rest[e]
        c = gradient(y_of(stencil, e, r, x, d), r)  # y − p(y), as u = ½‖y − p(y)‖²
        alpha = dtype(1.0) / (stiffness[e] * measure(r) * h * h)
        active = wp.isfinite(alpha)
        if wp.static(slack):
            active = active and wp.ddot(c, c) != dtype(0.0)
        slopes[e] = wp.where(active, dtype(1.0), dtype(0.0))
        if not active:
            alpha = dtype(1.0)
            c = y_type()
        size = size_of(stencil, e, r, x, d)
        for m in range(M):
            total = dtype(0.0)
            most = dtype(0.0)
            if active:
                for i in range(K):
                    w = wp.abs(weight(r, i)[m])
                    total += inverse_mass[stencil[e, i]] * w * w
                    most = wp.max(most, inverse_mass[stencil[e, i]] * w)
            excess = wp.max(least * total - alpha, dtype(0.0))
            total += alpha + excess
            inverted = wp.where(total == dtype(0.0), dtype(0.0), dtype(1.0) / total)
            row = vec3()
            force = vec3()
            for a in range(3):
                j = s + 3 * m + a
                if not active:
                    lambdas[j] = dtype(0.0)
                force[a] = lambdas[j]
                row[a] = c[m, a] + (alpha + excess) * force[a]
                gap[j] = row[a]
                compliance[j] = alpha + excess
                inverse[j] = inverted
            carried[s + 3 * m] = wp.float64(most * excess * wp.length(force) * inverted)
            residual[s + 3 * m] = wp.float64(most * wp.length(row) * inverted)
            lost = most * (size * inverted + wp.length(force))
            rounding[s + 3 * m] = wp.float64(dtype(ROUNDINGS) * epsilon(lost) * lost)

    return linearise_constraints if scalar else linearise_projections


@cache
def pull(term: Term, dtype, scalar: bool, curved: bool):
    """The device function (slopes, λ, element, first row) → the force over y (M, 3) of the rows of one element."""
    M, Q = wp.constant(term.rows), wp.constant(rows_of(term, scalar, curved))
    y_type, slope = wp.types.matrix((term.rows, 3), dtype), slope_type(term, dtype, scalar, curved)

    @wp.func
    def of_constraint(slopes: wp.array(dtype=slope), lambdas: wp.array(dtype=dtype), e: int, s: int):
        z = y_type()
        for j in range(Q):
            for m in range(M):
                for a in range(3):
                    z[m, a] = z[m, a] + slopes[e][j, 3 * m + a] * lambdas[s + j]
        return z

    @wp.func
    def of_projection(slopes: wp.array(dtype=slope), lambdas: wp.array(dtype=dtype), e: int, s: int):
        z = y_type()
        for m in range(M):
            for a in range(3):
                z[m, a] = slopes[e] * lambdas[s + 3 * m + a]
        return z

    return of_constraint if scalar else of_projection


@cache
def apply_rows(term: Term, dtype, scalar: bool, curved: bool):
    """Kernel over elements: rows += J v, of the copies that are active, see :func:`.reduce.left_out`."""
    vec3, _ = types(dtype)
    M, Q = wp.constant(term.rows), wp.constant(rows_of(term, scalar, curved))
    rest_type, slope = wp.types.vector(term.parameters, dtype), slope_type(term, dtype, scalar, curved)
    y_of = local_coordinate(term, dtype, False)

    @wp.kernel(module="unique", enable_backward=False)
    def apply(
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        slopes: wp.array(dtype=slope),
        v: wp.array(dtype=vec3),
        per_copy: int,
        first: int,
        rows_per_copy: int,
        active: wp.array(dtype=wp.int32),
        # in and out
        rows: wp.array(dtype=dtype),
    ):
        e = wp.tid()
        if left_out(active, e // per_copy):
            return
        s = first_row(e, per_copy, first, rows_per_copy, Q)
        y = y_of(stencil, e, rest[e], v, v)
        if wp.static(scalar):
            for j in range(Q):
                total = rows[s + j]
                for m in range(M):
                    for a in range(3):
                        total += slopes[e][j, 3 * m + a] * y[m, a]
                rows[s + j] = total
        else:
            for m in range(M):
                for a in range(3):
                    rows[s + 3 * m + a] = rows[s + 3 * m + a] + slopes[e] * y[m, a]

    return apply


@cache
def scatter_rows(term: Term, dtype, scalar: bool, curved: bool):
    """Kernel over elements: out += Jᵀλ, of active copies. For the CPU, where it runs in order."""
    vec3, _ = types(dtype)
    K, M, Q = wp.constant(term.vertices), wp.constant(term.rows), wp.constant(rows_of(term, scalar, curved))
    rest_type, slope = wp.types.vector(term.parameters, dtype), slope_type(term, dtype, scalar, curved)
    weight, pull_of = term.weight, pull(term, dtype, scalar, curved)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter(
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        slopes: wp.array(dtype=slope),
        lambdas: wp.array(dtype=dtype),
        per_copy: int,
        first: int,
        rows_per_copy: int,
        active: wp.array(dtype=wp.int32),
        # in and out
        out: wp.array(dtype=vec3),
    ):
        e = wp.tid()
        if left_out(active, e // per_copy):
            return
        r = rest[e]
        z = pull_of(slopes, lambdas, e, first_row(e, per_copy, first, rows_per_copy, Q))
        for i in range(K):
            w = weight(r, i)
            force = vec3()
            for m in range(M):
                force += w[m] * z[m]
            wp.atomic_add(out, stencil[e, i], force)

    return scatter


@cache
def gather_rows(term: Term, dtype, scalar: bool, curved: bool):
    """Kernel over vertices: the same sum in a fixed order, through :attr:`warpcloth.model.model.DeviceElements.incidences`."""
    vec3, _ = types(dtype)
    K, M, Q = wp.constant(term.vertices), wp.constant(term.rows), wp.constant(rows_of(term, scalar, curved))
    rest_type, slope = wp.types.vector(term.parameters, dtype), slope_type(term, dtype, scalar, curved)
    weight, pull_of = term.weight, pull(term, dtype, scalar, curved)

    @wp.kernel(module="unique", enable_backward=False)
    def gather(
        offsets: wp.array(dtype=wp.int32),
        incidences: wp.array(dtype=wp.int32),
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        slopes: wp.array(dtype=slope),
        lambdas: wp.array(dtype=dtype),
        per_copy: int,
        first: int,
        rows_per_copy: int,
        active: wp.array(dtype=wp.int32),
        # in and out
        out: wp.array(dtype=vec3),
    ):
        v = wp.tid()
        total = vec3()
        for n in range(offsets[v], offsets[v + 1]):
            e = incidences[n] // K
            if left_out(active, e // per_copy):
                return
            w = weight(rest[e], incidences[n] - e * K)
            z = pull_of(slopes, lambdas, e, first_row(e, per_copy, first, rows_per_copy, Q))
            for m in range(M):
                total += w[m] * z[m]
        out[v] = out[v] + total

    return gather


@cache
def rows_in_full(term: Term, dtype, scalar: bool, curved: bool):
    """Kernel over elements: out[e, rows·i + j] = row j of ∂/∂xᵢ, in double precision, to be assembled on the host."""
    K, M, Q = wp.constant(term.vertices), wp.constant(term.rows), wp.constant(rows_of(term, scalar, curved))
    rest_type, slope = wp.types.vector(term.parameters, dtype), slope_type(term, dtype, scalar, curved)
    weight = term.weight

    @wp.kernel(module="unique", enable_backward=False)
    def expand(
        rest: wp.array(dtype=rest_type),
        slopes: wp.array(dtype=slope),
        # out
        out: wp.array2d(dtype=wp.vec3d),
    ):
        e = wp.tid()
        r = rest[e]
        for i in range(K):
            w = weight(r, i)
            for j in range(Q):
                row = wp.vec3d()
                if wp.static(scalar):
                    for m in range(M):
                        for a in range(3):
                            row[a] = row[a] + wp.float64(w[m]) * wp.float64(slopes[e][j, 3 * m + a])
                else:
                    row[j % 3] = wp.float64(w[j // 3]) * wp.float64(slopes[e])
                out[e, Q * i + j] = row

    return expand


@cache
def weigh(dtype):
    """Kernel over vertices: v = w v, w the inverse mass."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"warpcloth.constrain.{dtype.__name__}", enable_backward=False)
    def weigh_vertices(
        inverse_mass: wp.array(dtype=dtype),
        # in and out
        v: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        v[i] = inverse_mass[i] * v[i]

    return weigh_vertices


@cache
def mismatch(dtype):
    """Kernel over vertices: out = d − v; with v = W Jᵀλ what inertia and constraints disagree by [m]."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"warpcloth.constrain.{dtype.__name__}", enable_backward=False)
    def subtract(d: wp.array(dtype=vec3), v: wp.array(dtype=vec3), out: wp.array(dtype=vec3)):
        i = wp.tid()
        out[i] = d[i] - v[i]

    return subtract


@cache
def advance(dtype, vectors: bool):
    """Kernel over vertices, or rows of numbers: a += step·change, step that of the copy."""
    value = types(dtype)[0] if vectors else dtype

    @wp.kernel(module="unique", enable_backward=False)
    def advance_copies(
        step: wp.array(dtype=wp.float64),
        change: wp.array(dtype=value),
        per_copy: int,
        # in and out
        a: wp.array(dtype=value),
    ):
        i = wp.tid()
        a[i] = a[i] + dtype(step[i // per_copy]) * change[i]

    return advance_copies


@cache
def begin_step():
    """Kernel over copies: step 1 for those that still iterate, 0 for the rest."""

    @wp.kernel(module="unique", enable_backward=False)
    def begin(active: wp.array(dtype=wp.int32), step: wp.array(dtype=wp.float64)):
        copy = wp.tid()
        step[copy] = wp.float64(active[copy])

    return begin


@cache
def scale_rows(dtype):
    """Kernel over rows: out = factors·a."""

    @wp.kernel(module=f"warpcloth.constrain.{dtype.__name__}", enable_backward=False)
    def scale(factors: wp.array(dtype=dtype), a: wp.array(dtype=dtype), out: wp.array(dtype=dtype)):
        i = wp.tid()
        out[i] = factors[i] * a[i]

    return scale


@cache
def negate_rows(dtype):
    """Kernel over rows: out = −a."""

    @wp.kernel(module=f"warpcloth.constrain.{dtype.__name__}", enable_backward=False)
    def negate(a: wp.array(dtype=dtype), out: wp.array(dtype=dtype)):
        i = wp.tid()
        out[i] = -a[i]

    return negate
