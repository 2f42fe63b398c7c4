"""Nearest points of a vertex and a triangle, or of two edges, and the gap between them, in float64.

A pair has four vertices. y = Σ wᵢxᵢ is the vector between its nearest points, with w = (1, −β₁, −β₂, −β₃) for a vertex and a
triangle, and (1 − s, s, −(1 − t), −t) for two edges. The gap is d = ±‖y‖. It is negative if the pair passed through one another
in the step, that is, if y is opposite to the normal n at the start of the step.
"""

from functools import cache

import warp as wp

from ..memory import load
from ..vectors import types

# Constants for all kernels of pairs.
ZERO, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0))
SIDE = wp.constant(wp.float64(0.5))
PLANAR = wp.constant(wp.float64(1e-26))  # sin² of the angle between edges below which they have no normal


@wp.func
def nearest_on_segment(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    """The t in [0, 1] of the point a + t(b − a) nearest to p."""
    ab = b - a
    square = wp.dot(ab, ab)
    t = ZERO
    if square > ZERO:
        t = wp.clamp(wp.dot(p - a, ab) / square, ZERO, ONE)
    return t


@wp.func
def vertex_triangle(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """w of p and the nearest point of a triangle, and whether that is in its interior (Ericson 2005, section 5.1.5)."""
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
    else:  # the nearest of the nearest points of the edges
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
    """w of the nearest points of two edges ab and cd, and whether both are in the interior of their edges."""
    ab = b - a
    cd = d - c
    ca = a - c
    # sin² from the cross product, because |ab|²|cd|² − (ab·cd)² cancels for nearly parallel edges.
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
    if inside == 0:  # an end of one edge is nearest to the other
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
    """w, y and whether the nearest points are interior; computed relative to the first vertex, which keeps digits."""
    zero = wp.vec3d()
    w = wp.vec4d()
    inside = wp.int32(0)
    if of_vertex:
        w, inside = vertex_triangle(zero, b - a, c - a, d - a)
    else:
        w, inside = edge_edge(zero, b - a, c - a, d - a)
    y = w[1] * (b - a) + w[2] * (c - a) + w[3] * (d - a)
    if inside == 1:  # for nearly parallel edges and thin triangles, y from the weights would have too few digits
        normal = wp.cross(b - a, d - c)
        if of_vertex:
            normal = wp.cross(c - b, d - b)
        square = wp.dot(normal, normal)
        if square > ZERO:
            y = wp.dot(normal, a - c) / square * normal
    return w, y, inside


@wp.func
def signed_gap(y: wp.vec3d, normal: wp.vec3d, inside: int):
    """d and n of a pair. If y is opposite to its ``normal`` at the start of the step, it passed through, and d is negative."""
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
    """The gap between the two sides of a pair along n, |n| ≤ 1, which is a lower bound of d."""
    y = wp.dot(n, c - a)
    z = wp.dot(n, d - a)
    x = wp.dot(n, b - a)
    found = -wp.max(wp.max(y, z), x)
    if not of_vertex:
        found = wp.min(x, ZERO) - wp.max(y, z)
    return found


@cache
def vertex_of(dtype):
    """Device functions (x, correction, i) → xᵢ or xᵢ + dᵢ in float64, and (v) → v in float64."""
    vec3, _ = types(dtype)
    vector = load(vec3)

    @wp.func
    def exact(v: vec3):
        return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))

    @wp.func
    def at(x: wp.array(dtype=vec3), correction: wp.array(dtype=vec3), i: int):
        found = exact(vector(x, i))
        if correction:
            found += exact(vector(correction, i))
        return found

    return at, exact
