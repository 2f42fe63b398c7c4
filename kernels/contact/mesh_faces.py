"""Factories of the kernels of the filter that keeps the triangles of the cloth apart from those of a mesh that is a collider.

Two triangles that do not cross have a plane between them, normal to the shortest vector between the two. As long as the
vertices of each stay on their side of a plane, the triangles do not cross. This covers vertices of the mesh against triangles
of the cloth, and edges against edges; the filter of :mod:`.mesh_filter` has only vertices of the cloth.

All is in the frame of the collider, in float64, where x₀ is where the step began and x its end. Vertices of both sides move
linearly. A *face* is a triangle of the cloth, or an edge of no triangle, whose last vertex is then there twice.
"""

from functools import cache

import warp as wp

from ..terms.contact import turned
from ..vectors import types
from .collider_filter import FilterNotes
from .colliders import pose_types
from .mesh_geometry import corners_of, motions
from .mesh_geometry import meshes as meshes_of
from .self_gaps import ONE, ZERO, nearest, vertex_of

turned_by = turned
SEARCHES = wp.constant(32)  # separating planes between two triangles in a step, at most
KEPT = wp.constant(wp.float64(0.9))  # of its way to a plane, what a vertex keeps
ULP = wp.constant(wp.float64(1.1920929e-07))  # of float32, over the number, at most
# Rounds in which vertices slide along planes, at most; then they only keep a share of their moves, which ends. That keeps them
# out of a mesh that stands, not out of one that moves onto them, so it must be the exception.
ROUNDS = wp.constant(64)


@wp.struct
class Faces:
    """The vertices of all faces, and which faces vertex i has: those in ``of_vertex`` from ``first`` [i] to first[i+1]."""

    vertices: wp.array(dtype=wp.vec3i)
    first: wp.array(dtype=wp.int32)
    of_vertex: wp.array(dtype=wp.int32)


@wp.func
def between(p: wp.mat33d, q: wp.mat33d):
    """Distance d of two triangles, the direction from q to p, and whether they do not cross."""
    y = wp.vec3d()
    best = wp.float64(wp.inf)
    i = wp.int32(0)
    while i < 3:
        _w, away, _in = nearest(True, p[i], q[0], q[1], q[2])
        square = wp.dot(away, away)
        if square < best:
            best = square
            y = away
        _w2, towards, _in2 = nearest(True, q[i], p[0], p[1], p[2])
        square = wp.dot(towards, towards)
        if square < best:
            best = square
            y = -towards
        i += 1
    k = wp.int32(0)
    while k < 9:
        i = k // 3
        j = k - 3 * i
        _w3, across, _in3 = nearest(False, p[i], p[(i + 1) % 3], q[j], q[(j + 1) % 3])
        square = wp.dot(across, across)
        if square < best:
            best = square
            y = across
        k += 1
    d = wp.length(y)
    n = y / wp.max(d, wp.float64(1e-300))
    apart = least_along(n, p) - most_along(n, q)
    return d, n, apart > wp.float64(0.5) * d


@wp.func
def least_along(n: wp.vec3d, p: wp.mat33d):
    return wp.min(wp.min(wp.dot(n, p[0]), wp.dot(n, p[1])), wp.dot(n, p[2]))


@wp.func
def most_along(n: wp.vec3d, p: wp.mat33d):
    return wp.max(wp.max(wp.dot(n, p[0]), wp.dot(n, p[1])), wp.dot(n, p[2]))


@wp.func
def stays_between(m: wp.vec3d, p: wp.mat33d, p_end: wp.mat33d, q: wp.mat33d, q_end: wp.mat33d, least: wp.float64):
    """Whether a plane of a normal of any length, that moves along it, separates two triangles all the time."""
    side = wp.where(wp.dot(m, p[0] - q[0]) < ZERO, -m, m)
    gap = wp.min(least_along(side, p) - most_along(side, q), least_along(side, p_end) - most_along(side, q_end))
    return gap > ZERO and gap * gap > least * least * wp.dot(m, m)


@wp.func
def passes_beside(p: wp.mat33d, p_end: wp.mat33d, q: wp.mat33d, q_end: wp.mat33d, least: wp.float64):
    """Whether the plane of either triangle, or one through an edge and normal to that, separates them, as is so for most."""
    m = wp.cross(q[1] - q[0], q[2] - q[0])
    if stays_between(m, p, p_end, q, q_end, least):
        return True
    k = wp.cross(p[1] - p[0], p[2] - p[0])
    if stays_between(k, p, p_end, q, q_end, least):
        return True
    i = wp.int32(0)
    while i < 3:
        j = wp.where(i == 2, 0, i + 1)
        if stays_between(wp.cross(m, q[j] - q[i]), p, p_end, q, q_end, least):
            return True
        if stays_between(wp.cross(k, p[j] - p[i]), p, p_end, q, q_end, least):
            return True
        i += 1
    return False


@wp.func
def first_contact(p: wp.mat33d, move: wp.mat33d, q: wp.mat33d, drift: wp.mat33d, least: wp.float64):
    """When two triangles that move would be nearer than ``least``, or than they are; a number above 1 if they never are.

    The plane normal to the distance separates them until one of the vertices passes it; from there the next decides. Also the
    normals of the first plane and of the last, and the distance at the start. Triangles that cross at the start never meet.
    """
    d, n, apart = between(p, q)
    start = d
    first = n
    when = wp.float64(2.0)
    if apart and d > ZERO:
        lowest = wp.min(least, KEPT * d)
        fastest = ZERO
        for i in range(3):
            for j in range(3):
                fastest = wp.max(fastest, wp.length(move[i] - drift[j]))
        done = ZERO
        k = wp.int32(0)
        searching = d - lowest < fastest
        while searching:
            k += 1
            step = ONE - done
            for i in range(3):
                for j in range(3):
                    approach = wp.dot(n, drift[j] - move[i])
                    if approach > ZERO:
                        gap = wp.dot(n, p[i] + done * move[i] - q[j] - done * drift[j]) - lowest
                        step = wp.min(step, wp.max(gap, ZERO) / approach)
            if step >= ONE - done:
                searching = False
            else:
                done += step
                if step * fastest < wp.float64(0.02) * lowest or k == SEARCHES:
                    when = done
                    searching = False
                else:
                    d, n, apart = between(p + done * move, q + done * drift)
                    if not apart:
                        when = done
                        n = first
                        searching = False
    return when, first, n, start


@cache
def local_frames(dtype):
    """The device functions (pose, x) → x in the frame of a pose, and (pose, X) → X in space, in float64."""
    pose_type, _anchor = pose_types(dtype)

    @wp.func
    def exactly(pose: pose_type):
        u = wp.vec3d(wp.float64(pose[3]), wp.float64(pose[4]), wp.float64(pose[5]))
        w = wp.float64(pose[6])
        size = wp.sqrt(wp.dot(u, u) + w * w)  # rotations in float32 would scale
        return wp.vec3d(wp.float64(pose[0]), wp.float64(pose[1]), wp.float64(pose[2])), u / size, w / size

    @wp.func
    def to_local(pose: pose_type, x: wp.vec3d):
        position, u, w = exactly(pose)
        return turned_by(-u, w, x - position)

    @wp.func
    def to_space(pose: pose_type, X: wp.vec3d):
        position, u, w = exactly(pose)
        return turned_by(u, w, X) + position

    return to_local, to_space


@cache
def free_part(dtype):
    """Device function (mobility, i, x, other) → x, along locked axes ``other``."""
    vec3, _ = types(dtype)

    @wp.func
    def where_free(mobility: wp.array(dtype=vec3), i: int, x: wp.vec3d, other: vec3):
        found = vec3(dtype(x[0]), dtype(x[1]), dtype(x[2]))
        if mobility:
            for axis in range(3):
                if mobility[i][axis] == dtype(0.0):
                    found[axis] = other[axis]
        return found

    return where_free


@cache
def ways_of(dtype):
    """The device function (…) → a face at the start and at the end of its way in the frame of a mesh, and the box of the way.

    Also the distance that it keeps: ``least`` or, if that is more, 4 units in the last place of float32.
    """
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    pose_type, _anchor = pose_types(dtype)
    to_local, _to_space = local_frames(dtype)

    @wp.func
    def way(v: wp.vec3i, x: wp.array(dtype=vec3), end: wp.array(dtype=vec3), before: pose_type, after: pose_type, r: dtype):
        p = wp.mat33d()
        p_end = wp.mat33d()
        far = ZERO
        for i in range(3):
            p[i] = to_local(before, exact(x[v[i]]))
            p_end[i] = to_local(after, exact(end[v[i]]))
            far = wp.max(far, wp.max(wp.max(wp.abs(exact(end[v[i]]))), wp.max(wp.abs(p[i]))))
        ulp = ULP * far
        least = wp.max(wp.float64(r), wp.float64(4.0) * ulp) + wp.float64(2.0) * ulp
        low = wp.min(wp.min(wp.min(p[0], p[1]), p[2]), wp.min(wp.min(p_end[0], p_end[1]), p_end[2]))
        high = wp.max(wp.max(wp.max(p[0], p[1]), p[2]), wp.max(wp.max(p_end[0], p_end[1]), p_end[2]))
        more = wp.float64(1e-6) * far + wp.float64(2.0) * least
        edge = wp.vec3d(more, more, more)
        return p, p_end, least, wp.vec3(low - edge), wp.vec3(high + edge)

    return way


@cache
def find_planes(dtype):
    """Kernel over faces: the plane of one mesh that each must not pass, n and h of n·x ≥ h, or 0.

    It is that of the triangle of the mesh that a face would meet first. This is below it where the step ends, and below a
    parallel plane where the step began, of which the face was above. A face of which no vertex has been ``moved`` in the
    ``round`` before is as it was. ``latest`` counts rounds up to the last with a plane, (B,). Triangles that cross where the
    step begins are left alone.
    """
    vec3, _ = types(dtype)
    corners, way = corners_of(dtype, wp.float64), ways_of(dtype)

    @wp.kernel(module=f"warpcloth.mesh_faces.{dtype.__name__}", enable_backward=False)
    def find_each_plane(
        # elements
        faces: Faces,
        mesh: meshes_of(dtype),
        # state in
        x_before: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        motion: motions(dtype),
        round: wp.array(dtype=wp.int32),
        moved: wp.array(dtype=wp.int32),
        # parameters
        collider: int,
        per_copy: int,
        # out
        planes: wp.array(dtype=wp.vec4d),
        found: wp.array(dtype=wp.int32),
        latest: wp.array(dtype=wp.int32),
    ):
        f = wp.tid()
        v = faces.vertices[f]
        planes[f] = wp.vec4d()
        if wp.max(wp.max(moved[v[0]], moved[v[1]]), moved[v[2]]) < round[0]:
            return
        copy = v[0] // per_copy
        before = 2 * motion.steps[copy]
        start = motion.before[copy, collider]
        p, p_end, least, low, high = way(v, x_before, x, start, motion.after[copy, collider], motion.least)
        margin = wp.vec3(mesh.margin[collider])
        query = wp.bvh_query_aabb(mesh.bvh[collider], low - margin, high + margin)
        soonest = wp.float64(2.0)
        face = wp.int32(-1)
        k = wp.int32(0)
        while wp.bvh_query_next(query, k):
            q = corners(mesh, collider, k, before, motion.per_frame)
            q_end = q
            if mesh.frames[collider] > 1:
                q_end = corners(mesh, collider, k, before + 2, motion.per_frame)
            if q[0] == q[1] and q[1] == q[2]:
                continue  # absent
            if passes_beside(p, p_end, q, q_end, least):
                continue
            when, first, n, d = first_contact(p, p_end - p, q, q_end - q, least)
            if when < soonest or (when == soonest and when <= ONE and k < face):
                soonest = when
                face = k
                gap = least_along(n, p) - most_along(n, q)
                if KEPT * gap <= wp.min(least, KEPT * d):  # then only the first plane surely separates them at the start
                    n = first
                    gap = d
                # Lifted as by the filter of vertices, or rounding would take it nearer step by step.
                h = most_along(n, q_end) + wp.clamp(gap, wp.float64(2.0) * least, wp.float64(motion.landing) + least)
                planes[f] = wp.vec4d(n[0], n[1], n[2], h)
        if face >= 0:
            found[0] = 1
            latest[copy] = round[0] + 1

    return find_each_plane


@cache
def follow_planes(dtype):
    """Kernel over vertices: moves x to the allowed sides of the planes of the faces of each."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    (to_local, to_space), where_free = local_frames(dtype), free_part(dtype)

    @wp.kernel(module=f"warpcloth.mesh_faces.{dtype.__name__}", enable_backward=False)
    def follow_each_plane(
        # elements
        mobility: wp.array(dtype=vec3),
        inverse_mass: wp.array(dtype=dtype),
        faces: Faces,
        # state in
        motion: motions(dtype),
        planes: wp.array(dtype=wp.vec4d),
        found: wp.array(dtype=wp.int32),
        round: wp.array(dtype=wp.int32),
        # parameters
        collider: int,
        per_copy: int,
        # in and out
        x: wp.array(dtype=vec3),
        moved: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        if found[0] == 0 or inverse_mass[i] == dtype(0.0):
            return
        pose = motion.after[i // per_copy, collider]
        start = x[i]
        end = to_local(pose, exact(start))
        changed = wp.bool(False)
        passes = wp.int32(0)
        again = wp.bool(True)
        while again and passes < 8:
            passes += 1
            again = wp.bool(False)
            for k in range(faces.first[i], faces.first[i + 1]):
                plane = planes[faces.of_vertex[k]]
                n = wp.vec3d(plane[0], plane[1], plane[2])
                short = plane[3] - wp.dot(n, end)
                if short > ZERO and wp.dot(n, n) > ZERO:
                    end += short * n
                    again = wp.bool(True)
                    changed = wp.bool(True)
        if changed:
            x[i] = where_free(mobility, i, to_space(pose, end), start)
            moved[i] = round[0] + 1

    return follow_each_plane


@cache
def end_round():
    """Kernel of one thread: whether another round follows, as planes were ``found`` in this, or rounds have run out."""

    @wp.kernel(module="warpcloth.mesh_faces", enable_backward=False)
    def end_each_round(
        # in and out
        found: wp.array(dtype=wp.int32),
        round: wp.array(dtype=wp.int32),
        # out
        proceed: wp.array(dtype=wp.int32),
        unfinished: wp.array(dtype=wp.int32),
    ):
        some = wp.int32(0)
        for c in range(found.shape[0]):
            some = wp.max(some, found[c])
            found[c] = 0
        round[0] = round[0] + 1
        proceed[0] = wp.where(round[0] < ROUNDS, some, 0)
        unfinished[0] = some

    return end_each_round


@cache
def find_shares(dtype):
    """Kernel over faces: which share of the way from x to ``end`` each of its vertices may go.

    That is 0.9 of the way to the planes between the face at x and the triangles of the mesh, of all that might meet it. So
    vertices that go less far stay on their sides too. With ``latest``, x is where the step began, as is the mesh, and copies
    whose rounds have ended before are left out; else the mesh is where the step ends.
    """
    vec3, _ = types(dtype)
    corners, way = corners_of(dtype, wp.float64), ways_of(dtype)

    @wp.kernel(module=f"warpcloth.mesh_faces.{dtype.__name__}", enable_backward=False)
    def find_each_share(
        # elements
        faces: Faces,
        mesh: meshes_of(dtype),
        # state in
        x: wp.array(dtype=vec3),
        end: wp.array(dtype=vec3),
        motion: motions(dtype),
        latest: wp.array(dtype=wp.int32),
        # parameters
        collider: int,
        per_copy: int,
        # out
        shares: wp.array(dtype=wp.vec3d),
    ):
        f = wp.tid()
        v = faces.vertices[f]
        copy = v[0] // per_copy
        when = 2 * motion.steps[copy]
        start = motion.before[copy, collider]
        if latest:
            if latest[copy] < ROUNDS:
                shares[f] = wp.vec3d(ONE, ONE, ONE)
                return
        else:
            when += 2
            start = motion.after[copy, collider]
        p, p_end, least, low, high = way(v, x, end, start, motion.after[copy, collider], motion.least)
        margin = wp.vec3(mesh.margin[collider])
        query = wp.bvh_query_aabb(mesh.bvh[collider], low - margin, high + margin)
        share = wp.vec3d(ONE, ONE, ONE)
        k = wp.int32(0)
        while wp.bvh_query_next(query, k):
            q = corners(mesh, collider, k, when, motion.per_frame)
            if q[0] == q[1] and q[1] == q[2]:
                continue  # absent
            if passes_beside(p, p_end, q, q, least):
                continue
            d, n, apart = between(p, q)
            if apart and d > ZERO:
                h = most_along(n, q) + wp.float64(0.1) * wp.min(d, least)
                for i in range(3):
                    approach = wp.dot(n, p[i] - p_end[i])
                    if approach > ZERO:
                        share[i] = wp.min(share[i], KEPT * wp.max(wp.dot(n, p[i]) - h, ZERO) / approach)
        shares[f] = share

    return find_each_share


@cache
def keep_shares(dtype):
    """Kernel over vertices: lowers ``least``, or else shortens the way from x to ``end`` in the frame of a mesh, to the least
    share of the faces of each."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    (to_local, to_space), where_free = local_frames(dtype), free_part(dtype)

    @wp.kernel(module=f"warpcloth.mesh_faces.{dtype.__name__}", enable_backward=False)
    def keep_each_share(
        # elements
        mobility: wp.array(dtype=vec3),
        inverse_mass: wp.array(dtype=dtype),
        faces: Faces,
        # state in
        x: wp.array(dtype=vec3),
        motion: motions(dtype),
        shares: wp.array(dtype=wp.vec3d),
        # parameters
        collider: int,
        per_copy: int,
        # in and out
        least: wp.array(dtype=wp.float64),
        end: wp.array(dtype=vec3),
        moved: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        share = ONE
        for k in range(faces.first[i], faces.first[i + 1]):
            f = faces.of_vertex[k]
            for j in range(3):
                if faces.vertices[f][j] == i:
                    share = wp.min(share, shares[f][j])
        if least:
            least[i] = wp.min(least[i], share)
        elif share < ONE and inverse_mass[i] > dtype(0.0):
            copy = i // per_copy
            p = to_local(motion.before[copy, collider], exact(x[i]))
            p_end = to_local(motion.after[copy, collider], exact(end[i]))
            end[i] = where_free(mobility, i, to_space(motion.after[copy, collider], p + share * (p_end - p)), end[i])
            moved[i] = ROUNDS + 1

    return keep_each_share


@cache
def end_faces(dtype):
    """Kernel over vertices: adds the change of x by the planes to ``move``; along it v becomes that of the shortened move."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"warpcloth.mesh_faces.{dtype.__name__}", enable_backward=False)
    def end_each_face(
        # state in
        x_before: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        h: dtype,
        # in and out
        v: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        moved: wp.array(dtype=wp.int32),
        notes: FilterNotes,
    ):
        i = wp.tid()
        if moved[i] == 0:
            return
        moved[i] = 0
        change = x[i] - target[i]
        size = wp.dot(change, change)
        if size > dtype(0.0):
            kick = vec3()
            if h > dtype(0.0):
                kick = wp.dot((x[i] - x_before[i]) / h - v[i], change) / size * change
            v[i] = v[i] + kick
            if move:
                move[i] = move[i] + change
            wp.atomic_add(notes.cut, i // per_copy, wp.int64(1))
            if notes.pushed.shape[0] > 0:
                notes.pushed[i] = notes.pushed[i] + wp.vec3d(change)
                notes.kicked[i] = notes.kicked[i] + wp.vec3d(kick)

    return end_each_face
