"""A factory of the kernel that finds the pairs of edges of which one may cross a triangle at the other."""

from functools import cache

import warp as wp

from ..pairs import Pairs
from ..vectors import types
from .obstacles import in_copy
from .self_gaps import ZERO
from .self_pairs import module_of

# Rounding of the distances from a plane, over the length of an edge.
ROUNDED = wp.constant(wp.float64(1e-9))


@wp.struct
class Fans:
    """The ``triangles`` first[i] to first[i + 1] of vertex i, each of three vertices, numbered as in a copy."""

    first: wp.array(dtype=wp.int32)
    triangles: wp.array(dtype=wp.vec3i)


@wp.func
def may_cross(p: wp.vec3d, q: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Whether the boxes of the edge pq and of the triangle abc meet, and p and q are not on one side of its plane."""
    low = wp.min(wp.min(a, b), c) - wp.max(p, q)
    high = wp.min(p, q) - wp.max(wp.max(a, b), c)
    if wp.max(low) > ZERO or wp.max(high) > ZERO:
        return False
    n = wp.cross(b - a, c - a)
    one = wp.dot(n, p - a)
    other = wp.dot(n, q - a)
    rounding = ROUNDED * wp.length(n) * wp.length(q - p)
    return wp.min(one, other) <= rounding and wp.max(one, other) >= -rounding


@cache
def find_crossings(dtype):
    """Kernel over listed pairs of edges of cloth: bit 0 if the first may cross a triangle at the second, bit 1 the reverse."""
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def find_crossings_of_pair(
        # elements
        pairs: Pairs,
        fans: Fans,
        # state in
        x: wp.array(dtype=vec3),
        # out
        found: wp.array(dtype=wp.uint8),
    ):
        for e in range(pairs.counts[0] + wp.tid(), pairs.counts[0] + pairs.counts[1], pairs.threads):
            s = pairs.stencils[e]
            if wp.max(s) >= pairs.layout.cloth:
                continue
            bits = wp.int32(0)
            for way in range(2):
                i = s[2 * way]
                j = s[2 * way + 1]
                k = s[2 - 2 * way]
                l = s[3 - 2 * way]
                p = wp.vec3d(x[i])
                q = wp.vec3d(x[j])
                v = in_copy(pairs.layout, k)
                for n in range(fans.first[v], fans.first[v + 1]):
                    t = fans.triangles[n] + wp.vec3i(k - v, k - v, k - v)
                    if t[0] == l or t[1] == l or t[2] == l:
                        if may_cross(p, q, wp.vec3d(x[t[0]]), wp.vec3d(x[t[1]]), wp.vec3d(x[t[2]])):
                            bits |= 1 << way
            found[e] = wp.uint8(bits)

    return find_crossings_of_pair
