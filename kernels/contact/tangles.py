"""Kernels for triangles that intersect at the start: contact pairs ignored because of them, and whether they are free."""

from functools import cache

import warp as wp

from ..vectors import types
from .self_gaps import ZERO, nearest, vertex_of

MODULE = "warpcloth.tangles"


@wp.struct
class LeftOut:
    """Contact pairs through which tangled triangles pass one another, sorted, vertex–triangle pairs first.

    A vertex–triangle pair is (v, a, b, c) with a < b < c. An edge–edge pair is (a, b, c, d) with a < b, c < d and (a, b) before
    (c, d). Pair i has the ``tangles`` from ``first`` [i] to ``first`` [i + 1]. It is ``whole`` if it affects no other
    triangles.
    """

    stencils: wp.array(dtype=wp.vec4i)
    of_vertices: wp.int32
    whole: wp.array(dtype=wp.int32)
    first: wp.array(dtype=wp.int32)
    tangles: wp.array(dtype=wp.int32)
    free: wp.array(dtype=wp.int32)


@wp.func
def order_of(a: wp.vec4i, b: wp.vec4i):
    """Negative, 0 or positive if a is before, equal to, or after b."""
    found = wp.int32(0)
    for i in range(4):
        if found == 0 and a[i] != b[i]:
            found = wp.where(a[i] < b[i], -1, 1)
    return found


@wp.func
def sorted_stencil(s: wp.vec4i, of_vertex: bool):
    found = s
    if of_vertex:
        low = wp.min(s[1], wp.min(s[2], s[3]))
        high = wp.max(s[1], wp.max(s[2], s[3]))
        found = wp.vec4i(s[0], low, s[1] + s[2] + s[3] - low - high, high)
    else:
        a = wp.min(s[0], s[1])
        b = wp.max(s[0], s[1])
        c = wp.min(s[2], s[3])
        d = wp.max(s[2], s[3])
        found = wp.vec4i(a, b, c, d)
        if c < a or (c == a and d < b):
            found = wp.vec4i(c, d, a, b)
    return found


@wp.func
def row_of(s: wp.vec4i, of_vertex: bool, left: LeftOut):
    """The row of a pair, by bisection; −1 if it is missing."""
    wanted = sorted_stencil(s, of_vertex)
    low = wp.where(of_vertex, 0, left.of_vertices)
    end = wp.where(of_vertex, left.of_vertices, left.stencils.shape[0])
    high = end
    while low < high:
        middle = (low + high) // 2
        if order_of(left.stencils[middle], wanted) < 0:
            low = middle + 1
        else:
            high = middle
    found = wp.int32(-1)
    if low < end:
        if order_of(left.stencils[low], wanted) == 0:
            found = low
    return found


@wp.func
def free_of(row: int, left: LeftOut):
    """The number of tangles of a row that are free."""
    found = wp.int32(0)
    for k in range(left.first[row], left.first[row + 1]):
        found += left.free[left.tangles[k]]
    return found


@wp.kernel(module=MODULE, enable_backward=False)
def leave_out(
    # elements
    stencils: wp.array(dtype=wp.vec4i),
    counts: wp.array(dtype=wp.int32),
    left: LeftOut,
    # out
    gap: wp.array(dtype=wp.float64),
):
    """Kernel over pairs: gap = ∞ for pairs with a tangle that is not free."""
    e = wp.tid()
    if e < counts[0] + counts[1]:
        row = row_of(stencils[e], e < counts[0], left)
        if row >= 0:
            if free_of(row, left) < left.first[row + 1] - left.first[row]:
                gap[e] = wp.float64(wp.inf)


@wp.kernel(module=MODULE, enable_backward=False)
def find_open(
    # elements
    stencils: wp.array(dtype=wp.vec4i),
    counts: wp.array(dtype=wp.int32),
    left: LeftOut,
    # out
    open: wp.array(dtype=wp.int32),
):
    """Kernel over pairs: open = 1 for whole pairs without a free tangle, which get no separating plane."""
    e = wp.tid()
    if e < counts[0] + counts[1]:
        open[e] = 0
        row = row_of(stencils[e], e < counts[0], left)
        if row >= 0:
            if left.whole[row] != 0 and free_of(row, left) == 0:
                open[e] = 1


@wp.func
def volume(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    return wp.dot(wp.cross(b - a, c - a), d - a)


@wp.func
def goes_through(p: wp.vec3d, q: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Whether the edge pq intersects the triangle abc; exact unless they are within rounding of one another."""
    found = wp.bool(False)
    if volume(a, b, c, p) * volume(a, b, c, q) < ZERO:
        one = volume(p, q, a, b)
        two = volume(p, q, b, c)
        three = volume(p, q, c, a)
        found = (one >= ZERO and two >= ZERO and three >= ZERO) or (one <= ZERO and two <= ZERO and three <= ZERO)
    return found


@cache
def find_free(dtype):
    """Kernel over pairs of triangles: free = 1 if they do not intersect and are farther apart than ``least``."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def find_each_free(
        # elements
        corners: wp.array2d(dtype=wp.int32),
        # state in
        x: wp.array(dtype=vec3),
        # parameters
        least: wp.float64,
        # in and out
        free: wp.array(dtype=wp.int32),
    ):
        k = wp.tid()
        if free[k] != 0:
            return
        for side in range(2):
            mine = 3 * side
            other = 3 - mine
            a = exact(x[corners[k, other]])
            b = exact(x[corners[k, other + 1]])
            c = exact(x[corners[k, other + 2]])
            for i in range(3):
                one = corners[k, mine + i]
                two = corners[k, mine + (i + 1) % 3]
                p = exact(x[one])
                q = exact(x[two])
                shared = wp.bool(False)
                next_shared = wp.bool(False)
                for j in range(3):
                    shared = shared or corners[k, other + j] == one
                    next_shared = next_shared or corners[k, other + j] == two
                if not shared:
                    _w, y, _inside = nearest(True, p, a, b, c)
                    if not wp.length(y) >= least:
                        return
                if not (shared or next_shared) and goes_through(p, q, a, b, c):
                    return
                if side == 0:
                    for j in range(3):
                        u = corners[k, other + j]
                        v = corners[k, other + (j + 1) % 3]
                        if u != one and u != two and v != one and v != two:
                            _w, y, _inside = nearest(False, p, q, exact(x[u]), exact(x[v]))
                            if not wp.length(y) >= least:
                                return
        free[k] = 1

    return find_each_free
