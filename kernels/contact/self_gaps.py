"""Nearest points of a vertex and a triangle, or of two edges, and the gap between them, in float64.

y = Σ wᵢxᵢ is the vector between the nearest points, with w = (1, −β₁, −β₂, −β₃) for a vertex and a triangle, and (1 − s, s, −(1
− t), −t) for two edges. The gap is d = ‖y‖.
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
def on_segment(p: wp.vec3d, ab: wp.vec3d):
    """The t in [0, 1] of the point t ab nearest to p; 0 without length."""
    square = wp.dot(ab, ab)
    return wp.where(square > ZERO, wp.clamp(wp.dot(p, ab) / square, ZERO, ONE), ZERO)


@wp.func
def from_plane(normal: wp.vec3d, a: wp.vec3d):
    """The vector to the origin from the plane through a. For thin triangles, y from the weights would have too few digits."""
    return -wp.dot(normal, a) / wp.dot(normal, normal) * normal


@wp.func
def along(p: wp.vec3d, q: wp.vec3d):
    """(q − p)·(−p), above 0 if the origin is beyond p towards q. It has the same bits for all faces with the edge."""
    return -wp.dot(q - p, p)


@wp.func
def nearest_of_face(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """The code of the point of a face nearest to the origin, and its barycentric coordinates (Ericson 2004, 5.1.5)."""
    ab = along(a, b)
    ba = along(b, a)
    bc = along(b, c)
    cb = along(c, b)
    ca = along(c, a)
    ac = along(a, c)
    if ab <= ZERO and ac <= ZERO:
        return CORNER, wp.vec3d(ONE, ZERO, ZERO)
    if ba <= ZERO and bc <= ZERO:
        return CORNER + 1, wp.vec3d(ZERO, ONE, ZERO)
    if ca <= ZERO and cb <= ZERO:
        return CORNER + 2, wp.vec3d(ZERO, ZERO, ONE)
    n = wp.cross(b - a, c - a)
    w = wp.vec3d(wp.dot(n, wp.cross(b, c)), wp.dot(n, wp.cross(c, a)), wp.dot(n, wp.cross(a, b)))
    least = ON_EDGE * wp.dot(n, n)
    if w[2] <= least and ab > ZERO and ba > ZERO:
        return EDGE, wp.vec3d(ba, ab, ZERO) / (ab + ba)
    if w[0] <= least and bc > ZERO and cb > ZERO:
        return EDGE + 1, wp.vec3d(ZERO, cb, bc) / (bc + cb)
    if w[1] <= least and ca > ZERO and ac > ZERO:
        return EDGE + 2, wp.vec3d(ca, ZERO, ac) / (ca + ac)
    return INSIDE, w / (w[0] + w[1] + w[2])


@wp.func
def vertex_triangle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """w and y of the vertex 0 and a triangle."""
    code, w = nearest_of_face(a, b, c)
    y = -(w[0] * a + w[1] * b + w[2] * c)
    if code == INSIDE:
        y = from_plane(wp.cross(b - a, c - a), a)
    return wp.vec4d(ONE, -w[0], -w[1], -w[2]), y


@wp.func
def edge_edge(b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """w and y of the edges 0b and cd (Ericson 2004, 5.1.9).

    s is computed again from t at the end, because it is rounding where edges are parallel.
    """
    cd = d - c
    # sin² from the cross product, because |b|²|cd|² − (b·cd)² cancels for nearly parallel edges.
    normal = wp.cross(b, cd)
    square = wp.dot(normal, normal)
    s = ZERO
    if square > PLANAR * wp.dot(b, b) * wp.dot(cd, cd):
        s = wp.dot(wp.cross(cd, -c), normal) / square
        t = wp.dot(wp.cross(b, -c), normal) / square
        if s > ZERO and s < ONE and t > ZERO and t < ONE:
            return wp.vec4d(ONE - s, s, t - ONE, -t), from_plane(normal, c)
        s = wp.clamp(s, ZERO, ONE)
    t = on_segment(s * b - c, cd)
    s = on_segment(c + t * cd, b)
    return wp.vec4d(ONE - s, s, t - ONE, -t), s * b - c - t * cd


@wp.func
def nearest(of_vertex: bool, x: CORNERS):
    """w and y, computed relative to the first vertex, which keeps digits."""
    if of_vertex:
        return vertex_triangle(x[1] - x[0], x[2] - x[0], x[3] - x[0])
    return edge_edge(x[1] - x[0], x[2] - x[0], x[3] - x[0])


@wp.func
def gap_along(of_vertex: bool, n: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """The gap along n, |n| ≤ 1, of the sides of a pair with vertex 0 at the origin: a lower bound of d."""
    side = wp.dot(n, b)
    other = wp.max(wp.dot(n, c), wp.dot(n, d))
    if of_vertex:
        return -wp.max(other, side)
    return wp.min(side, ZERO) - other


@wp.func
def perpendicular(n: wp.vec3d):
    axis = wp.vec3d()
    axis[wp.int32(wp.argmin(wp.abs(n)))] = ONE
    t = wp.cross(n, axis)
    return t / wp.max(wp.length(t), wp.float64(1e-300))


@wp.func
def corners(x: wp.array(dtype=Any), s: wp.vec4i):
    return wp.matrix_from_rows(wp.vec3d(x[s[0]]), wp.vec3d(x[s[1]]), wp.vec3d(x[s[2]]), wp.vec3d(x[s[3]]))


@wp.func
def farthest(x: wp.array(dtype=Any), s: wp.vec4i):
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
