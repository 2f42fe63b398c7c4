"""Factories of the kernels of colliders: their motion, the start of a step, and the filter at its end.

A pose is a position and a quaternion (x, y, z, w), seven numbers. A step needs the poses at its start, at its end, and at the
time of its forces, see :func:`move_colliders`.
"""

from functools import cache
from typing import Any

import warp as wp

from ..rotation import epsilon
from ..terms import contact
from ..terms.contact import local_gap, turned
from ..vectors import types

local_gap_of, turned_by, slope_of, DELTA, beyond_of = local_gap, turned, contact.slope, contact.DELTA, contact.beyond
ROUNDS = wp.constant(6)  # maximum number of tests of a vertex that colliders stop
SLIDING = wp.constant(2)  # in so many of these it slides; then its move is only shortened, which terminates
MARCHES = wp.constant(32)  # maximum number of separating planes of a move past a collider


@cache
def pose_types(dtype):
    """Types of a pose, and of an anchor with its ε."""
    return wp.types.vector(7, dtype), wp.types.vector(4, dtype)


@cache
def shapes(dtype):
    """Struct of the shapes of C colliders, see :mod:`..terms.contact`: half sizes of the core, radius, and friction μ."""
    vec3, _ = types(dtype)

    @wp.struct
    class Shapes:
        core: wp.array(dtype=vec3)
        radius: wp.array(dtype=dtype)
        friction: wp.array(dtype=dtype)

    return Shapes


@cache
def step_poses(dtype):
    """Struct of the poses (copies, colliders) at the start, at the end, and ``at`` the time of the forces of a step."""
    pose_type, _anchor = pose_types(dtype)

    @wp.struct
    class StepPoses:
        before: wp.array2d(dtype=pose_type)
        at: wp.array2d(dtype=pose_type)
        after: wp.array2d(dtype=pose_type)

    return StepPoses


@cache
def of_pose(dtype):
    """Device functions (pose, x) → x in the frame of a pose, and (pose, X) → X in space."""
    vec3, _ = types(dtype)
    pose_type, _anchor = pose_types(dtype)

    @wp.func
    def to_local(pose: pose_type, x: vec3):
        return turned_by(-vec3(pose[3], pose[4], pose[5]), pose[6], x - vec3(pose[0], pose[1], pose[2]))

    @wp.func
    def to_space(pose: pose_type, X: vec3):
        return turned_by(vec3(pose[3], pose[4], pose[5]), pose[6], X) + vec3(pose[0], pose[1], pose[2])

    return to_local, to_space


@cache
def surely_apart(dtype):
    """Device function (pose, core, radius, margin, x) → whether a collider is surely farther than ``margin`` from x."""
    vec3, _ = types(dtype)
    pose_type, _anchor = pose_types(dtype)

    @wp.func
    def surely(pose: pose_type, core: vec3, radius: dtype, margin: dtype, x: vec3):
        return beyond_of(x, vec3(pose[0], pose[1], pose[2]), vec3(pose[3], pose[4], pose[5]), pose[6], core, radius, margin)

    return surely


@cache
def half_space(dtype):
    """Device function (point, normal) → the pose of the half-space behind the plane with this point and normal."""
    vec3, _ = types(dtype)
    pose_type, _anchor = pose_types(dtype)

    @wp.func
    def pose_of(point: vec3, normal: vec3):
        turn = vec3(normal[2], dtype(0.0), -normal[0])
        w = dtype(1.0) + normal[1]
        size = wp.sqrt(wp.dot(turn, turn) + w * w)
        if w <= dtype(0.0) or size == dtype(0.0):
            turn = vec3(dtype(1.0), dtype(0.0), dtype(0.0))
            w = dtype(0.0)
            size = dtype(1.0)
        turn /= size
        return pose_type(point[0], point[1], point[2], turn[0], turn[1], turn[2], w / size)

    return pose_of


@cache
def move_colliders(dtype):
    """Kernel over (copies, colliders): the :func:`step_poses` of a step, with ``at`` after ``halves`` half steps.

    Between keyframes, velocities and angular velocities are constant. After the last keyframe colliders are at rest.
    """
    pose_type, _anchor = pose_types(dtype)
    quat_type = wp.types.quaternion(dtype=dtype)

    @wp.func
    def pose_at(keyframes: wp.array(dtype=pose_type), first: int, count: int, halves: int, per_frame: int):
        frame = wp.max(wp.min(halves // per_frame, count - 1), 0)
        found = keyframes[first + frame]
        if frame + 1 < count and halves > 0:
            after = keyframes[first + frame + 1]
            part = dtype(halves - frame * per_frame) / dtype(per_frame)
            q = wp.quat_slerp(
                quat_type(found[3], found[4], found[5], found[6]), quat_type(after[3], after[4], after[5], after[6]), part
            )
            for k in range(3):
                found[k] = (dtype(1.0) - part) * found[k] + part * after[k]
            for k in range(4):
                found[3 + k] = q[k]
        return found

    @wp.kernel(module="unique", enable_backward=False)
    def move(
        # elements
        keyframes: wp.array(dtype=pose_type),
        firsts: wp.array(dtype=wp.int32),
        # state in
        step: wp.array(dtype=wp.int32),
        # parameters
        steps_per_frame: int,
        halves: int,
        # out
        poses: step_poses(dtype),
    ):
        copy, c = wp.tid()
        first = firsts[c]
        count = firsts[c + 1] - first
        now = 2 * step[copy]
        poses.before[copy, c] = pose_at(keyframes, first, count, now, 2 * steps_per_frame)
        poses.at[copy, c] = pose_at(keyframes, first, count, now + halves, 2 * steps_per_frame)
        poses.after[copy, c] = pose_at(keyframes, first, count, now + 2, 2 * steps_per_frame)

    return move


@cache
def kept_part(dtype):
    """Device function (X, move, core, radius, least) → the fraction of a move from X that is kept, in the collider's frame.

    Colliders are convex, so the plane through the nearest point, normal to the distance, has the whole collider behind it. The
    move is kept until it is nearer to that plane than ``least``, or than its start if that is nearer. From there the next plane
    decides.
    """
    vec3, _ = types(dtype)

    @wp.func
    def kept(X: vec3, move: vec3, core: vec3, radius: dtype, least: dtype):
        d, n = local_gap_of(X, core, radius)
        t = dtype(0.0)
        if d > wp.length(move) + least:
            t = dtype(1.0)
        lowest = wp.min(least, d)
        k = wp.int32(0)
        while t < dtype(1.0) and k < MARCHES:
            k += 1
            approach = -wp.dot(move, n)
            further = d - lowest
            if approach * (dtype(1.0) - t) <= further:
                t = dtype(1.0)
            elif further > dtype(0.01) * least:
                t += further / approach
                d, n = local_gap_of(X + t * move, core, radius)
            else:
                k = MARCHES
        return t

    return kept


@cache
def pose_collider(dtype):
    """Kernel over contact elements of one collider at the start of a step: rest states with its pose, or with a half-space.

    If the prediction x + h v + h² g of a vertex crosses the collider, it has contact with the half-space behind the tangent
    plane where it meets the collider, for beyond a thin collider no force would lead it back. With h = 0, as in explicit steps,
    there is no prediction. Other rest states are written only if they change.
    """
    vec3, _ = types(dtype)
    to_local, to_space = of_pose(dtype)
    kept, behind, rest_type = kept_part(dtype), half_space(dtype), wp.types.vector(contact.PARAMETERS, dtype)
    surely_out = surely_apart(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def set_pose(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        shape: shapes(dtype),
        gravity: wp.array(dtype=vec3),
        per_gravity: int,
        # state in
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        poses: step_poses(dtype),
        # parameters
        collider: int,
        per_copy: int,
        least: dtype,
        h: dtype,
        # in and out
        rest: wp.array(dtype=rest_type),
    ):
        e = wp.tid()
        i = stencil[e, 0]
        copy = e // per_copy
        pose = poses.at[copy, collider]
        core = shape.core[collider]
        radius = shape.radius[collider]
        if wp.isfinite(core[0]) and h > dtype(0.0):
            way = h * (v[i] + h * gravity[i // per_gravity])
            before = poses.before[copy, collider]
            after = poses.after[copy, collider]
            t = dtype(1.0)
            X = x[i]
            # For a collider at rest, the relative move is the move.
            if not (before == after and surely_out(before, core, radius, wp.length(way) + least, X)):
                ahead = X + way
                X = to_local(before, X)
                way = to_local(after, ahead) - X
                t = kept(X, way, core, radius, least)
            if t < dtype(1.0):
                X = X + t * way
                d, n = local_gap_of(X, core, radius)
                position = to_space(pose, X - d * n)
                pose = behind(position, turned_by(vec3(pose[3], pose[4], pose[5]), pose[6], n))
                core = vec3(dtype(wp.inf), dtype(wp.inf), dtype(wp.inf))
                radius = dtype(0.0)
        r = rest[e]
        changed = wp.isfinite(r[7]) != wp.isfinite(core[0])
        for k in range(7):
            if r[k] != pose[k]:
                changed = True
        if changed:
            for k in range(7):
                r[k] = pose[k]
            for k in range(3):
                r[7 + k] = core[k]
            r[10] = radius
            rest[e] = r

    return set_pose


@cache
def anchor_vertices(dtype, bounded: bool):
    """Kernel over friction elements of one collider at the start of a step: anchors, and the rest states of the step.

    ε = μN/(kA), with N = −kAφ′(d) at the state, or kA(r − d) if ``bounded``. The anchor of a vertex that comes into contact is
    its position. If a vertex slid, that is, ‖u‖ is above the ε of the last step, its anchor follows to a distance of that ε.
    Anchors are stored in the frame of the collider, with ε, which is 0 without contact.
    """
    vec3, _ = types(dtype)
    _pose, anchor_type = pose_types(dtype)
    to_local, to_space = of_pose(dtype)
    rest_type, surely_out = wp.types.vector(8, dtype), surely_apart(dtype)

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
        if surely_out(pose, shape.core[collider], shape.radius[collider], distance, x[i]):
            if rest[e][6] != dtype(0.0) or anchors[i][3] != dtype(0.0):
                rest[e][6] = dtype(0.0)
                anchors[i] = anchor_type()
            return
        X = to_local(pose, x[i])
        d, n = local_gap_of(X, shape.core[collider], shape.radius[collider])
        depth = -slope_of(d, distance)
        if wp.static(bounded):
            depth = wp.max(distance - d, dtype(0.0))
        held = anchors[i]
        r = rest[e]
        a = X
        if depth > dtype(0.0):
            if held[3] > dtype(0.0):
                u = X - vec3(held[0], held[1], held[2])
                u = u - wp.dot(n, u) * n
                l = wp.length(u)
                a = X - wp.where(l > held[3], held[3] / wp.max(l, held[3]), dtype(1.0)) * u
            now = poses.at[copy, collider]
            target = to_space(now, a)
            normal = turned_by(vec3(now[3], now[4], now[5]), now[6], n)
            for k in range(3):
                r[k] = target[k]
                r[3 + k] = normal[k]
        r[6] = friction * depth
        rest[e] = r
        anchors[i] = anchor_type(a[0], a[1], a[2], friction * depth)

    return anchor


@wp.struct
class FilterNotes:
    """Notes of the filter after ``steps`` steps: the number of cuts (copies,), and the first vertex inside (copies, colliders).

    ``inside`` is 0 if no vertex is inside. Else it is FIRST − ((step·n + vertex)(C + 1) + other) with n vertices and C
    colliders. other is the last collider that held the vertex back, or C for a vertex that is not free.

    ``pushed`` and ``kicked``, (N,) or None, are the changes of the positions and velocities of vertices by cuts; entries of
    other vertices are not written.
    """

    steps: wp.array(dtype=wp.int32)
    cut: wp.array(dtype=wp.int64)
    inside: wp.array2d(dtype=wp.int64)
    pushed: wp.array(dtype=wp.vec3d)
    kicked: wp.array(dtype=wp.vec3d)


FIRST = wp.constant(wp.int64(2**62))


@wp.func
def note_cut(notes: FilterNotes, copy: int, i: int, pushed: Any, kicked: Any):
    """Notes that the move of vertex i of a copy was cut, with the changes of its position and velocity."""
    wp.atomic_add(notes.cut, copy, wp.int64(1))
    if notes.pushed.shape[0] > 0:
        notes.pushed[i] = wp.vec3d(wp.float64(pushed[0]), wp.float64(pushed[1]), wp.float64(pushed[2]))
        notes.kicked[i] = wp.vec3d(wp.float64(kicked[0]), wp.float64(kicked[1]), wp.float64(kicked[2]))


@wp.func
def note_inside(notes: FilterNotes, copy: int, collider: int, step: int, vertex: int, per_copy: int, other: int):
    """Notes that a vertex of a copy is inside a collider; the first in time, then by index, remains."""
    count = wp.int64(notes.inside.shape[1])
    key = wp.int64(step) * wp.int64(per_copy) + wp.int64(vertex)
    wp.atomic_max(notes.inside, copy, collider, FIRST - (key * (count + wp.int64(1)) + wp.int64(other)))


@cache
def sliding(dtype):
    """Device functions for a vertex that a surface stops: ``along`` and ``velocity``."""
    vec3, _ = types(dtype)
    zero = dtype(0.0)

    @wp.func
    def along(move: vec3, n: vec3, friction: dtype):
        """The part of a move along a surface with the normal n, and the push, which removes the part into it.

        Friction reduces the first by up to μ times the push (Coulomb).
        """
        push = wp.max(-wp.dot(move, n), zero) * n
        left = move + push
        l, most = wp.length(left), friction * wp.length(push)
        if most > zero:
            left *= wp.max(l - most, zero) / wp.max(l, most)
        return left, push

    @wp.func
    def velocity(v: vec3, move: vec3, change: vec3, push: vec3, h: dtype):
        """The velocity after a step whose ``move`` was changed by a push and friction.

        Along the push it is that of the move. For Euler it is v + change/h. For midpoint, v is twice the mean velocity of the
        step minus that at its start, so v + change/h would throw the vertex back.
        """
        size = wp.dot(push, push)
        found = v + (change - push) / h
        if size > zero:
            found += wp.dot((move + change) / h - v, push) / size * push
        return found

    return along, velocity


@cache
def stopped_by_shape(dtype):
    """Device function (X, move, …) → the end of a move from X in the frame of a convex collider, its change, push, and stop.

    A move that would come nearer than ``least`` stops before, at a distance of at most ``landing`` more. With ``slides``, it
    continues along the plane through that point, which has the whole collider behind it, raised to twice ``least`` so that
    rounding does not stop it. The fourth value is whether the move was stopped.
    """
    vec3, _ = types(dtype)
    kept = kept_part(dtype)
    along, _velocity = sliding(dtype)

    @wp.func
    def stopped(
        X: vec3,
        move: vec3,
        core: vec3,
        radius: dtype,
        friction: dtype,
        least: dtype,
        landing: dtype,
        slides: bool,
    ):
        end = X + move
        change = vec3()
        push = vec3()
        hit = kept(X, move, core, radius, least) < dtype(1.0)
        if hit:
            t = kept(X, move, core, radius, least + landing)
            end = X + t * move
            change = (t - dtype(1.0)) * move
            push = change
            if slides:
                d, n = local_gap_of(end, core, radius)
                left, push = along(-change, n, friction)
                end += left + wp.max(dtype(2.0) * least - d, dtype(0.0)) * n
                change += left
        return end, change, push, hit

    return stopped


@cache
def outside(dtype):
    """Device function (x, end, v, …) → final position and velocity of a free vertex that moves from x to ``end``.

    In the frame of a collider it moves along a segment, or, if that comes too near, as in :func:`stopped_by_shape`. The third
    value is whether a collider stopped it. ``notes`` counts stops, and notes the vertex if colliders leave no way out.
    """
    vec3, _ = types(dtype)
    to_local, to_space = of_pose(dtype)
    stopped, surely_out = stopped_by_shape(dtype), surely_apart(dtype)
    _along, velocity = sliding(dtype)

    @wp.func
    def end_outside(
        x: vec3,
        end: vec3,
        v: vec3,
        h: dtype,
        i: int,
        step: int,
        shape: shapes(dtype),
        poses: step_poses(dtype),
        per_copy: int,
        least: dtype,
        landing: dtype,
        notes: FilterNotes,
    ):
        copy = i // per_copy
        move = end - x
        rounded = least + dtype(8.0) * epsilon(least) * wp.max(wp.abs(end))
        change = vec3()
        push = vec3()
        cuts = wp.int32(0)
        last = wp.int32(0)
        rounds = wp.int32(0)
        while rounds <= cuts and rounds < ROUNDS:  # another round after each cut
            rounds += 1
            for c in range(shape.radius.shape[0]):
                pose = poses.after[copy, c]
                began = poses.before[copy, c]
                # For a collider at rest, the relative move is the move.
                margin = wp.length(end - x) + rounded
                if not (began == pose and surely_out(pose, shape.core[c], shape.radius[c], margin, x)):
                    X = to_local(began, x)
                    X, less, by, hit = stopped(
                        X,
                        to_local(pose, end) - X,
                        shape.core[c],
                        shape.radius[c],
                        shape.friction[c],
                        rounded,
                        landing,
                        rounds <= SLIDING,
                    )
                    if hit:
                        end = to_space(pose, X)
                        change += turned_by(vec3(pose[3], pose[4], pose[5]), pose[6], less)
                        push += turned_by(vec3(pose[3], pose[4], pose[5]), pose[6], by)
                        cuts = rounds
                        last = c
        if cuts > 0:
            after = velocity(v, move, change, push, h)
            note_cut(notes, copy, i, end - x - move, after - v)
            v = after
        if cuts == ROUNDS:
            for c in range(shape.radius.shape[0]):
                d, _n = local_gap_of(to_local(poses.after[copy, c], end), shape.core[c], shape.radius[c])
                if d <= dtype(0.0):
                    note_inside(notes, copy, c, step, i - copy * per_copy, per_copy, last)
        return end, v, cuts > 0

    return end_outside


@cache
def entry(dtype):
    """Device function (x, end, …) that notes a vertex that is not free if it enters a collider between x and ``end``."""
    vec3, _ = types(dtype)
    to_local, _to_space = of_pose(dtype)
    kept = kept_part(dtype)

    @wp.func
    def note_entry(
        x: vec3,
        end: vec3,
        i: int,
        step: int,
        shape: shapes(dtype),
        poses: step_poses(dtype),
        per_copy: int,
        least: dtype,
        notes: FilterNotes,
    ):
        copy = i // per_copy
        rounding = dtype(8.0) * epsilon(least)
        for c in range(shape.radius.shape[0]):
            X = to_local(poses.before[copy, c], x)
            way = to_local(poses.after[copy, c], end) - X
            d, _n = local_gap_of(X, shape.core[c], shape.radius[c])
            deep = -rounding * wp.max(wp.max(wp.abs(end)), wp.max(wp.abs(X)))  # a vertex that moves along may touch
            if d > deep and kept(X, way, shape.core[c], shape.radius[c], deep) < dtype(1.0):
                note_inside(notes, copy, c, step, i - copy * per_copy, per_copy, shape.radius.shape[0])

    return note_entry


@cache
def filter_step(dtype):
    """Kernel over vertices at the end of a step: keeps free vertices outside colliders, also on their way.

    Free vertices, and their ``move``, which may be None, end as in :func:`outside`. :func:`entry` notes others.
    """
    vec3, _ = types(dtype)
    end_outside, note_entry = outside(dtype), entry(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def filter_vertices(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        shape: shapes(dtype),
        # state in
        x_before: wp.array(dtype=vec3),
        poses: step_poses(dtype),
        # parameters
        per_copy: int,
        least: dtype,
        landing: dtype,
        h: dtype,
        # in and out
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        notes: FilterNotes,
    ):
        i = wp.tid()
        now = notes.steps[i // per_copy]
        if inverse_mass[i] > dtype(0.0):
            end, after, short = end_outside(x_before[i], x[i], v[i], h, i, now, shape, poses, per_copy, least, landing, notes)
            if short:
                if move:
                    move[i] = move[i] + (end - x[i])
                x[i] = end
                v[i] = after
        else:
            note_entry(x_before[i], x[i], i, now, shape, poses, per_copy, least, notes)

    return filter_vertices


@cache
def hold_locked(dtype):
    """Kernel over vertices: undoes the filter along locked axes."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def hold(
        # elements
        mobility: wp.array(dtype=vec3),
        # state in
        x_before: wp.array(dtype=vec3),
        v_before: wp.array(dtype=vec3),
        # in and out
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        notes: FilterNotes,
    ):
        i = wp.tid()
        for axis in range(3):
            if mobility[i][axis] == dtype(0.0):
                if notes.pushed.shape[0] > 0:
                    notes.pushed[i][axis] = wp.float64(0.0)
                    notes.kicked[i][axis] = wp.float64(0.0)
                if move:
                    move[i][axis] = move[i][axis] + x_before[i][axis] - x[i][axis]
                x[i][axis] = x_before[i][axis]
                v[i][axis] = v_before[i][axis]

    return hold


@cache
def note_fixed(dtype):
    """Kernel over the vertices of all copies that are not free: :func:`entry`, from the start of the step."""
    vec3, _ = types(dtype)
    note_entry = entry(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def note(
        # elements
        fixed: wp.array(dtype=wp.int32),
        shape: shapes(dtype),
        # state in
        x_before: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        poses: step_poses(dtype),
        # parameters
        per_copy: int,
        least: dtype,
        # in and out
        notes: FilterNotes,
    ):
        p = wp.tid()
        i = fixed[p]
        note_entry(x_before[p], x[i], i, notes.steps[i // per_copy], shape, poses, per_copy, least, notes)

    return note
