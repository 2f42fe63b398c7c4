"""Factories of the kernels that anchor friction where a step begins: on convex colliders, and on meshes."""

from functools import cache

import warp as wp

from ..coulomb import Law
from ..terms import contact
from ..terms.contact import turned
from ..vectors import types
from .colliders import gap_of, of_pose, pose_types, shapes, step_poses
from .mesh_facets import BEYOND
from .mesh_geometry import geometry, meshes, motions
from .mesh_queries import near_lists, queries

turned_by = turned


@cache
def slip_of(dtype, law: Law):
    """Device function (anchor, X, n) → the way from an anchor to X along the surface, less what it follows; 0 without ε."""
    vec3, _ = types(dtype)
    _pose, anchor_type = pose_types(dtype)
    kept = law.kept

    @wp.func
    def slip(held: anchor_type, X: vec3, n: vec3):
        found = vec3()
        if held[3] > dtype(0.0):
            u = X - vec3(held[0], held[1], held[2])
            u = u - wp.dot(n, u) * n
            found = kept(wp.length(u), held[3]) * u
        return found

    return slip


@cache
def anchor_vertices(dtype, solids, law: Law, bounded: bool):
    """Kernel over friction elements of one collider at the start of a step: anchors, and the rest states of the step.

    N = −kAφ′(d) at the state, or kA(r − d) if ``bounded``; ε = μN/(kA) by Coulomb's law. The anchor of a vertex that comes into
    contact is its position. If a vertex slid, that is, ‖u‖ is above the ε of the last step, its anchor follows to a distance of
    that ε. Anchors are stored in the frame of the collider, with ε, which is 0 without contact.
    """
    vec3, _ = types(dtype)
    _pose, anchor_type = pose_types(dtype)
    to_local, to_space = of_pose(dtype)
    rest_type, gap, slip = wp.types.vector(8, dtype), gap_of(dtype, solids), slip_of(dtype, law)
    slope, limit = contact.bounded_slope if bounded else contact.slope, law.limit

    @wp.kernel(module="unique", enable_backward=False)
    def anchor(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        shape: shapes(dtype),
        # state in
        x: wp.array(dtype=vec3),
        poses: step_poses(dtype),
        # parameters
        collider: int,
        per_copy: int,
        distance: dtype,
        friction: dtype,
        # in and out
        anchors: wp.array(dtype=anchor_type),
        rest: wp.array(dtype=rest_type),
    ):
        e = wp.tid()
        i = stencil[e, 0]
        copy = e // per_copy
        pose = poses.before[copy, collider]
        X = to_local(pose, x[i])
        d, n = gap(shape, collider, X)
        depth = -slope(d, distance)
        if depth > dtype(0.0):
            a = X - slip(anchors[i], X, n)
            now = poses.at[copy, collider]
            target = to_space(now, a)
            normal = turned_by(vec3(now[3], now[4], now[5]), now[6], n)
            r = rest_type()
            for k in range(3):
                r[k] = target[k]
                r[3 + k] = normal[k]
            r[6] = limit(depth, friction)
            r[7] = rest[e][7]
            rest[e] = r
            anchors[i] = anchor_type(a[0], a[1], a[2], r[6])
        elif rest[e][6] != dtype(0.0) or anchors[i][3] != dtype(0.0):
            rest[e][6] = dtype(0.0)
            anchors[i] = anchor_type()

    return anchor


@cache
def anchor_on_mesh(dtype, law: Law, bounded: bool):
    """Kernel over friction elements of one mesh at the start of a step, see :func:`anchor_vertices`.

    N and n are the length and the direction of the sum over the facets at the vertex. Anchors are on the surface, and move with
    the triangle nearest to the vertex.
    """
    vec3, mat33 = types(dtype)
    _pose, anchor_type = pose_types(dtype)
    to_local, to_space = of_pose(dtype)
    corners, _from, _carry = geometry(dtype)
    nearest_beyond, _sweep, has_list, is_alone, _listed = queries(dtype)
    rest_type, slip, zero = wp.types.vector(8, dtype), slip_of(dtype, law), dtype(0.0)
    slope, limit = contact.bounded_slope if bounded else contact.slope, law.limit

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
            force = -slope(gaps[j], distance)
            depth += force / share
            push += force / share * normals[j]
        r = rest[e]
        kept = vec3()
        r[6] = zero
        if depth > zero:
            r[6] = limit(depth, friction)
            n = wp.normalize(push)
            a = p - wp.dot(normals[0], gaps[0] * n) * n
            a = a - slip(anchors[i], p, n)
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
        rest[e] = r
        anchors[i] = anchor_type(kept[0], kept[1], kept[2], r[6])

    return anchor
