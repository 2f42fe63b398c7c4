"""Factories of the kernels of facets, the half-spaces that replace a mesh in a step.

In a step, and for each vertex, a mesh is replaced by a few half-spaces, the *facets*, which have the nearby part of the mesh
behind them. The first touches the surface at the point nearest to the predicted vertex, the next at the nearest point in front
of the first, and so on (Liu et al. 2017, *Planning dynamically feasible trajectories for quadrotors using safe flight corridors
in 3-D complex environments*). A convex mesh needs one facet, a groove two, a corner three.
"""

from functools import cache

import warp as wp

from ..terms import contact
from ..terms.contact import turned
from ..vectors import types
from .colliders import half_space, of_pose
from .mesh_geometry import geometry, meshes, motions
from .mesh_queries import near_lists, queries

turned_by = turned
FAR = 1e30  # distance to a missing facet; finite, so that differences are not NaN
FACETS = 3  # maximum number of facets of a vertex and a mesh
SLIDES = wp.constant(3)  # surfaces along which a prediction or a vertex slides
BEYOND = wp.constant(0.02)  # smallest distance of a further facet in front of the others, over r
ALIKE = wp.constant(0.9)  # cosine between the normals from which two facets count as one


@cache
def facet_type(dtype):
    """Type of a facet: a point, the normal, the weight."""
    return wp.types.vector(7, dtype)


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
        known = wp.bool(False)  # whether d, n, face and w are those of the nearest point already
        d = zero
        n = vec3()
        face = wp.int32(-1)
        w = vec3()
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
                known = wp.dot(n, n_hit) >= dtype(ALIKE)
                if d < zero or not known:
                    normals[0] = n_hit
                    gaps[0] = wp.dot(n_hit, p - foot)
                    points[0] = foot
                    count = 1
        searching = wp.bool(True)
        if row >= 0:
            searching = lists.count[row, i] > 0
        while searching and count < most:
            if not known or count > 0:
                d, n, face, w = nearest_beyond(
                    mesh, collider, when, per_frame, p, radius, dtype(BEYOND) * r, count, normals, gaps, lists, row, i
                )
            known = wp.bool(False)
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
