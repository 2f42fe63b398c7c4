"""Nearest points of a vertex and a triangle, or of two edges, and the gap between them, in float64.

y = Σ wᵢxᵢ is the vector between the nearest points of the four vertices of a pair, with w = (1, −β₁, −β₂, −β₃) for a vertex and
a triangle, and (1 − s, s, −(1 − t), −t) for two edges. The gap is d = ‖y‖.
"""

from functools import cache
from typing import Any

import warp as wp

from ..memory import load
from ..vectors import types

# Constants for all kernels of pairs.
ZERO, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0))
SIDE = wp.constant(wp.float64(0.5))
CORNERS = wp.types.matrix((4, 3), wp.float64)  # of a pair: the positions of its vertices, or their moves [m]
PLANAR = wp.constant(wp.float64(1e-26))  # sin² of the angle between edges below which they have no normal
ON_EDGE = wp.constant(wp.float64(1e-10))  # coordinates below are 0: rounding must not decide between a face and its edge
# Where the nearest point of a face is: inside, on the edges ab, bc, ca from EDGE on, or at the vertices a, b, c from CORNER on.
INSIDE, EDGE, CORNER = (wp.constant(code) for code in (0, 1, 4))


@wp.func
def nearest_on_segment(p: wp.vec3d, ab: wp.vec3d):
    """The t in [0, 1] of the point t ab nearest to p, and the square of its distance."""
    square = wp.dot(ab, ab)
    t = wp.clamp(wp.dot(p, ab) / wp.where(square > ZERO, square, ONE), ZERO, ONE)
    away = p - t * ab
    return t, wp.dot(away, away)


@wp.func
def in_plane(inside: bool, y: wp.vec3d, normal: wp.vec3d, a: wp.vec3d):
    """y if it is not of points ``inside``, else −a along ``normal``.

    For nearly parallel edges and thin triangles, y from the weights would have too few digits.
    """
    square = wp.dot(normal, normal)
    along = -wp.dot(normal, a) / wp.where(square > ZERO, square, ONE)
    normally = inside and square > ZERO
    return wp.vec3d(
        wp.where(normally, along * normal[0], y[0]),
        wp.where(normally, along * normal[1], y[1]),
        wp.where(normally, along * normal[2], y[2]),
    )


# The next two functions have no branches, so that the compiler vectorises loops of them.
@wp.func
def vertex_triangle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """w and y of the vertex 0 and a triangle, and whether the nearest point is in its interior (Ericson 2005, 5.1.5)."""
    ab = b - a
    ac = c - a
    d1 = -wp.dot(ab, a)
    d2 = -wp.dot(ac, a)
    d3 = -wp.dot(ab, b)
    d4 = -wp.dot(ac, b)
    d5 = -wp.dot(ab, c)
    d6 = -wp.dot(ac, c)
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2
    total = va + vb + vc
    inside = va > ZERO and vb > ZERO and vc > ZERO and total > ZERO
    # Else the nearest of the nearest points of the edges.
    t, least = nearest_on_segment(-a, ab)
    w1 = t - ONE
    w2 = -t
    w3 = ZERO
    t, square = nearest_on_segment(-a, ac)
    nearer = square < least
    least = wp.where(nearer, square, least)
    w1 = wp.where(nearer, t - ONE, w1)
    w2 = wp.where(nearer, ZERO, w2)
    w3 = wp.where(nearer, -t, w3)
    t, square = nearest_on_segment(-b, c - b)
    nearer = square < least
    w1 = wp.where(nearer, ZERO, w1)
    w2 = wp.where(nearer, t - ONE, w2)
    w3 = wp.where(nearer, -t, w3)
    total = wp.where(inside, total, ONE)
    w1 = wp.where(inside, -va / total, w1)
    w2 = wp.where(inside, -vb / total, w2)
    w3 = wp.where(inside, -vc / total, w3)
    y = w1 * a + w2 * b + w3 * c
    return wp.vec4d(ONE, w1, w2, w3), in_plane(inside, y, wp.cross(ab, ac), b), wp.where(inside, 1, 0)


@wp.func
def edge_edge(b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """w and y of the edges 0b and cd, and whether both nearest points are in the interior of their edges."""
    cd = d - c
    # sin² from the cross product, because |b|²|cd|² − (b·cd)² cancels for nearly parallel edges.
    normal = wp.cross(b, cd)
    determinant = wp.dot(normal, normal)
    crossing = determinant > PLANAR * wp.dot(b, b) * wp.dot(cd, cd)
    divisor = wp.where(crossing, determinant, ONE)
    s = wp.dot(wp.cross(cd, -c), normal) / divisor
    t = wp.dot(wp.cross(b, -c), normal) / divisor
    inside = crossing and s > ZERO and s < ONE and t > ZERO and t < ONE
    # Else an end of one edge is nearest to the other.
    u, least = nearest_on_segment(-c, cd)
    w0 = ONE
    w1 = ZERO
    w2 = u - ONE
    w3 = -u
    u, square = nearest_on_segment(b - c, cd)
    nearer = square < least
    least = wp.where(nearer, square, least)
    w0 = wp.where(nearer, ZERO, w0)
    w1 = wp.where(nearer, ONE, w1)
    w2 = wp.where(nearer, u - ONE, w2)
    w3 = wp.where(nearer, -u, w3)
    u, square = nearest_on_segment(c, b)
    nearer = square < least
    least = wp.where(nearer, square, least)
    w0 = wp.where(nearer, ONE - u, w0)
    w1 = wp.where(nearer, u, w1)
    w2 = wp.where(nearer, -ONE, w2)
    w3 = wp.where(nearer, ZERO, w3)
    u, square = nearest_on_segment(d, b)
    nearer = square < least
    w0 = wp.where(nearer, ONE - u, w0)
    w1 = wp.where(nearer, u, w1)
    w2 = wp.where(nearer, ZERO, w2)
    w3 = wp.where(nearer, -ONE, w3)
    w0 = wp.where(inside, ONE - s, w0)
    w1 = wp.where(inside, s, w1)
    w2 = wp.where(inside, t - ONE, w2)
    w3 = wp.where(inside, -t, w3)
    y = w1 * b + w2 * c + w3 * d
    return wp.vec4d(w0, w1, w2, w3), in_plane(inside, y, normal, c), wp.where(inside, 1, 0)


@wp.func
def nearest(of_vertex: bool, x: CORNERS):
    """w, y and whether the nearest points are interior; computed relative to the first vertex, which keeps digits."""
    if of_vertex:
        return vertex_triangle(x[1] - x[0], x[2] - x[0], x[3] - x[0])
    return edge_edge(x[1] - x[0], x[2] - x[0], x[3] - x[0])


@wp.func
def gap_along(of_vertex: bool, n: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """The gap between the two sides of a pair along n, |n| ≤ 1, which is a lower bound of d."""
    y = wp.dot(n, c - a)
    z = wp.dot(n, d - a)
    x = wp.dot(n, b - a)
    if of_vertex:
        return -wp.max(wp.max(y, z), x)
    return wp.min(x, ZERO) - wp.max(y, z)


@wp.func
def along(p: wp.vec3d, q: wp.vec3d):
    """(q − p)·(−p), above 0 if the origin is beyond p towards q. It has the same bits for all faces with the edge."""
    return -wp.dot(q - p, p)


@wp.func
def nearest_of_face(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """The code of the point of a face nearest to the origin, and its barycentric coordinates."""
    ab = along(a, b)
    ba = along(b, a)
    bc = along(b, c)
    cb = along(c, b)
    ca = along(c, a)
    ac = along(a, c)
    n = wp.cross(b - a, c - a)
    wa = wp.dot(n, wp.cross(b, c))
    wb = wp.dot(n, wp.cross(c, a))
    wc = wp.dot(n, wp.cross(a, b))
    least = ON_EDGE * wp.dot(n, n)
    code = INSIDE
    w = wp.vec3d(wa, wb, wc) / (wa + wb + wc)
    if ab <= ZERO and ac <= ZERO:
        code = CORNER
        w = wp.vec3d(ONE, ZERO, ZERO)
    elif ba <= ZERO and bc <= ZERO:
        code = CORNER + 1
        w = wp.vec3d(ZERO, ONE, ZERO)
    elif ca <= ZERO and cb <= ZERO:
        code = CORNER + 2
        w = wp.vec3d(ZERO, ZERO, ONE)
    elif wc <= least and ab > ZERO and ba > ZERO:
        code = EDGE
        t = ab / (ab + ba)
        w = wp.vec3d(ONE - t, t, ZERO)
    elif wa <= least and bc > ZERO and cb > ZERO:
        code = EDGE + 1
        t = bc / (bc + cb)
        w = wp.vec3d(ZERO, ONE - t, t)
    elif wb <= least and ca > ZERO and ac > ZERO:
        code = EDGE + 2
        t = ca / (ca + ac)
        w = wp.vec3d(t, ZERO, ONE - t)
    return code, w


@wp.func
def perpendicular(n: wp.vec3d):
    """A unit vector normal to n."""
    axis = wp.vec3d()
    axis[wp.int32(wp.argmin(wp.abs(n)))] = ONE
    t = wp.cross(n, axis)
    return t / wp.max(wp.length(t), wp.float64(1e-300))


@wp.func
def corners(x: wp.array(dtype=Any), s: wp.vec4i):
    """The corners of a pair."""
    return wp.matrix_from_rows(wp.vec3d(x[s[0]]), wp.vec3d(x[s[1]]), wp.vec3d(x[s[2]]), wp.vec3d(x[s[3]]))


@wp.func
def farthest(x: wp.array(dtype=Any), s: wp.vec4i):
    """The largest coordinate of a pair [m]."""
    far = ZERO
    for i in range(4):
        far = wp.max(far, wp.max(wp.abs(wp.vec3d(x[s[i]]))))
    return far


@cache
def vertex_of(dtype):
    """Device function (x, correction, i) → xᵢ or xᵢ + dᵢ in float64."""
    vec3, _ = types(dtype)
    vector = load(vec3)

    @wp.func
    def at(x: wp.array(dtype=vec3), correction: wp.array(dtype=vec3), i: int):
        found = wp.vec3d(vector(x, i))
        if correction:
            if i < correction.shape[0]:  # obstacles have none
                found += wp.vec3d(vector(correction, i))
        return found

    return at
