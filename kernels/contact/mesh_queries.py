"""Factories of the queries of mesh colliders: the nearest point of a mesh, the first contact of a move, lists of triangles.

The hierarchy, a `wp.Bvh` in float32, only finds candidates, with a margin for rounding.
"""

from functools import cache

import warp as wp

from ..vectors import types
from .mesh_geometry import geometry, meshes

LISTED = 32  # maximum number of triangles in the list of a vertex
AHEAD = wp.constant(10)  # number of steps for which a list should last
MARCHES = wp.constant(32)  # maximum number of separating planes between a vertex and a triangle in a move


@cache
def near_lists(dtype):
    """Struct of the triangles near each vertex, for short steps: (meshes, N) lists of at most :data:`LISTED` triangles.

    A list has the triangles within r + w of the centre of a ``ball`` (x, y, z, w) at the step ``built``. It is complete until
    the vertex and the mesh, which moves by ``drift`` per step, have approached by w. If a list is too long, ``count`` is −1. If
    there is none, w is negative. ``row`` is the row of each collider, and empty without lists.
    """

    @wp.struct
    class NearLists:
        row: wp.array(dtype=wp.int32)
        drift: wp.array(dtype=dtype)
        ball: wp.array2d(dtype=wp.types.vector(4, dtype))
        built: wp.array2d(dtype=wp.int32)
        count: wp.array2d(dtype=wp.int32)
        triangles: wp.array3d(dtype=wp.int32)

    return NearLists


@cache
def queries(dtype):
    """Device functions that query the hierarchy or the list of a vertex."""
    vec3, mat33 = types(dtype)
    corners, from_triangle, _carry = geometry(dtype)
    ball_type = wp.types.vector(4, dtype)
    zero, one = dtype(0.0), dtype(1.0)

    @wp.func
    def is_point(t: mat33):
        """Whether a triangle is a point, and so does not count."""
        return t[0] == t[1] and t[1] == t[2]

    @wp.func
    def margin_of(mesh: meshes(dtype), c: int, p: vec3):
        return mesh.margin[c] + wp.float32(1e-6) * wp.float32(wp.max(wp.abs(p)))

    @wp.func
    def nearest_beyond(
        mesh: meshes(dtype),
        c: int,
        halves: int,
        per_frame: int,
        p: vec3,
        radius: dtype,
        beyond: dtype,
        count: int,
        normals: mat33,
        gaps: vec3,
        lists: near_lists(dtype),
        row: int,
        i: int,
    ):
        """The nearest point within a radius in front of ``count`` facets: distance or −1, direction, triangle, coordinates."""
        found = -one
        away = vec3()
        weights = vec3()
        face = wp.int32(-1)
        k = wp.int32(0)
        at = wp.int32(0)
        more = wp.bool(True)
        query = wp.bvh_query_sphere(mesh.bvh[c], wp.vec3(p), wp.float32(radius) + margin_of(mesh, c, p))
        while more:
            if row >= 0:
                more = at < lists.count[row, i]
                if more:
                    k = lists.triangles[row, i, at]
                    at += 1
            else:
                more = wp.bvh_query_next(query, k)
            if not more:
                break
            t = corners(mesh, c, k, halves, per_frame)
            d, n, w = from_triangle(p, t)
            if d < radius and not is_point(t) and (found < zero or d < found or (d == found and k < face)):
                hidden = wp.bool(False)
                for j in range(count):
                    if gaps[j] - d * wp.dot(normals[j], n) <= beyond:
                        hidden = True
                if not hidden:
                    found = d
                    away = n
                    weights = w
                    face = k
        return found, away, face, weights

    @wp.func
    def march(p: vec3, way: vec3, t: mat33, moves: mat33, least: dtype, most: dtype):
        """The fraction of a move, at most ``most``, that keeps ``least``, or the initial distance, from a moving triangle.

        The plane normal to the distance separates the two until a corner passes it. From there the next plane decides.
        """
        done = zero
        d, n, w = from_triangle(p, t)
        fastest = wp.length(way)
        for k in range(3):
            fastest = wp.max(fastest, wp.length(way - moves[k]))
        if d > fastest * most + least:
            done = most
        lowest = wp.min(least, d)
        k = wp.int32(0)
        while done < most and k < MARCHES:
            k += 1
            step = most - done
            q = p + done * way
            for i in range(3):
                approach = wp.dot(n, moves[i] - way)
                if approach > zero:
                    step = wp.min(step, wp.max(wp.dot(n, q - t[i] - done * moves[i]) - lowest, zero) / approach)
            if step >= most - done:
                done = most
            elif step * fastest > dtype(0.01) * least:
                done += step
                d, n, w = from_triangle(p + done * way, t + done * moves)
            else:
                k = MARCHES
        return done, d, n, w

    @wp.func
    def sweep(
        mesh: meshes(dtype),
        c: int,
        halves: int,
        after: int,
        per_frame: int,
        p: vec3,
        way: vec3,
        start: dtype,
        least: dtype,
        lists: near_lists(dtype),
        row: int,
        i: int,
    ):
        """The fraction of a move that keeps ``least`` or the initial distance; the stop: normal, triangle or −1, coordinates.

        The move starts at the fraction ``start`` of the time from ``halves`` to ``after``, and ends at ``after``. If several
        triangles stop it at once, such as those of a plane, the nearest is returned.
        """
        kept = one
        nearest = dtype(wp.inf)
        away = vec3()
        weights = vec3()
        face = wp.int32(-1)
        k = wp.int32(0)
        moves = mat33()
        at = wp.int32(0)
        more = wp.bool(True)
        query = wp.bvh_query_capsule(mesh.bvh[c], wp.vec3(p), wp.vec3(way), wp.float32(least) + margin_of(mesh, c, p + way))
        while more:
            if row >= 0:
                more = at < lists.count[row, i]
                if more:
                    k = lists.triangles[row, i, at]
                    at += 1
            else:
                more = wp.bvh_query_next(query, k, 1.0)
            if not more:
                break
            t = corners(mesh, c, k, halves, per_frame)
            absent = wp.bool(False)
            if mesh.frames[c] > 1:
                t_after = corners(mesh, c, k, after, per_frame)
                absent = is_point(t) and is_point(t_after)
                moves = t_after - t
                t += start * moves
                moves = (one - start) * moves
            part, d, n, w = march(p, way, t, moves, least, kept)
            at_once = kept == zero and d < nearest and wp.dot(n, wp.transpose(moves) * w - way) > zero
            if (part < kept or at_once) and not absent:
                kept = part
                nearest = d
                away = n
                weights = w
                face = k
        return kept, away, face, weights

    @wp.func
    def has_list(lists: near_lists(dtype), c: int, i: int, step: int, p: vec3, way: dtype):
        """The row of the list of a vertex at p if it is complete within r along a way of this length, else −1."""
        row = wp.int32(-1)
        if lists.row.shape[0] > 0:
            row = lists.row[c]
            ball = lists.ball[row, i]
            moved = wp.length(p - vec3(ball[0], ball[1], ball[2])) + way
            moved += dtype(wp.abs(step - lists.built[row, i])) * lists.drift[row]
            if not (moved <= ball[3]) or lists.count[row, i] < 0:
                row = -1
        return row

    @wp.func
    def is_alone(lists: near_lists(dtype), c: int, i: int, step: int, p: vec3, way: dtype):
        """Whether, by the list of a vertex, no triangle is within r along its way."""
        row = has_list(lists, c, i, step, p, way)
        alone = wp.bool(False)
        if row >= 0:
            alone = lists.count[row, i] == 0
        return alone

    @wp.func
    def listed(
        mesh: meshes(dtype),
        c: int,
        halves: int,
        per_frame: int,
        p: vec3,
        way: dtype,
        r: dtype,
        lists: near_lists(dtype),
        i: int,
    ):
        """The row of the list of a vertex at p that moves by ``way`` per step, rebuilt if necessary; or −1."""
        step = halves // 2
        row = lists.row[c]
        if has_list(lists, c, i, step, p, zero) < 0:
            ball = lists.ball[row, i]
            moved = wp.length(p - vec3(ball[0], ball[1], ball[2]))
            moved += dtype(wp.abs(step - lists.built[row, i])) * lists.drift[row]
            if not (moved <= ball[3]):  # too long lists are also kept until then
                w = dtype(wp.max(dtype(AHEAD) * (way + lists.drift[row]), dtype(0.5) * r))
                count = wp.int32(LISTED + 1)
                tries = wp.int32(0)
                while count > LISTED and tries < 4:
                    tries += 1
                    count = wp.int32(0)
                    k = wp.int32(0)
                    query = wp.bvh_query_sphere(mesh.bvh[c], wp.vec3(p), wp.float32(r + w) + margin_of(mesh, c, p))
                    while count <= LISTED and wp.bvh_query_next(query, k):
                        d, _n, _w = from_triangle(p, corners(mesh, c, k, halves, per_frame))
                        if d < r + w:
                            if count < LISTED:
                                lists.triangles[row, i, count] = k
                            count += 1
                    if count > LISTED:
                        w *= dtype(0.25)
                lists.ball[row, i] = ball_type(p[0], p[1], p[2], w)
                lists.built[row, i] = step
                lists.count[row, i] = wp.where(count > LISTED, -1, count)
            if lists.count[row, i] < 0:
                row = -1
        return row

    return nearest_beyond, sweep, has_list, is_alone, listed


@cache
def bound_triangles(dtype):
    """Kernel over the triangles of a deforming mesh: their boxes from the first to the last half step of all copies."""
    corners, _from, _carry = geometry(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def bound(
        # elements
        mesh: meshes(dtype),
        collider: int,
        # state in
        steps: wp.array(dtype=wp.int32),
        # parameters
        per_frame: int,
        # out
        lowers: wp.array(dtype=wp.vec3),
        uppers: wp.array(dtype=wp.vec3),
    ):
        k = wp.tid()
        first = steps[0]
        last = steps[0]
        for b in range(steps.shape[0]):
            first = wp.min(first, steps[b])
            last = wp.max(last, steps[b])
        first = 2 * first
        last = 2 * last + 2
        low = wp.vec3(wp.inf)
        high = wp.vec3(-wp.inf)
        halves = first
        while halves <= last:
            t = corners(mesh, collider, k, halves, per_frame)
            for i in range(3):
                low = wp.min(low, wp.vec3(t[i]))
                high = wp.max(high, wp.vec3(t[i]))
            next = (halves // per_frame + 1) * per_frame  # the next keyframe, where the velocity changes
            if halves < last:
                next = wp.min(next, last)
            halves = next
        edge = wp.vec3(mesh.margin[collider])
        lowers[k] = low - edge
        uppers[k] = high + edge

    return bound
