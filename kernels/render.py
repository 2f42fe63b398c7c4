"""Ray casting: rays from a camera through each pixel, and on to the sun and the sky."""

from functools import cache

import warp as wp

# Offset of the start of a ray above a surface, as a fraction of the coordinates: some tens of roundings of float32.
OFFSET = wp.constant(wp.float32(4e-6))
FAR = wp.constant(wp.float32(1e30))
# Light of a sky ray that meets a surface, as a fraction of the light of the sky.
BOUNCE = wp.constant(wp.float32(0.3))


@wp.struct
class Geometry:
    """Triangles and tubes in coordinates of the picture; a ball is a tube of length 0."""

    mesh: wp.uint64  # 0 without triangles
    triangles: wp.array(dtype=wp.int32)
    points: wp.array(dtype=wp.vec3)
    normals: wp.array(dtype=wp.vec3)  # of the corners of triangles
    tree: wp.uint64  # bounding volume hierarchy of tubes, 0 without tubes
    ends: wp.array(dtype=wp.vec2i)
    radii: wp.array(dtype=wp.float32)
    colours: wp.array(dtype=wp.vec3)
    corner_colours: wp.array(dtype=wp.int32)  # indices, three per triangle
    end_colours: wp.array(dtype=wp.vec2i)
    shares: wp.array(dtype=wp.float32)  # share of the colour that is lit, for triangles, then tubes
    backs: wp.array(dtype=wp.vec3)  # factor of the colour on the back side of triangles


@wp.struct
class Viewer:
    """Rays of a camera: origin + t (forward + x right + y up), with pixel coordinates x, y from the centre of the picture."""

    origin: wp.vec3
    forward: wp.vec3
    right: wp.vec3
    up: wp.vec3
    width: wp.int32
    height: wp.int32
    samples: wp.array(dtype=wp.vec2)  # positions in the pixel, from 0 to 1


@wp.struct
class Light:
    """A sun, a sky and a ground."""

    up: wp.vec3
    sun: wp.vec3  # direction to the sun
    sun_rays: wp.array(dtype=wp.vec2)  # lateral offsets from the centre of the sun at distance 1
    sky_rays: wp.array(dtype=wp.vec3)  # unit vectors around +z with cosine-weighted density
    sun_share: wp.float32  # share of the light on a surface that faces the sun
    sky_share: wp.float32
    sky_tilt: wp.float32  # by which the sky is brighter above than below
    sky_distance: wp.float32  # length of rays to the sky
    has_ground: wp.int32
    ground: wp.float32  # height
    ground_colour: wp.vec3
    ground_radius: wp.float32  # beyond which the ground is invisible
    background: wp.vec3


@wp.struct
class Sight:
    """The point that a ray meets, and its appearance."""

    distance: wp.float32
    point: wp.vec3
    normal: wp.vec3  # shading normal, towards the viewer
    across: wp.vec3  # geometric normal
    colour: wp.vec3
    share: wp.float32  # share of the colour that is lit; the rest is unshaded
    size: wp.float32  # largest coordinate that the point is computed from
    is_ground: wp.bool
    clear: wp.float32  # transparency of the ground


@wp.struct
class Layers:
    """Layers of the colour of each pixel: base + sky · visible_sky + sun · visible_sun."""

    base: wp.array(dtype=wp.vec3)
    sky: wp.array(dtype=wp.vec3)
    sun: wp.array(dtype=wp.vec3)
    visible: wp.array(dtype=wp.vec2)
    # Normal and position of the surface in the pixel; the normal is 0 for no surface, or for several
    normal: wp.array(dtype=wp.vec3)
    point: wp.array(dtype=wp.vec3)


@wp.func
def meet_ball(o: wp.vec3, d: wp.vec3, r: float):
    """Distance along the unit vector d at which a line enters a ball around the origin; FAR if it misses."""
    # From the point of the line nearest to the centre, since squares of large distances would cancel (Haines et al. 2019).
    b = -wp.dot(o, d)
    q = o + b * d
    h = r * r - wp.dot(q, q)
    t = FAR
    if h >= 0.0:
        t = b - wp.sqrt(h)
    return t


@wp.func
def meet_tube(o: wp.vec3, d: wp.vec3, a: wp.vec3, b: wp.vec3, r: float):
    """(distance, parameter from a to b) where a ray enters a capsule from outside; FAR if it misses."""
    start = wp.dot(0.5 * (a + b) - o, d)
    oa = o + start * d - a
    ba = b - a
    t = meet_ball(oa, d, r)
    s = wp.float32(0.0)
    length_sq = wp.dot(ba, ba)
    if length_sq > 0.0:
        tb = meet_ball(oa - ba, d, r)
        if tb < t:
            t = tb
            s = 1.0
        # Components perpendicular to the axis
        along_d = wp.dot(ba, d) / length_sq
        along_o = wp.dot(ba, oa) / length_sq
        dx = d - along_d * ba
        ox = oa - along_o * ba
        A = wp.dot(dx, dx)
        if A > 0.0:
            at = -wp.dot(ox, dx) / A
            q = ox + at * dx
            h = r * r - wp.dot(q, q)
            if h >= 0.0:
                tc = at - wp.sqrt(h / A)
                sc = along_o + tc * along_d
                if tc < t and sc >= 0.0 and sc <= 1.0:
                    t = tc
                    s = sc
    t = t + start
    if t < 0.0 or t > 0.5 * FAR:
        t = FAR
    return t, s


@wp.func
def nearest_tube(g: Geometry, o: wp.vec3, d: wp.vec3, most: float):
    """(distance, tube, parameter along it) of the first tube within ``most``; tube −1 if none."""
    nearest = most
    tube = wp.int32(-1)
    s = wp.float32(0.0)
    if g.tree != wp.uint64(0):
        query = wp.bvh_query_ray(g.tree, o, d)
        k = wp.int32(0)
        while wp.bvh_query_next(query, k, nearest):
            r = g.radii[k]
            if r > 0.0:
                t, at = meet_tube(o, d, g.points[g.ends[k][0]], g.points[g.ends[k][1]], r)
                if t < nearest:
                    nearest = t
                    tube = k
                    s = at
    return nearest, tube, s


@wp.func
def is_hidden(g: Geometry, o: wp.vec3, d: wp.vec3, most: float):
    """Whether a ray meets a surface within the distance ``most``."""
    hidden = wp.bool(False)
    if g.mesh != wp.uint64(0):
        hidden = wp.mesh_query_ray_anyhit(g.mesh, o, d, most)
    if not hidden and g.tree != wp.uint64(0):
        query = wp.bvh_query_ray(g.tree, o, d)
        k = wp.int32(0)
        while wp.bvh_query_next(query, k, most):
            r = g.radii[k]
            if r > 0.0:
                t, _s = meet_tube(o, d, g.points[g.ends[k][0]], g.points[g.ends[k][1]], r)
                if t < most:
                    hidden = True
                    break
    return hidden


@wp.func
def beside(n: wp.vec3):
    """A unit vector perpendicular to a unit vector (Duff et al. 2017)."""
    sign = wp.where(n[2] < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + n[2])
    return wp.vec3(1.0 + sign * n[0] * n[0] * a, sign * n[0] * n[1] * a, -sign * n[0])


@wp.func
def size_of(p: wp.vec3):
    return wp.max(wp.abs(p[0]), wp.max(wp.abs(p[1]), wp.abs(p[2])))


@wp.func
def find_ground(light: Light, o: wp.vec3, d: wp.vec3):
    """(distance, opacity) of the ground where a ray from above meets it; FAR if it misses."""
    t = FAR
    share = wp.float32(0.0)
    if light.has_ground != 0:
        height = wp.dot(o, light.up) - light.ground
        fall = -wp.dot(d, light.up)
        if height > 0.0 and fall > 0.0:
            r = wp.length(o + (height / fall) * d) / light.ground_radius
            if r < 1.0:
                t = height / fall
                share = (1.0 - r * r) * (1.0 - r * r)
    return t, share


@wp.func
def see_tube(g: Geometry, o: wp.vec3, d: wp.vec3, t: float, tube: int, along: float):
    """The point where a ray meets a tube, at a parameter along it."""
    ends = g.ends[tube]
    colours = g.end_colours[tube]
    axis = (1.0 - along) * g.points[ends[0]] + along * g.points[ends[1]]
    s = Sight()
    s.distance = t
    s.size = wp.max(size_of(g.points[ends[0]]), size_of(g.points[ends[1]])) + size_of(o)
    s.normal = wp.normalize(o + t * d - axis)
    s.across = s.normal
    s.point = axis + g.radii[tube] * s.normal
    s.colour = (1.0 - along) * g.colours[colours[0]] + along * g.colours[colours[1]]
    s.share = g.shares[g.triangles.shape[0] // 3 + tube]
    return s


@wp.func
def see_triangle(g: Geometry, o: wp.vec3, d: wp.vec3, t: float, face: int, u: float, v: float):
    """The point where a ray meets a triangle, at barycentric coordinates."""
    w = 1.0 - u - v
    a = g.points[g.triangles[3 * face]]
    b = g.points[g.triangles[3 * face + 1]]
    c = g.points[g.triangles[3 * face + 2]]
    na = g.normals[3 * face]
    nb = g.normals[3 * face + 1]
    nc = g.normals[3 * face + 2]
    s = Sight()
    s.distance = t
    s.size = wp.max(size_of(a), wp.max(size_of(b), size_of(c))) + size_of(o)
    s.share = g.shares[face]
    s.colour = (
        u * g.colours[g.corner_colours[3 * face]]
        + v * g.colours[g.corner_colours[3 * face + 1]]
        + w * g.colours[g.corner_colours[3 * face + 2]]
    )
    across = wp.normalize(wp.cross(b - a, c - a))
    side = wp.float32(1.0)
    if wp.dot(across, d) > 0.0:
        side = -1.0
        s.colour = wp.cw_mul(s.colour, g.backs[face])
    s.across = side * across
    s.normal = side * wp.normalize(u * na + v * nb + w * nc)
    # Moved to the smooth surface of the normals, so that flat triangles cast no shadow on it (Hanika 2021)
    p = u * a + v * b + w * c
    s.point = p + (
        (u * wp.max(0.0, side * wp.dot(a - p, na)) * side) * na
        + (v * wp.max(0.0, side * wp.dot(b - p, nb)) * side) * nb
        + (w * wp.max(0.0, side * wp.dot(c - p, nc)) * side) * nc
    )
    return s


@wp.func
def see(g: Geometry, light: Light, o: wp.vec3, d: wp.vec3):
    """The first point that a ray meets, or distance FAR."""
    t, share = find_ground(light, o, d)
    face = wp.int32(-1)
    u = wp.float32(0.0)
    v = wp.float32(0.0)
    if g.mesh != wp.uint64(0):
        query = wp.mesh_query_ray(g.mesh, o, d, t)
        if query.result:
            t = query.t
            face = query.face
            u = query.u
            v = query.v
    t, tube, along = nearest_tube(g, o, d, t)
    s = Sight()
    if tube >= 0:
        s = see_tube(g, o, d, t, tube, along)
    elif face >= 0:
        s = see_triangle(g, o, d, t, face, u, v)
    else:
        s.distance = t
        s.point = o + t * d
        s.size = size_of(s.point) + size_of(o)
        s.normal = light.up
        s.across = light.up
        s.colour = light.ground_colour
        s.is_ground = True
        s.clear = 1.0 - share
    return s


@wp.func
def light_at(
    g: Geometry, light: Light, p: wp.vec3, n: wp.vec3, across: wp.vec3, offset: float, sun_sample: int, sky_sample: int
):
    """(light of the sky, of the sun, visibilities) at a point with shading normal n and geometric normal ``across``."""
    sky = light.sky_share * (1.0 + light.sky_tilt * (wp.dot(n, light.up) - 1.0))
    facing = wp.dot(n, light.sun)
    sun = wp.float32(0.0)
    start = p + offset * across
    seen_sun = wp.float32(0.0)
    if facing > 0.0:
        sun = light.sun_share * facing
        ray = light.sun_rays[sun_sample]
        x = beside(light.sun)
        d = wp.normalize(light.sun + ray[0] * x + ray[1] * wp.cross(light.sun, x))
        if not is_hidden(g, start, d, FAR):
            seen_sun = 1.0
    around = light.sky_rays[sky_sample]
    x = beside(n)
    d = around[0] * x + around[1] * wp.cross(n, x) + around[2] * n
    below = wp.dot(d, across)
    if below < 0.0:
        d -= 2.0 * below * across
    seen_sky = wp.float32(1.0)
    if is_hidden(g, start, d, light.sky_distance):
        seen_sky = 0.0
    return sky, sun, seen_sky, seen_sun


@cache
def trace():
    """Kernel over pixels from ``first`` on: layers, means over samples."""

    @wp.kernel(module="unique", enable_backward=False)
    def trace_pixel(
        # elements
        g: Geometry,
        # parameters
        viewer: Viewer,
        light: Light,
        first: int,
        # out
        out: Layers,
    ):
        pixel = first + wp.tid()
        column = pixel % viewer.width
        row = pixel // viewer.width
        base = wp.vec3()
        sky = wp.vec3()
        sun = wp.vec3()
        # Sums of the brightness of the layers, over all samples and over those that see the light
        lit = wp.vec2()
        visible = wp.vec2()
        normal = wp.vec3()
        point = wp.vec3()
        hits = wp.int32(0)
        mixed = wp.bool(False)
        # The pixels of a 4×4 square share one sample sequence; 4×4 such squares share a longer one.
        count = viewer.samples.shape[0]
        in_square = ((7 * (column % 4 + 4 * (row % 4))) % 16) * count
        square = ((7 * ((column // 4) % 4 + 4 * ((row // 4) % 4))) % 16) * 16 * count
        for sample in range(count):
            x = float(column) + viewer.samples[sample][0] - 0.5 * float(viewer.width)
            y = 0.5 * float(viewer.height) - float(row) - viewer.samples[sample][1]
            o = viewer.origin
            d = wp.normalize(viewer.forward + x * viewer.right + y * viewer.up)
            s = see(g, light, o, d)
            if s.distance == FAR:
                base += light.background
                continue
            offset = OFFSET * s.size
            sky_here, sun_here, seen_sky, seen_sun = light_at(
                g, light, s.point, s.normal, s.across, offset, in_square + sample, square + in_square + sample
            )
            if s.is_ground:  # the colour of the ground is that in full light
                s.share = (1.0 - s.clear) / (sky_here + sun_here)
                base += s.clear * light.background
            else:
                base += (1.0 - s.share) * s.colour
            brightness = wp.vec2(sky_here, sun_here) * (s.share * (s.colour[0] + s.colour[1] + s.colour[2]))
            lit += brightness
            visible += wp.cw_mul(brightness, wp.vec2(seen_sky, seen_sun))
            base += (BOUNCE * s.share * sky_here) * s.colour
            sky += ((1.0 - BOUNCE) * s.share * sky_here) * s.colour
            sun += (s.share * sun_here) * s.colour
            if hits == 0:
                normal = s.normal
                point = s.point
            elif wp.dot(s.normal, normal) < 0.5 or wp.abs(wp.dot(normal, s.point - point)) > 4.0 * s.distance * wp.length(
                viewer.up
            ):
                mixed = True
            hits += 1
        per_sample = 1.0 / float(count)
        out.base[pixel] = per_sample * base
        out.sky[pixel] = per_sample * sky
        out.sun[pixel] = per_sample * sun
        # −1 if no light could arrive: the visibility is then undefined.
        out.visible[pixel] = wp.vec2(
            wp.where(lit[0] > 0.0, visible[0] / lit[0], -1.0), wp.where(lit[1] > 0.0, visible[1] / lit[1], -1.0)
        )
        out.normal[pixel] = wp.where(mixed, wp.vec3(), normal)
        out.point[pixel] = point

    return trace_pixel
