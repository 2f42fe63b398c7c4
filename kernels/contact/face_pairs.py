"""Factories of the kernels of the pairs of triangles of the cloth with mesh colliders, which have contact and friction.

A pair is a triangle of the cloth and a vertex of the mesh in front of it, or an edge of the triangle and one of the mesh that
crosses it. Each edge of the cloth counts for one of its triangles. In a step it is the contact of a point of the triangle, with
fixed weights w, with the half-space behind the point of the mesh, see :mod:`..terms.face_contact`. The contact of vertices of
the cloth is that of :mod:`.mesh_facets`.

Where the vertices of a triangle are as near as the point, as on a plane, they carry it alone: of its area A a pair has the part
min(2e/r, 1), with e = Σ wᵢgᵢ − g the excess of the distances gᵢ of the vertices from the mesh over that of the point, g. The
pairs of one triangle divide the area as the half-spaces of a vertex do.

All is in the frame of the collider, in float64, as in :mod:`.mesh_faces`.
"""

from functools import cache

import warp as wp

from ..coulomb import Law
from ..terms import contact
from ..terms.face_contact import PAIRS, PARAMETERS, WEIGHTS
from ..terms.face_friction import PARAMETERS as OF_FRICTION
from ..vectors import types
from .colliders import half_space
from .mesh_faces import local_frames
from .mesh_facets import BEYOND, FAR
from .mesh_geometry import corners_of, motions
from .mesh_geometry import meshes as meshes_of
from .self_gaps import ONE, ZERO, nearest, vertex_of

# The area of two edges decreases if sin² of their angle is below this, to 0 for parallel edges.
PARALLEL = wp.constant(wp.float64(1e-3))

MOST, WEIGHT = wp.constant(PAIRS), wp.constant(WEIGHTS)
TWO = wp.constant(wp.float64(2.0))
# Two pairs whose weights differ by more count both, though one is behind the other.
APART = wp.constant(wp.float64(0.25))
# By how much a foot may be beside a triangle or an edge where both pass through one another.
BESIDE = wp.constant(wp.float64(0.01))
HALVINGS = wp.constant(24)


@wp.struct
class Owned:
    """Each edge and vertex counts for one triangle only: bits of the edges 01, 12 and 20 of each triangle of the cloth, in
    ``cloth``, and of a mesh, in ``mesh``, where those of its vertices follow."""

    cloth: wp.array(dtype=wp.int32)
    mesh: wp.array(dtype=wp.int32)


@wp.struct
class FacePair:
    """A pair in a step: the weights w; the point and the normal of the half-space; the part of the area, 0 for none.

    Also the gap where the step began, and the triangle of the mesh that has the point, with its barycentric coordinates.
    """

    weights: wp.vec3d
    point: wp.vec3d
    normal: wp.vec3d
    share: wp.float64
    gap: wp.float64
    triangle: wp.int32
    coordinates: wp.vec3d


@wp.func
def foot(of_vertex: bool, i: int, p: wp.mat33d, a: wp.vec3d, b: wp.vec3d):
    """The feet of a pair: w on the triangle p, t on the edge from a to b, a normal, the gap along it, and a factor of the area.

    A pair is p and a, or the edge i of p and the edge from a to b. The factor is that of nearly parallel edges, 0 without feet.
    """
    w = wp.vec3d()
    t = ZERO
    d = ZERO
    factor = ZERO
    j = wp.where(i == 2, 0, i + 1)
    u = p[1] - p[0]
    v = p[2] - p[0]
    if not of_vertex:
        u = p[j] - p[i]
        v = b - a
    m = wp.cross(u, v)
    square = wp.dot(m, m)
    sine = ZERO
    if square > ZERO:
        sine = square / (wp.dot(u, u) * wp.dot(v, v))
    if of_vertex and square > ZERO:
        factor = ONE
        w[1] = wp.dot(wp.cross(a - p[0], v), m) / square
        w[2] = wp.dot(wp.cross(u, a - p[0]), m) / square
        w[0] = ONE - w[1] - w[2]
        d = wp.dot(m, p[0] - a)
    elif sine > wp.float64(1e-3) * PARALLEL:
        c = p[i] - a
        s = wp.dot(wp.cross(v, c), m) / square
        t = wp.dot(wp.cross(u, c), m) / square
        w[i] = ONE - s
        w[j] = s
        d = wp.dot(m, c)
        z = wp.min(sine / PARALLEL, ONE)
        factor = z * (TWO - z)
    if factor > ZERO:
        size = wp.sqrt(square)
        m = m / size
        d = d / size
    return w, t, m, d, factor


@wp.func
def between_ends(w: wp.vec3d, t: wp.float64, beside: wp.float64):
    """Whether feet are in the triangle and on the edge."""
    return wp.min(wp.min(wp.min(w), t), ONE - t) >= -beside


@wp.func
def pair_ahead(
    of_vertex: bool,
    i: int,
    p: wp.mat33d,
    p_end: wp.mat33d,
    a: wp.vec3d,
    b: wp.vec3d,
    a_end: wp.vec3d,
    b_end: wp.vec3d,
    most: wp.float64,
):
    """A pair at the end of a way: whether it has feet and is nearer than ``most``; w, t, n, the signed gap, the factor.

    n points to the side on which the point of the triangle began. The gap is negative if the two passed through one another on
    the way; a pair that got to the other side around one another has no contact.
    """
    w, t, n, d, factor = foot(of_vertex, i, p_end, a_end, b_end)
    found = factor > ZERO and between_ends(w, t, ZERO)
    if found:
        _w, _t, _n, before, known = foot(of_vertex, i, p, a, b)
        started = wp.dot(n, wp.transpose(p) * w - a - t * (b - a))
        through = wp.bool(False)
        if started * d <= ZERO and known > ZERO and before * d < ZERO:
            low = ZERO
            high = ONE
            for _k in range(HALVINGS):
                middle = wp.float64(0.5) * (low + high)
                _w1, _t1, _n1, now, _f1 = foot(
                    of_vertex, i, p + middle * (p_end - p), a + middle * (a_end - a), b + middle * (b_end - b)
                )
                if now * before > ZERO:
                    low = middle
                else:
                    high = middle
            w1, t1, _n2, _d2, f1 = foot(of_vertex, i, p + low * (p_end - p), a + low * (a_end - a), b + low * (b_end - b))
            through = f1 > ZERO and between_ends(w1, t1, BESIDE)
        if started < ZERO or (started == ZERO and d < ZERO):
            n = -n
            d = -d
        found = d < most and (d > ZERO or through)
    return found, w, t, n, d, factor


@cache
def distance_of(dtype):
    """The device function (mesh, collider, halves, per_frame, p, most) → the distance of p from a mesh, at most ``most``."""
    corners = corners_of(dtype, wp.float64)

    @wp.func
    def distance(mesh: meshes_of(dtype), c: int, halves: int, per_frame: int, p: wp.vec3d, most: wp.float64):
        square = most * most
        k = wp.int32(0)
        query = wp.bvh_query_sphere(mesh.bvh[c], wp.vec3(p), wp.float32(most) * wp.float32(1.0001) + mesh.margin[c])
        while wp.bvh_query_next(query, k):
            q = corners(mesh, c, k, halves, per_frame)
            if q[0] == q[1] and q[1] == q[2]:
                continue  # absent
            _w, y, _in = nearest(True, p, q[0], q[1], q[2])
            square = wp.min(square, wp.dot(y, y))
        return wp.sqrt(square)

    return distance


@cache
def find_face_pairs(dtype, ahead: bool):
    """Kernel over triangles of the cloth where a step begins: the pairs of each with one mesh, the nearest first.

    With ``ahead`` they are those at the prediction x + h v + h² g, and where that has none, or else, those at x. A pair behind
    the half-space of another counts only if it is at another part of the triangle.
    """
    vec3, _ = types(dtype)
    corners, distance = corners_of(dtype, wp.float64), distance_of(dtype)
    to_local, _to_space = local_frames(dtype)
    _at, exact = vertex_of(dtype)

    @wp.kernel(module=f"warpcloth.face_pairs.{dtype.__name__}.{ahead}", enable_backward=False)
    def find_pairs_of_each_face(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        owned: Owned,
        inverse_mass: wp.array(dtype=dtype),
        mesh: meshes_of(dtype),
        gravity: wp.array(dtype=vec3),
        per_gravity: int,
        # state in
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        motion: motions(dtype),
        # parameters
        collider: int,
        per_copy: int,
        # out
        pairs: wp.array2d(dtype=FacePair),
    ):
        f = wp.tid()
        copy = f // per_copy
        per_frame = motion.per_frame
        before = 2 * motion.steps[copy]
        r = wp.float64(motion.r)
        p = wp.mat33d()
        p_end = wp.mat33d()
        for i in range(3):
            s = stencil[f, i]
            p[i] = to_local(motion.before[copy, collider], exact(x[s]))
            p_end[i] = p[i]
            if wp.static(ahead):
                end = x[s]
                if inverse_mass[s] > dtype(0.0):
                    end += motion.h * (v[s] + motion.h * gravity[s // per_gravity])
                p_end[i] = to_local(motion.after[copy, collider], exact(end))
        way = ZERO
        for i in range(3):
            way = wp.max(way, wp.length(p_end[i] - p[i]))
        low = wp.min(wp.min(wp.min(p[0], p[1]), p[2]), wp.min(wp.min(p_end[0], p_end[1]), p_end[2]))
        high = wp.max(wp.max(wp.max(p[0], p[1]), p[2]), wp.max(wp.max(p_end[0], p_end[1]), p_end[2]))
        margin = wp.float32(TWO * r) + mesh.margin[collider]
        edge = wp.vec3(margin, margin, margin)
        normals = wp.mat33d()
        points = wp.mat33d()
        weights = wp.mat33d()
        barycentric = wp.mat33d()
        gaps = wp.vec3d()
        factors = wp.vec3d()
        sides = wp.vec3i()
        count = wp.int32(0)
        end_of_step = wp.bool(wp.static(ahead))
        searching = wp.bool(True)
        while searching and count < MOST:
            best = TWO * r
            face = wp.int32(-1)
            k = wp.int32(0)
            query = wp.bvh_query_aabb(mesh.bvh[collider], wp.vec3(low) - edge, wp.vec3(high) + edge)
            while wp.bvh_query_next(query, k):
                q = corners(mesh, collider, k, before, per_frame)
                q_end = q
                if end_of_step and mesh.frames[collider] > 1:
                    q_end = corners(mesh, collider, k, before + 2, per_frame)
                if q[0] == q[1] and q[1] == q[2]:
                    continue  # absent
                which = wp.int32(0)
                while which < 12:
                    j = which // 4
                    i = which - 4 * j  # 3 for the vertex
                    which += 1
                    of_vertex = i == 3
                    if of_vertex:
                        i = wp.int32(0)
                        if (owned.mesh[k] >> (3 + j)) % 2 == 0:
                            continue
                    elif (owned.cloth[f] >> i) % 2 == 0 or (owned.mesh[k] >> j) % 2 == 0:
                        continue
                    next = wp.where(j == 2, 0, j + 1)
                    meets, w, t, n, d, factor = pair_ahead(of_vertex, i, p, p_end, q[j], q[next], q_end[j], q_end[next], best)
                    if meets:
                        foot_at = q_end[j] + t * (q_end[next] - q_end[j])
                        hidden = wp.bool(False)
                        for other in range(count):
                            away = w - weights[other]
                            differ = wp.abs(away[0]) + wp.abs(away[1]) + wp.abs(away[2])
                            beyond = wp.dot(normals[other], foot_at - points[other])
                            if beyond <= wp.float64(BEYOND) * r and differ < APART:
                                hidden = wp.bool(True)
                        if not hidden:
                            best = d
                            face = k
                            normals[count] = n
                            points[count] = foot_at
                            weights[count] = w
                            barycentric[count] = wp.vec3d()
                            barycentric[count, j] = ONE - t
                            barycentric[count, next] = barycentric[count, next] + t
                            gaps[count] = d
                            factors[count] = factor
                            sides[count] = k
            if face >= 0:
                count += 1
            elif count == 0 and end_of_step:
                p_end = p
                end_of_step = wp.bool(False)
            else:
                searching = wp.bool(False)
        distances = wp.vec3d()
        most = TWO * r + way
        if count > 0:
            for i in range(3):
                distances[i] = distance(mesh, collider, before, per_frame, p[i], most)
        for j in range(MOST):
            pair = FacePair()
            if j < count:
                w = weights[j]
                shared = ZERO
                for k in range(count):
                    near = wp.clamp(TWO - gaps[k] / r, ZERO, ONE)
                    if k == j:
                        near = ONE
                    shared += near * wp.abs(wp.dot(normals[j], normals[k]))
                at = wp.transpose(p) * w
                excess = wp.dot(w, distances) - distance(mesh, collider, before, per_frame, at, most)
                part = factors[j] * wp.clamp(TWO * excess / r, ZERO, ONE) / shared
                bary = barycentric[j]
                start = wp.transpose(corners(mesh, collider, sides[j], before, per_frame)) * bary
                pair.weights = w
                pair.point = wp.transpose(corners(mesh, collider, sides[j], before + motion.ahead, per_frame)) * bary
                pair.normal = normals[j]
                pair.share = part
                pair.gap = wp.dot(normals[j], at - start)
                pair.triangle = sides[j]
                pair.coordinates = bary
            pairs[f, j] = pair

    return find_pairs_of_each_face


@cache
def pose_face_pairs(dtype):
    """Kernel over the elements of contact with one of the pairs of each triangle: rest states; far away if there is none."""
    vec3, _ = types(dtype)
    _to_local, to_space = local_frames(dtype)
    behind, rest_type = half_space(dtype), wp.types.vector(PARAMETERS, dtype)

    @wp.kernel(module=f"warpcloth.face_pairs.{dtype.__name__}", enable_backward=False)
    def pose_each_pair(
        # elements
        triangles: wp.array(dtype=wp.int32),
        areas: wp.array(dtype=dtype),
        # state in
        pairs: wp.array2d(dtype=FacePair),
        motion: motions(dtype),
        # parameters
        which: int,
        collider: int,
        per_copy: int,
        # in and out
        rest: wp.array(dtype=rest_type),
    ):
        e = wp.tid()
        f = triangles[e]
        pair = pairs[f, which]
        r = rest[e]
        if pair.share > ZERO:
            pose = motion.at[f // per_copy, collider]
            point = to_space(pose, pair.point)
            n = to_space(pose, pair.normal) - to_space(pose, wp.vec3d())
            p = behind(vec3(dtype(point[0]), dtype(point[1]), dtype(point[2])), vec3(dtype(n[0]), dtype(n[1]), dtype(n[2])))
            for k in range(7):
                r[k] = p[k]
            for k in range(3):
                r[7 + k] = dtype(wp.inf)
                r[WEIGHT + k] = dtype(pair.weights[k])
            r[10] = dtype(0.0)
            r[WEIGHT + 3] = dtype(pair.share) * areas[e]
            rest[e] = r
        elif r[10] == dtype(0.0):
            for k in range(3):
                r[7 + k] = dtype(0.0)
            r[10] = dtype(-FAR)
            rest[e] = r

    return pose_each_pair


@cache
def anchor_type(dtype):
    """Type of the anchor of a triangle: a position in the frame of the collider, ε, and the weights of the point held there."""
    return wp.types.vector(7, dtype)


@cache
def anchor_face_pairs(dtype, law: Law, bounded: bool):
    """Kernel over the elements of friction with one mesh where a step begins: anchors, and the rest states of the step.

    Follows :func:`.anchors.anchor_vertices`. The point is the mean of those of the pairs by their forces; N and n are the
    length and the direction of the sum. u is the displacement of the point that the last step held; from the present point the
    anchor is as far away.
    """
    vec3, _ = types(dtype)
    corners = corners_of(dtype, wp.float64)
    to_local, to_space = local_frames(dtype)
    _at, exact = vertex_of(dtype)
    kept_type, rest_type = anchor_type(dtype), wp.types.vector(OF_FRICTION, dtype)
    slope, kept_of, limit = contact.bounded_slope if bounded else contact.slope, law.kept, law.limit

    @wp.kernel(module=f"warpcloth.face_pairs.{law.name}.{dtype.__name__}.{bounded}", enable_backward=False)
    def anchor_each_triangle(
        # elements
        triangles: wp.array(dtype=wp.int32),
        areas: wp.array(dtype=dtype),
        stencil: wp.array2d(dtype=wp.int32),
        mesh: meshes_of(dtype),
        # state in
        pairs: wp.array2d(dtype=FacePair),
        x: wp.array(dtype=vec3),
        motion: motions(dtype),
        # parameters
        collider: int,
        per_copy: int,
        friction: dtype,
        # in and out
        anchors: wp.array2d(dtype=kept_type),
        rest: wp.array(dtype=rest_type),
    ):
        e = wp.tid()
        f = triangles[e]
        copy = f // per_copy
        area = ZERO
        total = ZERO
        push = wp.vec3d()
        w = wp.vec3d()
        strongest = wp.int32(-1)
        force = ZERO
        for j in range(MOST):
            pair = pairs[f, j]
            if pair.share > ZERO and pair.gap < wp.float64(motion.r):
                pressed = -pair.share * slope(pair.gap, wp.float64(motion.r))
                area += pair.share
                total += pressed
                push += pressed * pair.normal
                w += pressed * pair.weights
                if pressed > force:
                    force = pressed
                    strongest = j
        held = anchors[copy, f - copy * per_copy]
        kept = kept_type()
        r = rest[e]
        r[6] = dtype(0.0)
        size = wp.length(push)
        if strongest >= 0 and size > ZERO and friction > dtype(0.0):
            n = push / size
            w = w / total
            before = motion.before[copy, collider]
            p = wp.mat33d()
            for i in range(3):
                p[i] = to_local(before, exact(x[stencil[e, i]]))
            a = wp.transpose(p) * w
            if held[3] > dtype(0.0):
                at = wp.transpose(p) * wp.vec3d(wp.float64(held[4]), wp.float64(held[5]), wp.float64(held[6]))
                u = at - wp.vec3d(wp.float64(held[0]), wp.float64(held[1]), wp.float64(held[2]))
                u = u - wp.dot(n, u) * n
                a = a - kept_of(wp.length(u), wp.float64(held[3])) * u
            stay = a
            if mesh.frames[collider] > 1:
                side = pairs[f, strongest].triangle
                bary = pairs[f, strongest].coordinates
                first = 2 * motion.steps[copy]
                start = wp.transpose(corners(mesh, collider, side, first, motion.per_frame)) * bary
                stay = a + wp.transpose(corners(mesh, collider, side, first + 2, motion.per_frame)) * bary - start
                a = a + wp.transpose(corners(mesh, collider, side, first + motion.ahead, motion.per_frame)) * bary - start
            now = motion.at[copy, collider]
            target = to_space(now, a)
            normal = to_space(now, n) - to_space(now, wp.vec3d())
            stretch = limit(dtype(size / area), friction)
            for k in range(3):
                r[k] = dtype(target[k])
                r[3 + k] = dtype(normal[k])
                r[7 + k] = dtype(w[k])
                kept[k] = dtype(stay[k])
                kept[4 + k] = dtype(w[k])
            r[6] = stretch
            r[10] = dtype(area) * areas[e]
            kept[3] = stretch
        rest[e] = r
        anchors[copy, f - copy * per_copy] = kept

    return anchor_each_triangle
