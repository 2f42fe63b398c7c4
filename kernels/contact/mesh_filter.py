"""Factory of the kernel of the filter of colliders that include meshes."""

from functools import cache

import warp as wp

from ..rotation import epsilon
from ..terms.contact import turned
from ..vectors import types
from .collider_filter import ROUNDS, SLIDING, FilterNotes, note_cut, note_inside, sliding, stopped_by_shape
from .colliders import gap_of, kept_part, of_pose, shapes
from .mesh_facets import SLIDES
from .mesh_geometry import geometry, meshes, motions
from .mesh_queries import near_lists, queries

turned_by = turned
CARRIES = wp.constant(16)  # how often moving triangles may carry a vertex along in a step


@cache
def filter_meshes(dtype, solids):
    """Kernel over vertices at the end of a step: :func:`.collider_filter.filter_step` for colliders that include meshes.

    A vertex that a mesh stops moves with the triangle that stopped it, and slides along it until another one stops it. Each
    part of its way is tested against all triangles, so that it crosses none.
    """
    vec3, _mat33 = types(dtype)
    to_local, to_space = of_pose(dtype)
    gap, kept_of, stopped_by = gap_of(dtype, solids), kept_part(dtype, solids), stopped_by_shape(dtype, solids)
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
                    least = motion.least + rounding
                    found, less, by, short = stopped_by(shape, c, p, way, least, motion.landing, rounds <= SLIDING)
                    hit = wp.where(short, 1, 0)
                else:
                    d, _n = gap(shape, c, p)
                    deep = -wp.max(rounding, dtype(8.0) * epsilon(motion.least) * wp.max(wp.abs(p)))
                    if d > deep and kept_of(shape, c, p, way, deep) < one:
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
                    d, _n = gap(shape, c, p + way)
                    through = d <= zero
                if through:
                    note_inside(notes, copy, c, step, vertex, per_copy, last)

    return filter_vertices
