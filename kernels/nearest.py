"""Kernels over points: their distance to a surface of triangles, or to a solid."""

from functools import cache

import warp as wp

from .terms.contact import gap_to

# A triangle is flat if its normal, over the square of its longest side, is shorter: its direction is then rounding error.
FLAT = wp.constant(wp.float64(1e-12))
FAR = wp.constant(wp.float32(4.0))  # above the diagonal of [−1, 1]³


@wp.func
def from_segment(a: wp.vec3d, b: wp.vec3d):
    """Squared distance of the origin to the segment from a to b, which may be a point."""
    d = b - a
    length_sq, t = wp.length_sq(d), wp.float64(0.0)
    if length_sq > wp.float64(0.0):
        t = wp.clamp(-wp.dot(a, d) / length_sq, wp.float64(0.0), wp.float64(1.0))
    return wp.length_sq(a + t * d)


@wp.func
def from_triangle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Squared distance of the origin to a triangle, which may be flat."""
    nearest = wp.min(from_segment(a, b), wp.min(from_segment(b, c), from_segment(c, a)))
    n = wp.cross(b - a, c - a)
    longest_sq = wp.max(wp.length_sq(b - a), wp.max(wp.length_sq(c - b), wp.length_sq(a - c)))
    if wp.length(n) > FLAT * longest_sq:
        above = wp.min(wp.dot(wp.cross(b, c), n), wp.min(wp.dot(wp.cross(c, a), n), wp.dot(wp.cross(a, b), n)))
        if above >= wp.float64(0.0):
            height = wp.dot(a, wp.normalize(n))
            nearest = wp.min(nearest, height * height)
    return nearest


@cache
def distances():
    """Kernel over points: out[i] = distance of points[i] to the triangles of ``mesh``, faces[i] = the nearest.

    Distances are in float64, coordinates in [−1, 1]³. Queries can miss nearly flat triangles, so those in ``flat`` are tested
    one by one.
    """

    @wp.kernel(module="unique", enable_backward=False)
    def measure(
        # elements
        mesh: wp.uint64,
        triangles: wp.array(dtype=wp.vec3i),
        flat: wp.array(dtype=wp.int32),
        # state in
        x: wp.array(dtype=wp.vec3d),
        points: wp.array(dtype=wp.vec3d),
        # out
        out: wp.array(dtype=wp.float64),
        faces: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        p = points[i]
        nearest = wp.float64(wp.inf)
        face = wp.int32(0)
        query = wp.mesh_query_point_no_sign(mesh, wp.vec3(p), FAR)
        if query.result:
            v = triangles[query.face]
            nearest = from_triangle(x[v[0]] - p, x[v[1]] - p, x[v[2]] - p)
            face = wp.int32(query.face)
        for k in range(flat.shape[0]):
            v = triangles[flat[k]]
            distance = from_triangle(x[v[0]] - p, x[v[1]] - p, x[v[2]] - p)
            if distance < nearest:
                nearest = distance
                face = flat[k]
        out[i] = wp.sqrt(nearest)
        faces[i] = face

    return measure


@cache
def faces():
    """Kernel over points: out[i] = the triangle of ``mesh`` nearest to points[i], with coordinates in [−1, 1]³."""

    @wp.kernel(module="unique", enable_backward=False)
    def find(
        # elements
        mesh: wp.uint64,
        # state in
        points: wp.array(dtype=wp.vec3),
        # out
        out: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        query = wp.mesh_query_point_no_sign(mesh, points[i], FAR)
        if query.result:
            out[i] = query.face

    return find


@cache
def find_distances(solid):
    """Kernel over points in the frame of a shape: their signed distances [m]."""
    gap = gap_to(solid)

    @wp.kernel(module="unique", enable_backward=False)
    def find(
        # state in
        points: wp.array(dtype=wp.vec3d),
        # parameters
        half: wp.vec3d,
        radius: wp.float64,
        # out
        out: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        d, _n = gap(points[i], half, radius)
        out[i] = d

    return find
