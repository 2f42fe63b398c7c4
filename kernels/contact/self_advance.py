"""The fraction of a direction along which a pair of self-contact keeps a gap: continuous collision detection."""

from functools import cache

import warp as wp

from ..vectors import types
from .proximity_grid import surfaces
from .self_gaps import ONE, ZERO, nearest, vertex_of
from .self_planes import KEPT, margin_of, part_apart, ulp_of


@cache
def advances(dtype):
    """Struct of the moves ``direction`` (N,) [m], the ``fraction`` that each copy may make (B,), and the ``least`` gap [m]."""
    vec3, _ = types(dtype)

    @wp.struct
    class Advance:
        direction: wp.array(dtype=vec3)
        fraction: wp.array(dtype=wp.float64)
        least: wp.float64

    return Advance


@cache
def take_advance(dtype, of_edges: bool):
    """The function of :func:`.proximity.search_pairs` that reduces the ``fraction`` of a copy for a pair, and its struct.

    A pair keeps a tenth of its gap. Where all vertices move by the same fraction, a plane between the two sides may move with
    them: the two sides stay apart along y while no vertex of one side comes near the height of one of the other. Where this
    allows less than the direction, as for cloth that slides over an edge, :func:`.self_planes.part_apart` may allow more.
    """
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    ulp, advance, sides = ulp_of(dtype), advances(dtype), wp.constant(2 if of_edges else 1)
    of_vertex = wp.constant(not of_edges)

    @wp.func
    def take(
        surface: surfaces(dtype),
        x: wp.array(dtype=vec3),
        s: wp.vec4i,
        first: int,
        i: int,
        k: int,
        triangles: int,
        out: advance,
    ):
        a = exact(x[s[0]])
        b = exact(x[s[1]])
        c = exact(x[s[2]])
        d = exact(x[s[3]])
        pa = exact(out.direction[s[0]])
        pb = exact(out.direction[s[1]])
        pc = exact(out.direction[s[2]])
        pd = exact(out.direction[s[3]])
        far = wp.max(wp.max(wp.max(wp.abs(a)), wp.max(wp.abs(b))), wp.max(wp.max(wp.abs(c)), wp.max(wp.abs(d))))
        far += wp.max(wp.max(wp.length(pa), wp.length(pb)), wp.max(wp.length(pc), wp.length(pd)))
        margin = wp.float64(2.0) * margin_of(out.least, ulp * far)
        _w, y, _inside = nearest(of_vertex, a, b, c, d)
        distance = wp.length(y)
        n = y / wp.max(distance, wp.float64(1e-300))
        floor = (ONE - KEPT) * wp.max(distance - margin, ZERO) + wp.min(distance, margin)
        t = ONE
        for p in range(sides):
            for q in range(sides, 4):
                approach = wp.dot(n, exact(out.direction[s[q]]) - exact(out.direction[s[p]]))
                if approach > ZERO:
                    apart = wp.dot(n, exact(x[s[p]]) - exact(x[s[q]])) - floor
                    t = wp.min(t, wp.max(apart, ZERO) / approach)
        if t < ONE:
            t = wp.max(t, part_apart(of_vertex, a, b, c, d, pa, pb, pc, pd, floor))
        if t < ONE:
            wp.atomic_min(out.fraction, s[0] // surface.vertices, t)

    return take, advance
