"""Factories of the kernels of contact of cloth with itself, by pairs of a vertex and a triangle or of two edges.

A pair has four vertices and y = Σ wᵢxᵢ, the vector between its nearest points: w = (1, −β₁, −β₂, −β₃) of a vertex and a
triangle, (1 − s, s, −(1 − t), −t) of two edges. U = Σ kA φ(d), d = ±‖y‖, φ that of contact with colliders
(:mod:`.terms.contact`). The nearest points minimise ‖y‖, so their motion adds nothing to ∂U/∂xᵢ = kA φ′ wᵢn, n = y/d (Danskin).
Of the second derivative the part kA φ″ wᵢwⱼnnᵀ is kept, which is semi-definite. d is below 0 where a pair went through: where y
points against n of the start of the step.

A, an area, is fixed within a step. All is computed in float64, whatever the model has: the points are then exact.
"""

from functools import cache

import warp as wp

from .proximity import sort
from .terms import contact
from .vectors import types

potential, slope, bend, gap_after = contact.potential, contact.slope, contact.bend, contact.gap_after
# Triangles that meet share the area of a vertex. The part of one falls to 0 where it is farther than the nearest by SHARING·r.
SHARING = wp.constant(wp.float64(0.25))
# Two edges count less if sin² of the angle between them is below this, and not at all if they are parallel.
PARALLEL = wp.constant(wp.float64(1e-3))
# The share of its way to a plane that a vertex may go in one round of the filter.
KEPT = wp.constant(wp.float64(0.9))
ZERO, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0))
CLAMPED = wp.constant(wp.float64(0.05))  # the least share of the gap that lies between either side and the plane
# A pair needs no plane if its sides approach by less than this share of its gap. It is below 0.9²: y separates nine tenths of
# the gap at least, and of these KEPT may be closed.
WIDE = wp.constant(wp.float64(0.75))
SIDE = wp.constant(wp.float64(0.5))
ULP = wp.constant(wp.float64(1.1920929e-07))  # of float32, over the number, at most
PLANAR = wp.constant(wp.float64(1e-26))  # sin² of the angle between edges below which they have no normal


@cache
def near_pairs(dtype):
    """The struct of the pairs that are near, see :class:`warpcloth.contact.proximity.Proximity`.

    ``counts`` has the number of pairs of a vertex and a triangle, which come first, and that of pairs of edges. Those of vertex
    i with triangles are from ``rows`` [i] to rows[i+1]. The contact of a pair begins at its distance in ``distances`` [m].

    ``acting`` lists the pairs that have an area in a step; there are ``number`` of them, which are few. On the CPU they are in
    order. ``corners`` lists 4·pair + corner of the acting pairs at vertex i from ``first`` [i] to first[i+1], sorted.
    ``corner_counts`` is scratch that is 0 between launches.
    """

    @wp.struct
    class Pairs:
        stencils: wp.array(dtype=wp.vec4i)
        counts: wp.array(dtype=wp.int32)
        rows: wp.array(dtype=wp.int32)
        acting: wp.array(dtype=wp.int32)
        number: wp.array(dtype=wp.int32)
        corner_counts: wp.array(dtype=wp.int32)
        first: wp.array(dtype=wp.int32)
        corners: wp.array(dtype=wp.int32)
        distances: wp.array(dtype=dtype)

    return Pairs


@wp.struct
class StepPairs:
    """n, d, w and kA [N/m] of each pair at the start of a step."""

    normal: wp.array(dtype=wp.vec3d)
    gap: wp.array(dtype=wp.float64)
    weights: wp.array(dtype=wp.vec4d)
    stiffness: wp.array(dtype=wp.float64)


@wp.struct
class PairForces:
    """n, w, kAφ [J], kAφ′ [N] and kAφ″ [N/m] of each pair at some positions."""

    normal: wp.array(dtype=wp.vec3d)
    weights: wp.array(dtype=wp.vec4d)
    energy: wp.array(dtype=wp.float64)
    slope: wp.array(dtype=wp.float64)
    bend: wp.array(dtype=wp.float64)


@wp.struct
class SweptPairs:
    """Of each pair in a Jacobi sweep: whether it touches, its n, w and d, and the λ that it gets."""

    touches: wp.array(dtype=wp.int32)
    normal: wp.array(dtype=wp.vec3d)
    weights: wp.array(dtype=wp.vec4d)
    gap: wp.array(dtype=wp.float64)
    multiplier: wp.array(dtype=wp.float64)


@wp.func
def nearest_on_segment(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    """The t from 0 to 1 of the point a + t(b − a) nearest to p."""
    ab = b - a
    square = wp.dot(ab, ab)
    t = ZERO
    if square > ZERO:
        t = wp.clamp(wp.dot(p - a, ab) / square, ZERO, ONE)
    return t


@wp.func
def vertex_triangle(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """w of the point of a triangle nearest to p, and whether it is inside of the triangle (Ericson 2005, section 5.1.5)."""
    ab = b - a
    ac = c - a
    ap = p - a
    d1 = wp.dot(ab, ap)
    d2 = wp.dot(ac, ap)
    bp = p - b
    d3 = wp.dot(ab, bp)
    d4 = wp.dot(ac, bp)
    cp = p - c
    d5 = wp.dot(ab, cp)
    d6 = wp.dot(ac, cp)
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2
    total = va + vb + vc
    w = wp.vec4d(ONE, -ONE, ZERO, ZERO)
    inside = wp.int32(0)
    if va > ZERO and vb > ZERO and vc > ZERO and total > ZERO:
        w = wp.vec4d(ONE, -va / total, -vb / total, -vc / total)
        inside = 1
    else:  # the nearest of the points of the edges
        t = nearest_on_segment(p, a, b)
        away = p - a - t * ab
        least = wp.dot(away, away)
        w = wp.vec4d(ONE, t - ONE, -t, ZERO)
        t = nearest_on_segment(p, a, c)
        away = p - a - t * ac
        square = wp.dot(away, away)
        if square < least:
            least = square
            w = wp.vec4d(ONE, t - ONE, ZERO, -t)
        t = nearest_on_segment(p, b, c)
        away = p - b - t * (c - b)
        square = wp.dot(away, away)
        if square < least:
            w = wp.vec4d(ONE, ZERO, t - ONE, -t)
    return w, inside


@wp.func
def edge_edge(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """w of the nearest points of two edges ab and cd, and whether both are inside of their edges."""
    ab = b - a
    cd = d - c
    ca = a - c
    # sin² by the cross product, for |ab|²|cd|² − (ab·cd)² of nearly parallel edges has few digits.
    normal = wp.cross(ab, cd)
    determinant = wp.dot(normal, normal)
    w = wp.vec4d(ONE, ZERO, -ONE, ZERO)
    inside = wp.int32(0)
    if determinant > PLANAR * wp.dot(ab, ab) * wp.dot(cd, cd):
        s = wp.dot(wp.cross(cd, ca), normal) / determinant
        t = wp.dot(wp.cross(ab, ca), normal) / determinant
        if s > ZERO and s < ONE and t > ZERO and t < ONE:
            w = wp.vec4d(ONE - s, s, t - ONE, -t)
            inside = 1
    if inside == 0:  # the nearest of an end of one and a point of the other
        t = nearest_on_segment(a, c, d)
        away = a - c - t * cd
        least = wp.dot(away, away)
        w = wp.vec4d(ONE, ZERO, t - ONE, -t)
        t = nearest_on_segment(b, c, d)
        away = b - c - t * cd
        square = wp.dot(away, away)
        if square < least:
            least = square
            w = wp.vec4d(ZERO, ONE, t - ONE, -t)
        s = nearest_on_segment(c, a, b)
        away = a + s * ab - c
        square = wp.dot(away, away)
        if square < least:
            least = square
            w = wp.vec4d(ONE - s, s, -ONE, ZERO)
        s = nearest_on_segment(d, a, b)
        away = a + s * ab - d
        square = wp.dot(away, away)
        if square < least:
            w = wp.vec4d(ONE - s, s, ZERO, -ONE)
    return w, inside


@wp.func
def nearest(of_vertex: bool, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """w, y and whether the nearest points of a pair are inside; points are relative to the first, which keeps their digits."""
    zero = wp.vec3d()
    w = wp.vec4d()
    inside = wp.int32(0)
    if of_vertex:
        w, inside = vertex_triangle(zero, b - a, c - a, d - a)
    else:
        w, inside = edge_edge(zero, b - a, c - a, d - a)
    y = w[1] * (b - a) + w[2] * (c - a) + w[3] * (d - a)
    if inside == 1:  # the weights of nearly parallel edges, and in thin triangles, have too few digits
        normal = wp.cross(b - a, d - c)
        if of_vertex:
            normal = wp.cross(c - b, d - b)
        square = wp.dot(normal, normal)
        if square > ZERO:
            y = wp.dot(normal, a - c) / square * normal
    return w, y, inside


@wp.func
def signed_gap(y: wp.vec3d, normal: wp.vec3d, inside: int):
    """d and n of a pair. If y points against its ``normal`` at the start of the step, it has gone through and d is below 0."""
    d = wp.length(y)
    n = normal
    if d > ZERO:
        n = y / d
        along = wp.dot(n, normal)
        if along < -SIDE or (inside == 1 and along < ZERO):
            d = -d
            n = -n
    return d, n


@wp.func
def gap_along(of_vertex: bool, n: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """The gap between both sides of a pair along n, |n| ≤ 1: a lower bound of its d."""
    y = wp.dot(n, c - a)
    z = wp.dot(n, d - a)
    x = wp.dot(n, b - a)
    found = -wp.max(wp.max(y, z), x)
    if not of_vertex:
        found = wp.min(x, ZERO) - wp.max(y, z)
    return found


@cache
def vertex_of(dtype):
    """The device functions (x, correction, i) → xᵢ or xᵢ + dᵢ in float64, and (v) → v in float64."""
    vec3, _ = types(dtype)

    @wp.func
    def exact(v: vec3):
        return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))

    @wp.func
    def at(x: wp.array(dtype=vec3), correction: wp.array(dtype=vec3), i: int):
        found = exact(x[i])
        if correction:
            found += exact(correction[i])
        return found

    return at, exact


@cache
def module_of(dtype):
    return f"warpcloth.self_contact.{dtype.__name__}"


@cache
def begin_pairs(dtype):
    """Kernel over pairs, where a step begins: n, d and w at x."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def begin_each_pair(
        # elements
        pairs: near_pairs(dtype),
        # state in
        x: wp.array(dtype=vec3),
        # out
        step: StepPairs,
    ):
        e = wp.tid()
        if e >= pairs.counts[0] + pairs.counts[1]:
            return
        s = pairs.stencils[e]
        w, y, _inside = nearest(e < pairs.counts[0], exact(x[s[0]]), exact(x[s[1]]), exact(x[s[2]]), exact(x[s[3]]))
        d = wp.length(y)
        step.gap[e] = d
        step.weights[e] = w
        step.normal[e] = y / wp.max(d, wp.float64(1e-300))

    return begin_each_pair


@wp.func
def share_a_vertex(a: wp.vec4i, b: wp.vec4i):
    """Whether the triangles of two pairs share a vertex."""
    found = wp.bool(False)
    for i in range(1, 4):
        for j in range(1, 4):
            if a[i] == b[j]:
                found = True
    return found


@wp.func
def part_of_area(gap: wp.float64, least: wp.float64, r: wp.float64):
    return wp.max(ONE - (gap - least) / (SHARING * r), ZERO)


@cache
def set_areas(dtype):
    """Kernel over pairs, where a step begins: kA, and which are acting.

    Half the area of a vertex goes to triangles on each side of it. Triangles that meet share this half if they are about
    equally near. The area of a pair of edges is (A₁ + … + A₄)/12. It counts only as far as the pair is nearer than those of its
    vertices with triangles on the same side, and less if the edges are nearly parallel. So crossed folds have contact too, and
    where two layers lie flat on one another the areas of all pairs add up to that of one layer.
    """
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def set_each_area(
        # elements
        pairs: near_pairs(dtype),
        areas: wp.array(dtype=wp.float64),
        # state in
        x: wp.array(dtype=vec3),
        # parameters
        stiffness: wp.float64,
        # in and out
        step: StepPairs,
    ):
        e = wp.tid()
        triangles = pairs.counts[0]
        if e >= triangles + pairs.counts[1]:
            return
        s = pairs.stencils[e]
        r = wp.float64(pairs.distances[e])
        n = step.normal[e]
        gap = step.gap[e]
        area = ZERO
        if e < triangles:
            first = pairs.rows[s[0]]
            end = pairs.rows[s[0] + 1]
            least = gap
            for other in range(first, end):
                if share_a_vertex(s, pairs.stencils[other]) and wp.dot(n, step.normal[other]) > ZERO:
                    least = wp.min(least, step.gap[other])
            own = part_of_area(gap, least, r)
            if own > ZERO:
                total = ZERO
                for other in range(first, end):
                    if share_a_vertex(s, pairs.stencils[other]) and wp.dot(n, step.normal[other]) > ZERO:
                        total += part_of_area(step.gap[other], least, r)
                area = SIDE * areas[s[0]] * own / total
        else:
            least = wp.float64(wp.inf)
            for i in range(4):
                sign = wp.where(i < 2, ONE, -ONE)
                for other in range(pairs.rows[s[i]], pairs.rows[s[i] + 1]):
                    if least <= gap and least < wp.float64(wp.inf):
                        break  # most end here
                    if step.gap[other] < least and sign * wp.dot(n, step.normal[other]) > SIDE:
                        least = step.gap[other]
            nearer = ONE
            if least < wp.float64(wp.inf):
                nearer = wp.clamp((least - gap) / (SHARING * r), ZERO, ONE)
            if nearer > ZERO:
                ab = exact(x[s[1]]) - exact(x[s[0]])
                cd = exact(x[s[3]]) - exact(x[s[2]])
                normal = wp.cross(ab, cd)
                z = wp.min(wp.dot(normal, normal) / (PARALLEL * wp.dot(ab, ab) * wp.dot(cd, cd)), ONE)
                total = areas[s[0]] + areas[s[1]] + areas[s[2]] + areas[s[3]]
                area = nearer * z * (wp.float64(2.0) - z) * total / wp.float64(12.0)
        step.stiffness[e] = stiffness * area
        if area > ZERO:
            pairs.acting[wp.atomic_add(pairs.number, 0, 1)] = e
            for i in range(4):
                wp.atomic_add(pairs.corner_counts, s[i], 1)

    return set_each_area


@cache
def fill_corners(dtype):
    """Kernel over pairs: lists the corners of acting pairs at each vertex. It counts ``corner_counts`` down to 0."""

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def fill_each_corner(
        # in and out
        pairs: near_pairs(dtype),
    ):
        t = pairs.number[0] - 1 - wp.tid()
        if t >= 0:
            e = pairs.acting[t]
            s = pairs.stencils[e]
            for i in range(4):
                pairs.corners[pairs.first[s[i]] + wp.atomic_sub(pairs.corner_counts, s[i], 1) - 1] = 4 * e + i

    return fill_each_corner


@cache
def sort_corners(dtype):
    """Kernel over vertices: sorts the corners of each."""

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def sort_each(
        # in and out
        pairs: near_pairs(dtype),
    ):
        i = wp.tid()
        sort(pairs.corners, pairs.first[i], pairs.first[i + 1])

    return sort_each


@cache
def find_forces(dtype, bounded: bool):
    """Kernel over acting pairs: kAφ, kAφ′, kAφ″, w and n at x, or x + correction; of ``bounded`` contact φ = ½(r − d)²."""
    vec3, _ = types(dtype)
    at, _exact = vertex_of(dtype)

    @wp.kernel(module=f"{module_of(dtype)}.{bounded}", enable_backward=False)
    def find_forces_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        step: StepPairs,
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        # out
        forces: PairForces,
    ):
        t = wp.tid()
        if t >= pairs.number[0]:
            return
        e = pairs.acting[t]
        forces.energy[e] = ZERO
        forces.slope[e] = ZERO
        forces.bend[e] = ZERO
        k = step.stiffness[e]
        r = wp.float64(pairs.distances[e])
        s = pairs.stencils[e]
        a = at(x, correction, s[0])
        b = at(x, correction, s[1])
        c = at(x, correction, s[2])
        d = at(x, correction, s[3])
        of_vertex = e < pairs.counts[0]
        if gap_along(of_vertex, step.normal[e], a, b, c, d) >= r:
            return
        w, y, inside = nearest(of_vertex, a, b, c, d)
        gap, n = signed_gap(y, step.normal[e], inside)
        if gap < r:
            forces.normal[e] = n
            forces.weights[e] = w
            if wp.static(bounded):
                forces.energy[e] = SIDE * k * (r - gap) * (r - gap)
                forces.slope[e] = k * (gap - r)
                forces.bend[e] = k
            else:
                forces.energy[e] = k * potential(gap, r)
                forces.slope[e] = k * slope(gap, r)
                forces.bend[e] = k * bend(gap, r)

    return find_forces_of_pairs


@cache
def add_forces(dtype):
    """Kernel over vertices: out += ∂U/∂x, in the order of the pairs."""
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def add_forces_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        forces: PairForces,
        # in and out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        total = wp.vec3d()
        for k in range(pairs.first[i], pairs.first[i + 1]):
            e = pairs.corners[k] // 4
            if forces.slope[e] != ZERO:
                total += forces.weights[e][pairs.corners[k] - 4 * e] * forces.slope[e] * forces.normal[e]
        out[i] = out[i] + vec3(dtype(total[0]), dtype(total[1]), dtype(total[2]))

    return add_forces_of_pairs


@cache
def sum_energies(dtype):
    """Kernel over vertices: the energies of the pairs of which a vertex is the first [J]."""

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def sum_energies_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        forces: PairForces,
        # out
        energies: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        total = ZERO
        for k in range(pairs.first[i], pairs.first[i + 1]):
            if pairs.corners[k] % 4 == 0:
                total += forces.energy[pairs.corners[k] // 4]
        energies[i] = total

    return sum_energies_of_pairs


@cache
def add_diagonal(dtype):
    """Kernel over vertices: adds Σ kAφ″ wᵢ²nnᵀ to the diagonal blocks of a Hessian; nothing to those of pins."""
    _, mat33 = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def add_diagonal_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=dtype),
        diagonal: wp.array(dtype=wp.int32),
        # state in
        forces: PairForces,
        # in and out
        values: wp.array(dtype=mat33),
    ):
        i = wp.tid()
        if inverse_mass[i] == dtype(0.0):
            return
        total = wp.mat33d()
        for k in range(pairs.first[i], pairs.first[i + 1]):
            e = pairs.corners[k] // 4
            if forces.bend[e] != ZERO:
                w = forces.weights[e][pairs.corners[k] - 4 * e]
                total += forces.bend[e] * w * w * wp.outer(forces.normal[e], forces.normal[e])
        values[diagonal[i]] = values[diagonal[i]] + mat33(total)

    return add_diagonal_of_pairs


@cache
def add_products(dtype):
    """Kernel over vertices: q += Σ kAφ″ wᵢ n Σⱼ wⱼ nᵀpⱼ over the other corners j of its pairs, of copies that are active."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def add_products_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=dtype),
        # state in
        forces: PairForces,
        p: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        # in and out
        q: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if inverse_mass[i] == dtype(0.0) or active[i // per_copy] == 0:
            return
        total = wp.vec3d()
        for k in range(pairs.first[i], pairs.first[i + 1]):
            e = pairs.corners[k] // 4
            if forces.bend[e] != ZERO:
                corner = pairs.corners[k] - 4 * e
                s = pairs.stencils[e]
                w = forces.weights[e]
                n = forces.normal[e]
                along = ZERO
                for j in range(4):
                    if j != corner and inverse_mass[s[j]] > dtype(0.0):
                        along += w[j] * wp.dot(n, exact(p[s[j]]))
                total += forces.bend[e] * w[corner] * along * n
        q[i] = q[i] + vec3(dtype(total[0]), dtype(total[1]), dtype(total[2]))

    return add_products_of_pairs


@cache
def free_move(dtype, axes: bool):
    """The device function (inverse masses, i, v) → W v, in float64; inverse masses are those of each axis with ``axes``."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.func
    def alike(inverse_mass: wp.array(dtype=dtype), i: int, v: wp.vec3d):
        return wp.float64(inverse_mass[i]) * v

    @wp.func
    def by_axis(inverse_mass: wp.array(dtype=vec3), i: int, v: wp.vec3d):
        return wp.cw_mul(exact(inverse_mass[i]), v)

    return by_axis if axes else alike


@cache
def sweep_pairs(dtype, axes: bool):
    """Kernel of one thread: each acting pair in turn takes its force away, then adds that of the prox at the gap without it.

    With d̂ = n·Σwᵢxᵢ without the force of the pair and W = Σ wᵢ²/mᵢ, λ = (d* − d̂)/W, where d* solves
    (d* − d̂)/W = −kAhₑ²φ′(d*) in closed form, and Δxᵢ = wᵢ λ n/mᵢ. M(x − x̃) = Σ wᵢλn then holds with the n and w that pairs have
    at x, and a fixed point is the minimiser of the step. Without ``multipliers`` nothing is taken away (PBD).
    """
    vec3, _ = types(dtype)
    at, _exact = vertex_of(dtype)
    moved = free_move(dtype, axes)

    @wp.kernel(module="unique", enable_backward=False)
    def sweep_each_pair(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=vec3 if axes else dtype),
        # state in
        step: StepPairs,
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
        for turn in range(count):
            e = pairs.acting[wp.where(backward, count - 1 - turn, turn)]
            k = step.stiffness[e]
            r = wp.float64(pairs.distances[e])
            s = pairs.stencils[e]
            before = ZERO
            if multipliers:
                before = multipliers[e]
            a = at(x, correction, s[0])
            b = at(x, correction, s[1])
            c = at(x, correction, s[2])
            d = at(x, correction, s[3])
            of_vertex = e < pairs.counts[0]
            if before != ZERO or gap_along(of_vertex, step.normal[e], a, b, c, d) < r:
                w, y, inside = nearest(of_vertex, a, b, c, d)
                gap, n = signed_gap(y, step.normal[e], inside)
                if before != ZERO or gap < r:
                    W = ZERO
                    left = gap
                    for i in range(4):
                        push = w[i] * moved(inverse_mass, s[i], n)
                        W += w[i] * wp.dot(n, push)
                        if before != ZERO:
                            left -= forces.weights[e][i] * before * wp.dot(push, forces.normal[e])
                    after = ZERO
                    if W > ZERO and left < r:
                        compliance = wp.float64(wp.inf)
                        if not hard:
                            compliance = W * k * h * h
                        after = (gap_after(left, r, compliance) - left) / W
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
def touch_pairs(dtype):
    """Kernel over acting pairs of a Jacobi sweep: n, w and d where they touch or have a force; λ is of :func:`press_pairs`."""
    vec3, _ = types(dtype)
    at, _exact = vertex_of(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
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
        s = pairs.stencils[e]
        r = wp.float64(pairs.distances[e])
        a = at(x, correction, s[0])
        b = at(x, correction, s[1])
        c = at(x, correction, s[2])
        d = at(x, correction, s[3])
        of_vertex = e < pairs.counts[0]
        if before == ZERO and gap_along(of_vertex, step.normal[e], a, b, c, d) >= r:
            return
        w, y, inside = nearest(of_vertex, a, b, c, d)
        gap, n = signed_gap(y, step.normal[e], inside)
        if before != ZERO or gap < r:
            swept.touches[e] = 1
            swept.gap[e] = gap
            swept.weights[e] = w
            swept.normal[e] = n

    return touch_each_pair


@cache
def count_touching(dtype):
    """Kernel over vertices: how many pairs of a vertex touch."""

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def count_touching_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        swept: SweptPairs,
        # out
        touching: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        total = ZERO
        for k in range(pairs.first[i], pairs.first[i + 1]):
            total += wp.float64(swept.touches[pairs.corners[k] // 4])
        touching[i] = total

    return count_touching_pairs


@cache
def press_pairs(dtype, axes: bool):
    """Kernel over acting pairs of a Jacobi sweep: the λ of the prox, with D = Σ nᵢwᵢ²/mᵢ for W; nᵢ pairs touch at i.

    D is at least J W Jᵀ of all of them, so the sum of the moves never overshoots. The fixed point is that of
    :func:`sweep_pairs`.
    """
    moved = free_move(dtype, axes)
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def press_each_pair(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=vec3 if axes else dtype),
        # state in
        step: StepPairs,
        touching: wp.array(dtype=wp.float64),
        multipliers: wp.array(dtype=wp.float64),
        # parameters
        h: wp.float64,
        hard: bool,
        # in and out
        swept: SweptPairs,
    ):
        t = wp.tid()
        if t >= pairs.number[0]:
            return
        e = pairs.acting[t]
        if swept.touches[e] == 0:
            return
        s = pairs.stencils[e]
        r = wp.float64(pairs.distances[e])
        n = swept.normal[e]
        D = ZERO
        for i in range(4):
            w = swept.weights[e][i]
            D += touching[s[i]] * w * w * wp.dot(n, moved(inverse_mass, s[i], n))
        left = swept.gap[e]
        if multipliers:
            left -= D * multipliers[e]
        after = ZERO
        if D > ZERO and left < r:
            compliance = wp.float64(wp.inf)
            if not hard:
                compliance = D * step.stiffness[e] * h * h
            after = (gap_after(left, r, compliance) - left) / D
        swept.multiplier[e] = after

    return press_each_pair


@cache
def move_by_pairs(dtype, axes: bool):
    """Kernel over vertices of a Jacobi sweep: d += W Σ wᵢ(λn − λ'n') over the pairs that touch, λ'n' of the last sweep."""
    vec3, _ = types(dtype)
    moved = free_move(dtype, axes)

    @wp.kernel(module="unique", enable_backward=False)
    def move_each_by_pairs(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=vec3 if axes else dtype),
        # state in
        swept: SweptPairs,
        multipliers: wp.array(dtype=wp.float64),
        forces: PairForces,
        # in and out
        correction: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        total = wp.vec3d()
        for k in range(pairs.first[i], pairs.first[i + 1]):
            e = pairs.corners[k] // 4
            if swept.touches[e] == 1:
                corner = pairs.corners[k] - 4 * e
                total += swept.weights[e][corner] * swept.multiplier[e] * swept.normal[e]
                if multipliers:
                    if multipliers[e] != ZERO:
                        total -= forces.weights[e][corner] * multipliers[e] * forces.normal[e]
        move = moved(inverse_mass, i, total)
        correction[i] = correction[i] + vec3(dtype(move[0]), dtype(move[1]), dtype(move[2]))

    return move_each_by_pairs


@cache
def keep_pairs(dtype):
    """Kernel over acting pairs of a Jacobi sweep: keeps λ, w and n for the next sweep."""

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def keep_each_pair(
        # elements
        pairs: near_pairs(dtype),
        # state in
        swept: SweptPairs,
        # out
        multipliers: wp.array(dtype=wp.float64),
        forces: PairForces,
    ):
        t = wp.tid()
        if t >= pairs.number[0]:
            return
        e = pairs.acting[t]
        if swept.touches[e] == 1:
            multipliers[e] = swept.multiplier[e]
            forces.weights[e] = swept.weights[e]
            forces.normal[e] = swept.normal[e]

    return keep_each_pair


@cache
def wanted_move(dtype):
    """The device function (x, target, direction, i) → the wanted move of vertex i: its direction, or to its target if None."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.func
    def wanted(x: wp.array(dtype=vec3), target: wp.array(dtype=vec3), direction: wp.array(dtype=vec3), i: int):
        found = wp.vec3d()
        if direction:
            found = exact(direction[i])
        else:
            found = exact(target[i]) - exact(x[i])
        return found

    return wanted


@cache
def find_ways(dtype):
    """Kernel over vertices: a bound on how much each brings a pair nearer [m], its largest coordinate [m], and a share of 1.

    The bound adds up two lengths: that of the wanted move less the ``common`` move, and WIDE times that of the motion since
    ``begun``, where the gaps were found, less the motion of the first vertex of the copy.
    """
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    wanted = wanted_move(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def find_each_way(
        # state in
        x: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        common: wp.array(dtype=wp.vec3d),
        begun: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        # out
        ways: wp.array(dtype=wp.vec2d),
        share: wp.array(dtype=wp.float64),
        least_share: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        start = exact(x[i])
        move = wanted(x, target, direction, i)
        far = wp.max(wp.max(wp.abs(start)), wp.max(wp.abs(start + move)))
        one = i - i % per_copy
        since = start - exact(begun[i]) - (exact(x[one]) - exact(begun[one]))
        ways[i] = wp.vec2d(wp.length(move - common[i // per_copy]) + WIDE * wp.length(since), far)
        share[i] = ONE
        least_share[i] = ZERO

    return find_each_way


@wp.func
def margin_of(least: wp.float64, far: wp.float64):
    """Half the distance that two sides keep, where no coordinate is above ``far``.

    So 4 units in the last place of float32 remain between the sides; frames are stored in float32.
    """
    ulp = ULP * far
    return SIDE * wp.max(least, wp.float64(4.0) * ulp) + ulp


@cache
def cut_by_planes(dtype):
    """Kernel over pairs: lowers the ``share`` of its wanted move from x that each vertex may make.

    A plane normal to y lies between the two sides, and divides their gap, less the distance that they keep, in the ratio of
    their approaches; each side has at least CLAMPED of it. The ``common`` move of all vertices of a copy does not count as an
    approach. A pair that is ``open`` gets no plane, nor does one whose ``gap`` is so wide that no plane would cut the moves
    that :func:`find_ways` bounds.

    A vertex that is as near to a plane as it may be, and does not approach it, moves by the ``least_share`` or more, or not at
    all: the roundings of shorter moves, which are alike in many steps, would take it nearer.
    """
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    wanted = wanted_move(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def cut_by_each_plane(
        # elements
        pairs: near_pairs(dtype),
        gap: wp.array(dtype=wp.float64),
        open: wp.array(dtype=wp.int32),
        # state in
        x: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        common: wp.array(dtype=wp.vec3d),
        ways: wp.array(dtype=wp.vec2d),
        # parameters
        per_copy: int,
        least: wp.float64,
        # in and out
        share: wp.array(dtype=wp.float64),
        least_share: wp.array(dtype=wp.float64),
    ):
        e = wp.tid()
        if e >= pairs.counts[0] + pairs.counts[1]:
            return
        s = pairs.stencils[e]
        of_vertex = e < pairs.counts[0]
        sides = wp.where(of_vertex, 1, 2)
        way = wp.vec2d()
        far = ZERO
        for i in range(4):
            each = ways[s[i]]
            far = wp.max(far, each[1])
            if i < sides:
                way[0] = wp.max(way[0], each[0])
            else:
                way[1] = wp.max(way[1], each[0])
        margin = margin_of(least, far)
        if gap:
            # However the gap is divided, approaches that add up to so much or less are not cut.
            if way[0] + way[1] <= WIDE * gap[e] - KEPT / CLAMPED * margin:
                return
        if open:
            if open[e] != 0:
                return
        origin = exact(x[s[0]])
        _w, y, _inside = nearest(of_vertex, origin, exact(x[s[1]]), exact(x[s[2]]), exact(x[s[3]]))
        n = y / wp.max(wp.length(y), wp.float64(1e-300))
        lowest = wp.float64(wp.inf)
        highest = -wp.float64(wp.inf)
        first = ZERO
        second = ZERO
        position = wp.vec4d()
        approaches = wp.vec4d()
        for i in range(4):
            move = wanted(x, target, direction, s[i])
            approach = wp.dot(n, move - common[s[i] // per_copy])
            along = wp.dot(n, exact(x[s[i]]) - origin)
            position[i] = along
            if i < sides:
                approaches[i] = -approach
                lowest = wp.min(lowest, along)
                first = wp.max(first, -approach)
            else:
                approaches[i] = approach
                highest = wp.max(highest, along)
                second = wp.max(second, approach)
        part = SIDE
        if first + second > ZERO:
            part = wp.clamp(second / (first + second), CLAMPED, ONE - CLAMPED)
        if lowest - highest < KEPT * wp.length(y):  # by rounding y does not separate the sides, which then stay
            for i in range(4):
                wp.atomic_min(share, s[i], ZERO)
            return
        between = wp.max(lowest - highest - wp.float64(2.0) * margin, ZERO)
        for i in range(4):
            room = highest - position[i] + part * between
            if i < sides:
                room = position[i] - lowest + (ONE - part) * between
            if approaches[i] > ZERO:
                t = KEPT * room / approaches[i]
                if t < share[s[i]]:
                    wp.atomic_min(share, s[i], t)
            elif room <= ZERO:
                wp.atomic_max(least_share, s[i], ULP * far / wp.max(-approaches[i], wp.float64(1e-300)))

    return cut_by_each_plane


@wp.func
def bounded_share(move: wp.vec3d, most: wp.float64):
    """The largest share of a move, up to 1, that is no longer than ``most``."""
    size = wp.length(move)
    far = ONE
    if size > most:
        far = most / size
    return far


@cache
def keep_apart(dtype):
    """Kernel over vertices: x ← x + u + t(δ − u), u the ``common`` move, t at most the ``share`` that planes leave.

    ``most`` bounds t‖δ − u‖, so that pairs that are not listed cannot cross. ``cuts`` (B, 2) counts the vertices that planes
    cut short, and those that this bound alone cut short. Copies that do not ``walk`` stay.
    """
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def keep_each_apart(
        # state in
        share: wp.array(dtype=wp.float64),
        least_share: wp.array(dtype=wp.float64),
        x_ref: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        common: wp.array(dtype=wp.vec3d),
        walk: wp.array(dtype=wp.int32),
        # parameters
        per_copy: int,
        most: wp.float64,
        # out
        x: wp.array(dtype=vec3),
        cuts: wp.array2d(dtype=wp.int32),
    ):
        i = wp.tid()
        copy = i // per_copy
        if walk[copy] == 0:
            return
        u = common[copy]
        move = exact(target[i]) - exact(x_ref[i]) - u
        far = bounded_share(move, most)
        t = wp.min(far, share[i])
        if t < ONE:
            if t < least_share[i]:
                t = ZERO
            end = exact(x_ref[i]) + u + t * move
            x[i] = vec3(dtype(end[0]), dtype(end[1]), dtype(end[2]))
            wp.atomic_add(cuts, copy, wp.where(share[i] < far, 0, 1), 1)
        else:
            x[i] = target[i]

    return keep_each_apart


@cache
def limit_direction(dtype):
    """Kernel over vertices: p ← u + t(p − u), as :func:`keep_apart`."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def limit_each_direction(
        # state in
        share: wp.array(dtype=wp.float64),
        common: wp.array(dtype=wp.vec3d),
        # parameters
        per_copy: int,
        most: wp.float64,
        # in and out
        direction: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        u = common[i // per_copy]
        move = exact(direction[i]) - u
        t = wp.min(bounded_share(move, most), share[i])
        if t < ONE:
            end = u + t * move
            direction[i] = vec3(dtype(end[0]), dtype(end[1]), dtype(end[2]))

    return limit_each_direction


@cache
def shorten(dtype):
    """Kernel over vertices: p ← p most/max‖pⱼ‖ in copies where that shortens it."""
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def shorten_each_direction(
        # state in
        longest: wp.array(dtype=wp.float64),
        # parameters
        per_copy: int,
        most: wp.float64,
        # in and out
        p: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if longest[i // per_copy] > most:
            p[i] = dtype(most / longest[i // per_copy]) * p[i]

    return shorten_each_direction


@cache
def precondition(dtype):
    """Kernel over vertices: p = P r."""
    vec3, mat33 = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def precondition_each(
        # state in
        preconditioner: wp.array(dtype=mat33),
        r: wp.array(dtype=vec3),
        # out
        p: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        p[i] = preconditioner[i] * r[i]

    return precondition_each


@cache
def take_descent(dtype):
    """Kernel over vertices: p = the other direction, in copies where the slope along p is not below 0."""
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def take_each_descent(
        # state in
        slope: wp.array(dtype=wp.float64),
        other: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        # in and out
        p: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if not slope[i // per_copy] < ZERO:
            p[i] = other[i]

    return take_each_descent


@cache
def add_positions(dtype):
    """Kernel over vertices: out = a + sign·b."""
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def add_each_position(
        # state in
        a: wp.array(dtype=vec3),
        b: wp.array(dtype=vec3),
        # parameters
        sign: dtype,
        # out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        out[i] = a[i] + sign * b[i]

    return add_each_position


@cache
def common_move(dtype):
    """Kernel over copies: the mean of the moves of all vertices that are wanted [m]."""
    vec3, _ = types(dtype)
    wanted = wanted_move(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def find_common_move(
        # state in
        x: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        # out
        common: wp.array(dtype=wp.vec3d),
    ):
        copy = wp.tid()
        total = wp.vec3d()
        for i in range(copy * per_copy, (copy + 1) * per_copy):
            total += wanted(x, target, direction, i)
        common[copy] = total / wp.float64(per_copy)

    return find_common_move


@cache
def walk_from_start(dtype):
    """Kernel over vertices: sets x to where the step began, in copies whose colliders have cut a move since ``before``."""
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def walk_each_from_start(
        # state in
        x_before: wp.array(dtype=vec3),
        before: wp.array(dtype=wp.int64),
        cut: wp.array(dtype=wp.int64),
        # parameters
        per_copy: int,
        # out
        x: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if cut[i // per_copy] > before[i // per_copy]:
            x[i] = x_before[i]

    return walk_each_from_start


@cache
def find_held(dtype):
    """Kernel over vertices: sets ``within`` if any must move to get ``outside`` of colliders; ``mobile`` is 1/m, 0 of those.

    After ``most`` turns ``within`` is not set any more.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def find_each_held(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        # state in
        x: wp.array(dtype=vec3),
        outside: wp.array(dtype=vec3),
        turns: wp.array(dtype=wp.int32),
        # parameters
        most: int,
        # out
        mobile: wp.array(dtype=dtype),
        within: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        w = inverse_mass[i]
        if wp.length_sq(outside[i] - x[i]) > dtype(0.0):
            w = dtype(0.0)
            if turns[0] < most:
                within[0] = 1
        mobile[i] = w

    return find_each_held


@cache
def push_pairs(dtype):
    """Kernel of one thread: each pair in turn moves its targets apart along n, to its gap at x or to ``left`` if less."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def push_each_pair(
        # elements
        pairs: near_pairs(dtype),
        mobile: wp.array(dtype=dtype),
        # state in
        step: StepPairs,
        x: wp.array(dtype=vec3),
        # parameters
        left: wp.float64,
        # in and out
        target: wp.array(dtype=vec3),
    ):
        count = wp.min(pairs.counts[0] + pairs.counts[1], pairs.stencils.shape[0])
        for e in range(count):
            s = pairs.stencils[e]
            n = step.normal[e]
            w = step.weights[e]
            gap = step.gap[e]
            W = ZERO
            for i in range(4):
                W += w[i] * w[i] * wp.float64(mobile[s[i]])
                gap += w[i] * wp.dot(n, exact(target[s[i]]) - exact(x[s[i]]))
            short = wp.min(step.gap[e], left) - gap
            if short > ZERO and W > ZERO:
                for i in range(4):
                    move = w[i] * wp.float64(mobile[s[i]]) * short / W * n
                    target[s[i]] = target[s[i]] + vec3(dtype(move[0]), dtype(move[1]), dtype(move[2]))

    return push_each_pair


@cache
def end_filter(dtype):
    """Kernel over vertices: adds the change of x by the filter to ``move``, which may be None, and over h to v; counts them."""
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def end_each_filter(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        # state in
        target: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        h: dtype,
        # in and out
        v: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        cut: wp.array(dtype=wp.int64),
    ):
        i = wp.tid()
        change = x[i] - target[i]
        if wp.length_sq(change) > dtype(0.0):
            wp.atomic_add(cut, i // per_copy, wp.int64(1))
            v[i] = v[i] + change / h
            if move:
                move[i] = move[i] + change

    return end_each_filter


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def another_round(
    # parameters
    few: int,
    near_rounds: int,
    far_rounds: int,
    # in and out
    cuts: wp.array2d(dtype=wp.int32),
    rounds: wp.array(dtype=wp.int32),
    # out
    walk: wp.array(dtype=wp.int32),
    proceed: wp.array(dtype=wp.int32),
):
    """Kernel over copies: whether a copy walks on in another round.

    It does so while planes cut more than ``few`` vertices, for at most ``near_rounds``, and while the bound of the list cuts
    one, for at most ``far_rounds``. ``proceed`` is 1 if any copy walks on.
    """
    c = wp.tid()
    rounds[c] = rounds[c] + 1
    walk[c] = 0
    if (cuts[c, 0] > few and rounds[c] < near_rounds) or (cuts[c, 1] > 0 and rounds[c] < far_rounds):
        walk[c] = 1
        proceed[0] = 1
    cuts[c, 0] = 0
    cuts[c, 1] = 0


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def note_list(
    # state in
    counts: wp.array(dtype=wp.int32),
    # parameters
    made: int,
    # in and out
    most: wp.array(dtype=wp.int32),
    lists: wp.array(dtype=wp.int32),
    # out
    listed: wp.array(dtype=wp.int32),
):
    """Kernel over copies: the most pairs in any list; how many lists, ``made`` of them new; and whether this has pairs."""
    c = wp.tid()
    if c == 0:
        listed[0] = wp.min(counts[0] + counts[1], 1)
    most[c] = wp.max(most[c], counts[0] + counts[1])
    lists[c] = lists[c] + made
