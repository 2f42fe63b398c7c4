"""Factories of the kernels of mesh colliders: the half-spaces that replace a mesh in a step, and the filter.

In a step, and for each vertex, a mesh is replaced by a few half-spaces, the *facets*, which have the nearby part of the mesh
behind them. The first touches the surface at the point nearest to the predicted vertex, the next at the nearest point in front
of the first, and so on (Liu et al. 2017, *Planning dynamically feasible trajectories for quadrotors using safe flight corridors
in 3-D complex environments*). A convex mesh needs one facet, a groove two, a corner three.

Distances are unsigned: a vertex starts on one side of the surface, and the filter never lets it cross. So open and non-manifold
meshes, and meshes with inconsistent winding, work like closed ones.

Everything is in the frame of the collider. Points of the mesh move linearly between its keyframes, and so within a step.
``halves`` are numbers of half steps. The hierarchy, a `wp.Bvh` in float32, only finds candidates, with a margin for rounding.
"""

from functools import cache

import warp as wp

from ..rotation import epsilon
from ..terms import contact
from ..terms.contact import turned
from ..vectors import types
from .colliders import (
    ROUNDS,
    SLIDING,
    FilterNotes,
    half_space,
    kept_part,
    local_gap_of,
    note_cut,
    note_inside,
    of_pose,
    pose_types,
    shapes,
    sliding,
    stopped_by_shape,
)

turned_by, slope_of = turned, contact.slope
FAR = 1e30  # distance to a missing facet; finite, so that differences are not NaN
LISTED = 32  # maximum number of triangles in the list of a vertex
AHEAD = wp.constant(10)  # number of steps for which a list should last
FACETS = 3  # maximum number of facets of a vertex and a mesh
MARCHES = wp.constant(32)  # maximum number of separating planes between a vertex and a triangle in a move
CARRIES = wp.constant(16)  # how often moving triangles may carry a vertex along in a step
SLIDES = wp.constant(3)  # surfaces along which a prediction or a vertex slides
BEYOND = wp.constant(0.02)  # smallest distance of a further facet in front of the others, over r
ALIKE = wp.constant(0.9)  # cosine between the normals from which two facets count as one


@cache
def meshes(dtype):
    """Struct of the meshes of C colliders. ``points`` has the keyframes of all meshes, ``triangles`` their triangles.

    For each collider: the hierarchy ``bvh`` or 0, the index of the first triangle, the index of the first point, the points per
    keyframe, the number of keyframes, and the margin of the hierarchy for rounding.
    """
    vec3, _ = types(dtype)

    @wp.struct
    class Meshes:
        points: wp.array(dtype=vec3)
        triangles: wp.array(dtype=wp.vec3i)
        bvh: wp.array(dtype=wp.uint64)
        first_triangle: wp.array(dtype=wp.int32)
        first_point: wp.array(dtype=wp.int32)
        size: wp.array(dtype=wp.int32)
        frames: wp.array(dtype=wp.int32)
        margin: wp.array(dtype=wp.float32)

    return Meshes


@cache
def motions(dtype):
    """Struct of a step: the poses (copies, colliders) of :func:`.colliders.step_poses`, and parameters of all kernels.

    ``steps`` is the number of steps of h [s] of each copy. A frame has ``per_frame`` half steps. Forces are evaluated after
    ``ahead`` half steps. ``r`` is the contact distance, ``least`` the smallest distance that the filter allows, ``landing`` the
    distance at which it stops vertices, and predictions stop.
    """
    pose_type, _anchor = pose_types(dtype)

    @wp.struct
    class Motion:
        before: wp.array2d(dtype=pose_type)
        at: wp.array2d(dtype=pose_type)
        after: wp.array2d(dtype=pose_type)
        steps: wp.array(dtype=wp.int32)
        per_frame: wp.int32
        ahead: wp.int32
        h: dtype
        r: dtype
        least: dtype
        landing: dtype

    return Motion


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
def facet_type(dtype):
    """Type of a facet: a point, the normal, the weight."""
    return wp.types.vector(7, dtype)


@cache
def geometry(dtype):
    """Device functions on triangles: ``corners``, ``from_triangle``, ``carry``."""
    vec3, mat33 = types(dtype)
    zero, one = dtype(0.0), dtype(1.0)

    @wp.func
    def corners(mesh: meshes(dtype), c: int, triangle: int, halves: int, per_frame: int):
        """The corners of a triangle after ``halves`` half steps, as rows; a frame has ``per_frame`` half steps."""
        v = mesh.triangles[mesh.first_triangle[c] + triangle]
        first = mesh.first_point[c]
        frames = mesh.frames[c]
        found = mat33()
        if frames == 1:
            for k in range(3):
                found[k] = mesh.points[first + v[k]]
        else:
            size = mesh.size[c]
            frame = wp.max(wp.min(halves // per_frame, frames - 1), 0)
            after = wp.min(frame + 1, frames - 1)
            part = dtype(wp.max(halves, 0) - frame * per_frame) / dtype(per_frame)
            if after == frame:
                part = zero
            for k in range(3):
                a = mesh.points[first + frame * size + v[k]]
                found[k] = a + part * (mesh.points[first + after * size + v[k]] - a)
        return found

    @wp.func
    def nearer_side(p: vec3, a: vec3, b: vec3, best: dtype):
        """Squared distance of p to the segment from a to b, its parameter, and the vector to p, if below ``best``; else −1.

        A short vector must not be tilted along the segment by rounding, for the ends may be far.
        """
        e = b - a
        l = wp.dot(e, e)
        t = zero
        if l > zero:
            t = wp.clamp(wp.dot(p - a, e) / l, zero, one)
        y = p - a - t * e
        if t > zero and t < one:
            y -= wp.dot(y, e) / l * e
        s = wp.dot(y, y)
        return wp.where(s < best, s, -one), t, y

    @wp.func
    def from_triangle(p: vec3, t: mat33):
        """Distance to a triangle, direction away from it, and barycentric coordinates of the nearest point."""
        a = t[0]
        b = t[1]
        c = t[2]
        n = wp.cross(b - a, c - a)
        w = vec3(wp.dot(wp.cross(c - b, p - b), n), wp.dot(wp.cross(a - c, p - c), n), wp.dot(wp.cross(b - a, p - a), n))
        size = w[0] + w[1] + w[2]
        d = zero
        away = vec3()
        if size > zero and w[0] >= zero and w[1] >= zero and w[2] >= zero:
            w = w / size
            n = wp.normalize(n)
            d = wp.dot(n, p - a)
            away = wp.where(d < zero, -n, n)
            d = wp.abs(d)
        else:
            best = dtype(wp.inf)
            flat = size <= zero
            ta = vec3(one, zero, zero)
            if w[2] < zero or flat:
                s, at, y = nearer_side(p, a, b, best)
                if s >= zero:
                    best = s
                    ta = vec3(one - at, at, zero)
                    away = y
            if w[0] < zero or flat:
                s, at, y = nearer_side(p, b, c, best)
                if s >= zero:
                    best = s
                    ta = vec3(zero, one - at, at)
                    away = y
            if w[1] < zero or flat:
                s, at, y = nearer_side(p, c, a, best)
                if s >= zero:
                    best = s
                    ta = vec3(at, zero, one - at)
                    away = y
            w = ta
            d = wp.length(away)
            if d > zero:
                away = away / d
        return d, away, w

    @wp.func
    def frame_of(t: mat33):
        """An orthonormal frame of a triangle, as rows."""
        x = wp.normalize(t[1] - t[0])
        z = wp.normalize(wp.cross(t[1] - t[0], t[2] - t[0]))
        y = wp.cross(z, x)
        return mat33(x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2])

    @wp.func
    def carry(n: vec3, before: mat33, after: mat33):
        """A direction rotated with a triangle; unchanged for a degenerate triangle."""
        found = wp.transpose(frame_of(after)) * (frame_of(before) * n)
        return wp.where(wp.dot(found, found) > dtype(0.5), found, n)

    return corners, from_triangle, carry


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


@cache
def find_facets(dtype, at_vertex: bool, anywhere: bool = False):
    """Kernel over contact elements of one mesh at the start of a step: the facets of each vertex.

    With ``at_vertex``, for explicit steps, facets are those at the vertex. With ``anywhere``, for equilibria, they are too,
    with the nearest at any distance. Else they are those at the prediction x + h v + h² g, which slides along the surfaces that
    it meets. If the nearest facet there differs from the last along which it slid, or is missing, that one becomes the first:
    beyond a thin collider no force would lead the vertex back. If the prediction meets nothing, facets are those at the vertex,
    for other forces may pull it as far.

    The weights divide the area of the vertex among facets: 1/Σ|nⱼ·nₖ| over those within r. So two almost equal facets press as
    one, and several are never stiffer than one (Gershgorin).
    """
    vec3, mat33 = types(dtype)
    facet = facet_type(dtype)
    to_local, to_space = of_pose(dtype)
    corners, _from, carry = geometry(dtype)
    nearest_beyond, sweep, _has_list, _is_alone, listed = queries(dtype)
    zero, one = dtype(0.0), dtype(1.0)

    @wp.kernel(module="unique", enable_backward=False)
    def find(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        mesh: meshes(dtype),
        gravity: wp.array(dtype=vec3),
        per_gravity: int,
        # state in
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        motion: motions(dtype),
        # parameters
        collider: int,
        per_copy: int,
        # in and out
        lists: near_lists(dtype),
        # out
        facets: wp.array2d(dtype=facet),
    ):
        e = wp.tid()
        i = stencil[e, 0]
        copy = e // per_copy
        most = facets.shape[1]
        r = motion.r
        h = motion.h
        per_frame = motion.per_frame
        before = 2 * motion.steps[copy]
        when = before
        start = to_local(motion.before[copy, collider], x[i])
        p = start
        normals = mat33()
        points = mat33()
        gaps = vec3()
        count = wp.int32(0)
        radius = r
        farthest = r
        row = wp.int32(-1)
        if wp.static(anywhere):
            radius = dtype(2.0) * r
            farthest = dtype(FAR)
        elif wp.static(at_vertex):
            way = wp.length(to_local(motion.after[copy, collider], x[i] + h * v[i]) - p)
            row = listed(mesh, collider, before, per_frame, p, way, r, lists, i)
        else:
            when = before + 2
            ahead = x[i] + h * (v[i] + h * gravity[i // per_gravity])
            target = to_local(motion.after[copy, collider], ahead)
            farthest = dtype(2.0) * r + wp.min(wp.length(target - start), dtype(64.0) * r)
            done = zero
            n_hit = vec3()
            foot = vec3()
            face_hit = wp.int32(-1)
            moved = p
            slide = wp.int32(0)
            while done < one and slide < SLIDES:
                slide += 1
                way = target - p
                kept, n, face, w = sweep(mesh, collider, before, when, per_frame, p, way, done, motion.landing, lists, -1, i)
                p += kept * way
                done += kept * (one - done)
                if face >= 0:
                    t = corners(mesh, collider, face, before, per_frame)
                    t_end = t
                    if mesh.frames[collider] > 1:
                        t_end = corners(mesh, collider, face, when, per_frame)
                        t += done * (t_end - t)
                        n = carry(n, t, t_end)
                    end = wp.transpose(t_end) * w
                    moved = p + end - wp.transpose(t) * w
                    target += wp.max(wp.dot(n, moved - target), zero) * n
                    n_hit = n
                    foot = end
                    face_hit = face
                else:
                    done = one
            if done < one:
                p = moved
            radius = dtype(2.0) * r
            if face_hit >= 0:
                radius += wp.min(dtype(0.25) * wp.length(target - foot), dtype(32.0) * r)
                d, n, face, w = nearest_beyond(mesh, collider, when, per_frame, p, radius, zero, 0, normals, gaps, lists, -1, i)
                if d < zero or wp.dot(n, n_hit) < dtype(ALIKE):
                    normals[0] = n_hit
                    gaps[0] = wp.dot(n_hit, p - foot)
                    points[0] = foot
                    count = 1
        searching = wp.bool(True)
        if row >= 0:
            searching = lists.count[row, i] > 0
        while searching and count < most:
            d, n, face, w = nearest_beyond(
                mesh, collider, when, per_frame, p, radius, dtype(BEYOND) * r, count, normals, gaps, lists, row, i
            )
            searching = d > zero
            if searching:
                t = corners(mesh, collider, face, when, per_frame)
                normals[count] = n
                gaps[count] = d
                points[count] = p - d * n
                if mesh.frames[collider] > 1 and before + motion.ahead != when:
                    t_at = corners(mesh, collider, face, before + motion.ahead, per_frame)
                    points[count] = wp.transpose(t_at) * w
                    normals[count] = carry(n, t, t_at)
                count += 1
            elif count == 0 and radius < farthest:
                if when > before:
                    when = before
                    p = start
                else:
                    radius *= dtype(2.0)
                searching = wp.bool(True)
        pose = motion.at[copy, collider]
        for j in range(most):
            f = facet()
            if j < count:
                share = zero
                for k in range(count):
                    near = wp.clamp(dtype(2.0) - gaps[k] / r, zero, one)
                    if k == j:
                        near = one
                    share += near * wp.abs(wp.dot(normals[j], normals[k]))
                point = to_space(pose, points[j])
                n = turned_by(vec3(pose[3], pose[4], pose[5]), pose[6], normals[j])
                for k in range(3):
                    f[k] = point[k]
                    f[3 + k] = n[k]
                f[6] = one / share
            facets[i, j] = f

    return find


@cache
def pose_facets(dtype):
    """Kernel over the elements of one facet: rest states; a half-space far away if the vertex has fewer facets."""
    vec3, _ = types(dtype)
    facet = facet_type(dtype)
    behind, rest_type = half_space(dtype), wp.types.vector(contact.PARAMETERS, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def pose(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        areas: wp.array(dtype=dtype),
        # state in
        facets: wp.array2d(dtype=facet),
        # parameters
        which: int,
        # in and out
        rest: wp.array(dtype=rest_type),
    ):
        e = wp.tid()
        f = facets[stencil[e, 0], which]
        r = rest[e]
        if f[6] > dtype(0.0):
            p = behind(vec3(f[0], f[1], f[2]), vec3(f[3], f[4], f[5]))
            for k in range(7):
                r[k] = p[k]
            for k in range(3):
                r[7 + k] = dtype(wp.inf)
            r[10] = dtype(0.0)
            r[12] = f[6] * areas[e]
            rest[e] = r
        elif r[10] == dtype(0.0):
            for k in range(3):
                r[7 + k] = dtype(0.0)
            r[10] = dtype(-FAR)
            rest[e] = r

    return pose


@cache
def anchor_on_mesh(dtype, bounded: bool):
    """Kernel over friction elements of one mesh at the start of a step, see :func:`.colliders.anchor_vertices`.

    N and n are the length and the direction of the sum over the facets at the vertex. Anchors are on the surface, and move with
    the triangle nearest to the vertex.
    """
    vec3, mat33 = types(dtype)
    _pose, anchor_type = pose_types(dtype)
    to_local, to_space = of_pose(dtype)
    corners, _from, _carry = geometry(dtype)
    nearest_beyond, _sweep, has_list, is_alone, _listed = queries(dtype)
    rest_type = wp.types.vector(8, dtype)
    zero, one = dtype(0.0), dtype(1.0)

    @wp.kernel(module="unique", enable_backward=False)
    def anchor(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        mesh: meshes(dtype),
        # state in
        x: wp.array(dtype=vec3),
        motion: motions(dtype),
        # parameters
        collider: int,
        per_copy: int,
        most: int,
        friction: dtype,
        lists: near_lists(dtype),
        # in and out
        anchors: wp.array(dtype=anchor_type),
        rest: wp.array(dtype=rest_type),
    ):
        e = wp.tid()
        i = stencil[e, 0]
        copy = e // per_copy
        distance = motion.r
        per_frame = motion.per_frame
        before = 2 * motion.steps[copy]
        p = to_local(motion.before[copy, collider], x[i])
        normals = mat33()
        gaps = vec3()
        faces = wp.vec3i()
        row = has_list(lists, collider, i, motion.steps[copy], p, zero)
        weights = mat33()
        count = wp.int32(0)
        searching = not is_alone(lists, collider, i, motion.steps[copy], p, zero)
        while searching and count < most:
            d, n, face, w = nearest_beyond(
                mesh, collider, before, per_frame, p, distance, dtype(BEYOND) * distance, count, normals, gaps, lists, row, i
            )
            searching = d > zero
            if searching:
                normals[count] = n
                gaps[count] = d
                faces[count] = face
                weights[count] = w
                count += 1
        depth = zero
        push = vec3()
        for j in range(count):
            share = zero
            for k in range(count):
                share += wp.abs(wp.dot(normals[j], normals[k]))
            force = -slope_of(gaps[j], distance)
            if wp.static(bounded):
                force = wp.max(distance - gaps[j], zero)
            depth += force / share
            push += force / share * normals[j]
        held = anchors[i]
        r = rest[e]
        kept = vec3()
        if depth > zero:
            n = wp.normalize(push)
            a = p - wp.dot(normals[0], gaps[0] * n) * n
            if held[3] > zero:
                u = p - vec3(held[0], held[1], held[2])
                u = u - wp.dot(n, u) * n
                l = wp.length(u)
                a = a - wp.where(l > held[3], held[3] / wp.max(l, held[3]), one) * u
            t = corners(mesh, collider, faces[0], before, per_frame)
            w = weights[0]
            foot = wp.transpose(t) * w
            kept = a
            if mesh.frames[collider] > 1:
                kept = a + wp.transpose(corners(mesh, collider, faces[0], before + 2, per_frame)) * w - foot
                a = a + wp.transpose(corners(mesh, collider, faces[0], before + motion.ahead, per_frame)) * w - foot
            now = motion.at[copy, collider]
            target = to_space(now, a)
            normal = turned_by(vec3(now[3], now[4], now[5]), now[6], n)
            for k in range(3):
                r[k] = target[k]
                r[3 + k] = normal[k]
        r[6] = friction * depth
        rest[e] = r
        anchors[i] = anchor_type(kept[0], kept[1], kept[2], friction * depth)

    return anchor


@cache
def filter_meshes(dtype):
    """Kernel over vertices at the end of a step: :func:`.colliders.filter_step` for colliders that include meshes.

    A vertex that a mesh stops moves with the triangle that stopped it, and slides along it until another one stops it. Each
    part of its way is tested against all triangles, so that it crosses none.
    """
    vec3, _mat33 = types(dtype)
    to_local, to_space = of_pose(dtype)
    kept_of, stopped_by = kept_part(dtype), stopped_by_shape(dtype)
    along, velocity = sliding(dtype)
    corners, from_triangle, carry = geometry(dtype)
    _nearest, sweep, has_list, is_alone, _listed = queries(dtype)
    zero, one = dtype(0.0), dtype(1.0)

    @wp.func
    def stopped(
        mesh: meshes(dtype),
        c: int,
        motion: motions(dtype),
        copy: int,
        p: vec3,
        end: vec3,
        friction: dtype,
        least: dtype,
        free: int,
        slides: int,
        lists: near_lists(dtype),
        i: int,
    ):
        """The end of a move from p to ``end``, its change, its push, and whether it is stopped.

        The last is 0, 1, or, for a free vertex that gets past the obstacle, 2.
        """
        per_frame = motion.per_frame
        before = 2 * motion.steps[copy]
        change = vec3()
        push = vec3()
        hit = wp.int32(0)
        moving = wp.bool(True)
        done = zero
        most = one
        thick = least
        rounds = wp.int32(0)
        while moving and rounds < CARRIES:
            row = has_list(lists, c, i, motion.steps[copy], p, wp.length(end - p))
            kept, n, face, w = sweep(mesh, c, before, before + 2, per_frame, p, end - p, done, thick, lists, row, i)
            if thick == least:
                moving = face >= 0 and free > 0
                hit = wp.where(face >= 0, 1, hit)
                most = kept
                thick = least + motion.landing
                if face >= 0 and free == 0:
                    t = corners(mesh, c, face, before + 2, per_frame)
                    if wp.dot(n, end - t[0]) > -least:
                        hit = 0
            else:
                rounds += 1
                kept = wp.min(kept, most)
                left = end - p
                p += kept * left
                left *= one - kept
                done += kept * (one - done)
                end = p
                by = -left
                thick = least
                moving = face >= 0 and (mesh.frames[c] > 1 or rounds <= slides)
                if moving:
                    t = corners(mesh, c, face, before, per_frame)
                    t_end = t
                    if mesh.frames[c] > 1:
                        t_end = corners(mesh, c, face, before + 2, per_frame)
                        t += done * (t_end - t)
                    d, n, w = from_triangle(p, t)
                    if mesh.frames[c] > 1:
                        n = carry(n, t, t_end)
                        end = wp.transpose(t_end) * w + d * n
                        left -= end - p
                        by = -left
                change -= left
                if moving and rounds <= slides:
                    left, by = along(left, n, friction)
                    end += left + wp.max(dtype(2.0) * least - d, zero) * n
                    change += left
                push += by
        if rounds == CARRIES:
            hit = 2
        return end, change, push, hit

    @wp.kernel(module="unique", enable_backward=False)
    def filter_vertices(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        shape: shapes(dtype),
        mesh: meshes(dtype),
        # state in
        x_before: wp.array(dtype=vec3),
        motion: motions(dtype),
        lists: near_lists(dtype),
        # parameters
        per_copy: int,
        # in and out
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        notes: FilterNotes,
    ):
        i = wp.tid()
        copy = i // per_copy
        vertex = i - copy * per_copy
        step = motion.steps[copy]
        count = shape.radius.shape[0]
        x0 = x_before[i]
        end = x[i]
        free = wp.where(inverse_mass[i] > zero, 1, 0)
        rounding = dtype(8.0) * epsilon(motion.least) * wp.max(wp.abs(end))
        most = wp.where(count > 1 and free > 0, ROUNDS, 1)
        change = vec3()
        push = vec3()
        cuts = wp.int32(0)
        last = wp.int32(0)
        rounds = wp.int32(0)
        while rounds <= cuts and rounds < most:  # another round after each cut
            rounds += 1
            for c in range(count):
                pose = motion.after[copy, c]
                p = to_local(motion.before[copy, c], x0)
                way = to_local(pose, end) - p
                hit = wp.int32(0)
                found = p
                less = vec3()
                by = vec3()
                if mesh.frames[c] > 0:
                    near = wp.max(rounding, dtype(8.0) * epsilon(motion.least) * wp.max(wp.abs(p)))
                    least = wp.where(free > 0, motion.least + near, near)
                    slides = wp.where(rounds <= SLIDING, SLIDES, 0)
                    if not is_alone(lists, c, i, step, p, wp.length(way)):
                        found, less, by, hit = stopped(
                            mesh, c, motion, copy, p, p + way, shape.friction[c], least, free, slides, lists, i
                        )
                    if hit > free:
                        note_inside(notes, copy, c, step, vertex, per_copy, wp.where(free > 0, c, count))
                elif free > 0:
                    found, less, by, short = stopped_by(
                        p,
                        way,
                        shape.core[c],
                        shape.radius[c],
                        shape.friction[c],
                        motion.least + rounding,
                        motion.landing,
                        rounds <= SLIDING,
                    )
                    hit = wp.where(short, 1, 0)
                else:
                    d, _n = local_gap_of(p, shape.core[c], shape.radius[c])
                    deep = -wp.max(rounding, dtype(8.0) * epsilon(motion.least) * wp.max(wp.abs(p)))
                    if d > deep and kept_of(p, way, shape.core[c], shape.radius[c], deep) < one:
                        note_inside(notes, copy, c, step, vertex, per_copy, count)
                if hit > 0 and free > 0:
                    end = to_space(pose, found)
                    change += turned_by(vec3(pose[3], pose[4], pose[5]), pose[6], less)
                    push += turned_by(vec3(pose[3], pose[4], pose[5]), pose[6], by)
                    cuts = rounds
                    last = c
        if cuts > 0:
            after = velocity(v[i], x[i] - x0, change, push, motion.h)
            note_cut(notes, copy, i, end - x[i], after - v[i])
            v[i] = after
            if move:
                move[i] = move[i] + (end - x[i])
            x[i] = end
        if cuts == ROUNDS:
            for c in range(count):
                p = to_local(motion.before[copy, c], x0)
                way = to_local(motion.after[copy, c], end) - p
                through = wp.bool(False)
                if mesh.frames[c] > 0:
                    _kept, _n, face, _w = sweep(
                        mesh, c, 2 * step, 2 * step + 2, motion.per_frame, p, way, zero, rounding, lists, -1, i
                    )
                    through = face >= 0
                else:
                    d, _n = local_gap_of(p + way, shape.core[c], shape.radius[c])
                    through = d <= zero
                if through:
                    note_inside(notes, copy, c, step, vertex, per_copy, last)

    return filter_vertices


@cache
def surface_moves(dtype):
    """Kernel over vertices after a step: displacements in it of the material of a deforming mesh at the points nearest to x.

    x and ``poses`` are those after ``when`` half steps. The displacement is 0 beyond the contact distance.
    """
    vec3, mat33 = types(dtype)
    pose_type, _anchor = pose_types(dtype)
    to_local, to_space = of_pose(dtype)
    corners, _from, _carry = geometry(dtype)
    nearest_beyond, _sweep, _has_list, _is_alone, _listed = queries(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def moves(
        # elements
        mesh: meshes(dtype),
        # state in
        x: wp.array(dtype=vec3),
        poses: wp.array2d(dtype=pose_type),
        motion: motions(dtype),
        # parameters
        when: int,
        collider: int,
        per_copy: int,
        lists: near_lists(dtype),
        # out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        copy = i // per_copy
        first = 2 * motion.steps[copy] - 2  # the first half step of the finished step
        p = to_local(poses[copy, collider], x[i])
        d, n, face, w = nearest_beyond(
            mesh, collider, first + when, motion.per_frame, p, motion.r, dtype(0.0), 0, mat33(), vec3(), lists, -1, i
        )
        found = vec3()
        if face >= 0:
            start = wp.transpose(corners(mesh, collider, face, first, motion.per_frame)) * w
            end = wp.transpose(corners(mesh, collider, face, first + 2, motion.per_frame)) * w
            found = to_space(motion.after[copy, collider], end + d * n) - to_space(motion.before[copy, collider], start + d * n)
        out[i] = found

    return moves
