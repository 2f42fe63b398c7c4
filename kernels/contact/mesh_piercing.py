"""Factories of the kernels that find triangles of the cloth through which a corner or an edge of a mesh has passed.

Vertices of the cloth stay outside a mesh, but their triangles cut into it, as smooth cloth between the vertices would not: into
a ball by the sagitta, into what is sharper by up to half of an edge, if that cloth bends in a half circle. None of that has
passed through. Two things have. L is the longest edge of the triangle, and the prism is all that is above or below it.

- A mesh *stands* in the triangle if in the prism it goes on, from its section with the triangle, by more than L/2 to both
  sides. A mesh that carries the vertices does not: at an angle of 90° or more, both together are at most the circumradius.
  But along a side of the triangle a mesh may be high that this side only cuts, as where a fold stands on it. There the
  section is as wide as its part of the side, and at most half as deep (Thales). So it counts only if it is deeper, or if the
  mesh stands in the triangle beyond too, and the two are folded by less than 90°.
- A corner of the mesh, or the point of an edge that is nearest to the middle of the triangle, *went* through this, since it
  last had no section with the mesh, and none that a side only cuts has come since. The point must be farther than L/2, or than
  L if there is a section: the corner of a box is up to 0.82 L from a triangle with a vertex on each of its faces.

A triangle that had no section is tested again when it has moved by L/2, because until then neither can be.
"""

from functools import cache

import warp as wp

from ..terms.contact import turned
from ..vectors import types
from .colliders import of_pose, pose_types
from .mesh_geometry import geometry, meshes

turned_by = turned
FIRST = wp.constant(wp.int64(2**62))


@wp.struct
class ClothTriangles:
    """The vertices of triangles of all copies, the three triangles beside each or −1, and their numbers in the mesh."""

    vertices: wp.array(dtype=wp.vec3i)
    beside: wp.array(dtype=wp.vec3i)
    numbers: wp.array(dtype=wp.int64)


@cache
def clear_triangles(dtype):
    """Struct of triangles when they last had no section with a mesh: the ``corners`` of each in its frame, and ``when``.

    That is at the end of the frame ``when``, before the mesh went through; −1 if a side has cut into it since.
    ``cut`` is whether the triangle has had a section since.
    """
    _vec3, mat33 = types(dtype)

    @wp.struct
    class ClearTriangles:
        corners: wp.array(dtype=mat33)
        when: wp.array(dtype=wp.int32)
        cut: wp.array(dtype=wp.int32)

    return ClearTriangles


@cache
def prisms(dtype):
    """Device functions on the prism of a triangle p, with the normal n and the inward normals m of its sides, as rows."""
    vec3, mat33 = types(dtype)
    zero, one = dtype(0.0), dtype(1.0)

    @wp.func
    def normal_of(p: mat33):
        return wp.normalize(wp.cross(p[1] - p[0], p[2] - p[0]))

    @wp.func
    def section(h: vec3, q: mat33):
        """The segment of a triangle q, with the heights h of its corners, at the height 0, which is between them."""
        a = vec3()
        b = vec3()
        for i in range(3):
            j = (i + 1) % 3
            if (h[i] <= zero) != (h[j] <= zero):
                b = a
                a = q[i] + h[i] / (h[i] - h[j]) * (q[j] - q[i])
        return a, b

    @wp.func
    def heights_of(n: vec3, p: mat33, q: mat33):
        """The heights of three points above the plane of the triangle."""
        return vec3(wp.dot(n, q[0] - p[0]), wp.dot(n, q[1] - p[0]), wp.dot(n, q[2] - p[0]))

    @wp.func
    def sides(p: mat33):
        m = mat33()
        for k in range(3):
            m[k] = wp.cross(normal_of(p), wp.normalize(p[(k + 1) % 3] - p[k]))
        return m

    @wp.func
    def is_over(p: mat33, y: vec3, beside: dtype):
        """Whether a point is in the prism, or beside it by less than this."""
        m = sides(p)
        least = wp.min(wp.min(wp.dot(m[0], y - p[0]), wp.dot(m[1], y - p[1])), wp.dot(m[2], y - p[2]))
        return least >= -beside

    @wp.func
    def passed(was: mat33, p: mat33, before: dtype, after: dtype, y_was: vec3, y: vec3, beside: dtype, r: dtype):
        """How far a point is above the triangle or below, if it went through on a straight way, else 0.

        Its heights were and are ``before`` and ``after``. It is over the triangle, as it was when it went through, by ``r``
        from the sides, as contact is no finer. Before, it was over the triangle or, if it is now farther than ``beside``,
        beside it by less than that. A way is not straight along the triangle rather than towards it.
        """
        way = y - y_was - (p[0] - was[0] + p[1] - was[1] + p[2] - was[2]) / dtype(3.0)
        if before * after >= zero or dtype(2.0) * (after - before) * (after - before) < wp.dot(way, way):
            return zero
        s = before / (before - after)
        edge = wp.where(wp.abs(after) > beside, beside, zero)
        if is_over(was, y_was, edge) and is_over(p, y, -r) and is_over(was + s * (p - was), y_was + s * (y - y_was), -r):
            return wp.abs(after)
        return zero

    @wp.func
    def within(m: mat33, p: mat33, a: vec3, b: vec3):
        """The part of the segment from a to b in the prism: the parameters of its ends, and the sides of these or −1."""
        first = zero
        last = one
        side = wp.int32(-1)
        other = wp.int32(-1)
        for k in range(3):
            s = wp.dot(m[k], a - p[k])
            e = wp.dot(m[k], b - p[k])
            if s < zero and e < zero:
                first = dtype(2.0)
            elif s < zero:
                if s / (s - e) > first:
                    first = s / (s - e)
                    side = k
            elif e < zero:
                if s / (s - e) < last:
                    last = s / (s - e)
                    other = k
        return first, last, side, other

    @wp.func
    def heights(n: vec3, m: mat33, p: mat33, q: mat33):
        """The smallest and the largest height above the triangle of what is in the prism of another one, q."""
        low = dtype(wp.inf)
        high = -low
        normal = wp.cross(q[1] - q[0], q[2] - q[0])
        slope = wp.dot(normal, n)
        for k in range(3):
            a = q[k]
            b = q[(k + 1) % 3]
            first, last, _side, _other = within(m, p, a, b)
            if first <= last:
                h = wp.dot(n, a - p[0])
                rise = wp.dot(n, b - a)
                low = wp.min(low, h + wp.min(first * rise, last * rise))
                high = wp.max(high, h + wp.max(first * rise, last * rise))
            h = wp.dot(normal, q[0] - p[k])
            if slope != zero:  # the line through the corner p[k] along n
                y = p[k] + h / slope * n
                inside = wp.bool(True)
                for j in range(3):
                    if wp.dot(wp.cross(q[(j + 1) % 3] - q[j], y - q[j]), normal) < zero:
                        inside = wp.bool(False)
                if inside:
                    low = wp.min(low, h / slope)
                    high = wp.max(high, h / slope)
        return low, high

    return normal_of, section, heights_of, sides, within, passed, heights


@cache
def find_pierced(dtype):
    """Kernel over triangles of the cloth at the end of a frame: whether one mesh stands in each, or went through it.

    ``found`` becomes 0 or 1, and 2, 4 and 8 more for sides with which the triangle may only have cut into the mesh, unless the
    mesh stands in the triangle beyond too; then ``some`` is 1. In a frame the mesh
    deforms by ``drift`` [m].
    """
    vec3, mat33 = types(dtype)
    pose_type, _anchor = pose_types(dtype)
    to_local, _to_space = of_pose(dtype)
    corners, _from, _carry = geometry(dtype)
    normal_of, section, heights_of, sides, within, passed, heights = prisms(dtype)
    zero, half, far = dtype(0.0), dtype(0.5), dtype(wp.inf)

    @wp.func
    def is_point(t: mat33):
        """Whether a triangle is a point, as of a mesh that is absent."""
        return t[0] == t[1] and t[1] == t[2]

    @wp.func
    def low_of(t: mat33):
        return wp.vec3(wp.min(wp.min(t[0], t[1]), t[2]))

    @wp.func
    def high_of(t: mat33):
        return wp.vec3(wp.max(wp.max(t[0], t[1]), t[2]))

    @wp.kernel(module="unique", enable_backward=False)
    def find(
        # elements
        faces: ClothTriangles,
        mesh: meshes(dtype),
        keyframes: wp.array(dtype=pose_type),
        firsts: wp.array(dtype=wp.int32),
        # state in
        x: wp.array(dtype=vec3),
        frame: wp.array(dtype=wp.int32),
        # parameters
        collider: int,
        r: dtype,
        drift: dtype,
        # in and out
        clear: clear_triangles(dtype),
        some: wp.array(dtype=wp.int32),
        # out
        found: wp.array(dtype=wp.int32),
    ):
        f = wp.tid()
        found[f] = 0
        now = 2 * frame[0]
        pose = keyframes[wp.min(firsts[collider] + frame[0], firsts[collider + 1] - 1)]
        p = mat33()
        for i in range(3):
            p[i] = to_local(pose, x[faces.vertices[f][i]])
        longest = zero
        for i in range(3):
            longest = wp.max(longest, wp.length(p[(i + 1) % 3] - p[i]))
        was = clear.corners[f]
        before = clear.when[f]
        moved = drift * dtype(frame[0] - before)
        for i in range(3):
            moved = wp.max(moved, wp.length(p[i] - was[i]) + drift * dtype(frame[0] - before))
        if before >= 0 and clear.cut[f] == 0 and moved <= half * longest:
            return
        n = normal_of(p)
        m = sides(p)
        margin = wp.vec3(mesh.margin[collider])
        low = low_of(p) - margin
        high = high_of(p) + margin
        # What went through met the triangle on its way, which else was not straight.
        n_was = normal_of(was)
        rise = wp.max(wp.abs(heights_of(n, p, was))) + drift
        swept = before >= 0 and rise > r and wp.dot(n_was, n) > half
        first_low = low
        first_high = high
        if swept:
            edge = margin + wp.vec3(wp.float32(drift))
            first_low = wp.min(low, low_of(was)) - edge
            first_high = wp.max(high, high_of(was)) + edge
        # What the mesh has in the prism, beginning at its section with the triangle.
        below = far
        above = -far
        # Of each side, the segment that the section has there, and how far it extends from there.
        begin = vec3(far, far, far)
        end = -begin
        depth = vec3()
        deepest = zero
        k = wp.int32(0)
        query = wp.bvh_query_aabb(mesh.bvh[collider], first_low, first_high)
        while wp.bvh_query_next(query, k):
            q = corners(mesh, collider, k, now, 2)
            h = heights_of(n, p, q)
            if swept and wp.max(wp.abs(h)) > r:
                q_was = q
                if mesh.frames[collider] > 1:
                    q_was = corners(mesh, collider, k, 2 * before, 2)
                h_was = heights_of(n_was, was, q_was)
                if wp.min(wp.cw_mul(h, h_was)) < zero and not (is_point(q) or is_point(q_was)):
                    for i in range(3):
                        # The corner, and the point of the edge that is nearest to the middle of the triangle.
                        j = (i + 1) % 3
                        e = q[j] - q[i]
                        t = wp.clamp(wp.dot((p[0] + p[1] + p[2]) / dtype(3.0) - q[i], e) / wp.dot(e, e), zero, dtype(1.0))
                        deepest = wp.max(deepest, passed(was, p, h_was[i], h[i], q_was[i], q[i], half * longest, r))
                        y_was = q_was[i] + t * (q_was[j] - q_was[i])
                        height = h[i] + t * (h[j] - h[i])
                        height_was = h_was[i] + t * (h_was[j] - h_was[i])
                        deepest = wp.max(deepest, passed(was, p, height_was, height, y_was, q[i] + t * e, half * longest, r))
            if wp.min(h) > zero or wp.max(h) <= zero:
                continue
            a, b = section(h, q)
            first, last, side, other = within(m, p, a, b)
            if first > last:
                continue
            lower, upper = heights(n, m, p, q)
            below = wp.min(below, lower)
            above = wp.max(above, upper)
            for i in range(2):
                y = a + wp.where(i == 0, first, last) * (b - a)
                on = wp.where(i == 0, side, other)
                for j in range(3):
                    depth[j] = wp.max(depth[j], wp.dot(m[j], y - p[j]))
                if on >= 0:
                    along = wp.dot(wp.normalize(p[(on + 1) % 3] - p[on]), y - p[on])
                    begin[on] = wp.min(begin[on], along)
                    end[on] = wp.max(end[on], along)
        cut = below <= above
        by_side = wp.int32(0)  # 2, 4 and 8 for sides
        for j in range(3):
            if begin[j] <= end[j] and depth[j] <= end[j] - begin[j]:
                by_side += 2 << j
                before = -1
                deepest = zero
        needed = wp.max(r, half * longest)
        clear.when[f] = before
        clear.cut[f] = wp.where(cut, 1, clear.cut[f])
        if not cut and deepest <= r:
            clear.when[f] = frame[0]
            clear.corners[f] = p
            clear.cut[f] = 0
        if deepest > wp.where(cut, wp.max(r, longest), needed):
            found[f] = 1
            return
        if not cut:
            return
        beyond = wp.abs(wp.vec3(needed * n))
        # Most meshes do not go on that far at all.
        lowest = zero
        highest = zero
        query = wp.bvh_query_aabb(mesh.bvh[collider], low - beyond, high + beyond)
        while wp.bvh_query_next(query, k) and (lowest >= -needed or highest <= needed):
            h = heights_of(n, p, corners(mesh, collider, k, now, 2))
            lowest = wp.min(lowest, wp.min(h))
            highest = wp.max(highest, wp.max(h))
        if lowest >= -needed or highest <= needed:
            return
        grows = wp.bool(True)
        while grows and (below >= -needed or above <= needed):
            grows = wp.bool(False)
            query = wp.bvh_query_aabb(mesh.bvh[collider], low - beyond, high + beyond)
            while wp.bvh_query_next(query, k):
                lower, upper = heights(n, m, p, corners(mesh, collider, k, now, 2))
                if lower <= above and upper >= below and (lower < below or upper > above):
                    below = wp.min(below, lower)
                    above = wp.max(above, upper)
                    grows = wp.bool(True)
        if below < -needed and above > needed:
            found[f] = 1 + by_side
            if by_side > 0:
                some[0] = 1

    return find


@cache
def drop_cuts(dtype):
    """Kernel over triangles of the cloth: drops those that may only have cut into the mesh, ``some`` = 1 if there are any."""
    vec3, _ = types(dtype)

    @wp.func
    def normal(faces: ClothTriangles, x: wp.array(dtype=vec3), f: int):
        v = faces.vertices[f]
        return wp.cross(x[v[1]] - x[v[0]], x[v[2]] - x[v[0]])

    @wp.kernel(module="unique", enable_backward=False)
    def drop(
        # elements
        faces: ClothTriangles,
        # state in
        x: wp.array(dtype=vec3),
        # in and out
        found: wp.array(dtype=wp.int32),
        some: wp.array(dtype=wp.int32),
    ):
        f = wp.tid()
        if found[f] < 2:
            return
        for j in range(3):
            if found[f] & (2 << j):
                other = faces.beside[f][j]
                alone = wp.bool(True)
                if other >= 0:
                    alone = found[other] == 0 or wp.dot(normal(faces, x, f), normal(faces, x, other)) <= dtype(0.0)
                if alone:
                    found[f] = 0
                    some[0] = 1
                    return

    return drop


@wp.kernel(module="warpcloth.mesh_piercing", enable_backward=False)
def note_pierced(
    # elements
    faces: ClothTriangles,
    # state in
    frame: wp.array(dtype=wp.int32),
    found: wp.array(dtype=wp.int32),
    # parameters
    collider: int,
    per_copy: int,
    triangles: wp.int64,
    # in and out
    notes: wp.array2d(dtype=wp.int64),
):
    """Kernel over triangles of the cloth: notes the first one, in time and then by index, that one mesh has pierced.

    Its note is FIRST − (frame·T + triangle), with T triangles a copy, (copies, colliders); 0 if there is none.
    """
    f = wp.tid()
    if found[f] != 0:
        note = FIRST - (wp.int64(frame[0]) * triangles + faces.numbers[f])
        wp.atomic_max(notes, faces.vertices[f][0] // per_copy, collider, note)
