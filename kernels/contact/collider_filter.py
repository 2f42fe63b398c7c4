"""Kernels of the filter of convex colliders, which ends a step, and its notes."""

from functools import cache
from typing import Any

import warp as wp

from ..rotation import epsilon
from ..vectors import types
from .colliders import filters, gap_of, kept_part, rotated, shapes, to_local, to_space

ROUNDS = wp.constant(6)  # maximum number of tests of a vertex that colliders stop
SLIDING = wp.constant(2)  # in so many of these it slides; then its move is only shortened, which terminates
FIRST = wp.constant(wp.int64(2**62))


@wp.struct
class FilterNotes:
    """Notes of the filter after ``steps`` steps: the number of cuts (B,), and the first vertex inside (B, C).

    ``inside`` is 0, or FIRST − ((step·n + vertex)(C + 1) + other), where other is the last collider that held the vertex back,
    or C for a vertex that is not free. ``pushed`` and ``kicked``, (N,) or None, are the changes of x and v by cuts.
    """

    steps: wp.array(dtype=wp.int32)
    cut: wp.array(dtype=wp.int64)
    inside: wp.array2d(dtype=wp.int64)
    pushed: wp.array(dtype=wp.vec3d)
    kicked: wp.array(dtype=wp.vec3d)


@wp.func
def note_cut(notes: FilterNotes, copy: int, i: int, pushed: Any, kicked: Any):
    wp.atomic_add(notes.cut, copy, wp.int64(1))
    if notes.pushed.shape[0] > 0:
        notes.pushed[i] = wp.vec3d(pushed)
        notes.kicked[i] = wp.vec3d(kicked)


@wp.func
def note_inside(notes: FilterNotes, copy: int, collider: int, step: int, vertex: int, per_copy: int, other: int):
    """Notes that a vertex of a copy is inside a collider. The first in time, then by index, remains in any order of threads."""
    count = wp.int64(notes.inside.shape[1])
    key = wp.int64(step) * wp.int64(per_copy) + wp.int64(vertex)
    wp.atomic_max(notes.inside, copy, collider, FIRST - (key * (count + wp.int64(1)) + wp.int64(other)))


@cache
def outside(dtype, solids):
    """Device function (x, end, v, …) → end, velocity, whether a collider stopped a free vertex that moves from x to ``end``.

    In the frame of a collider the vertex moves along a segment.
    """
    vec3, _ = types(dtype)
    gap, kept, zero = gap_of(dtype, solids), kept_part(dtype, solids), dtype(0.0)

    @wp.func
    def along(move: vec3, n: vec3, friction: dtype):
        """The part of a move along a surface with normal n, less up to μ times the push (Coulomb), and the push out of it."""
        push = wp.max(-wp.dot(move, n), zero) * n
        left = move + push
        l, most = wp.length(left), friction * wp.length(push)
        if most > zero:
            left *= wp.max(l - most, zero) / wp.max(l, most)
        return left, push

    @wp.func
    def velocity(v: vec3, move: vec3, change: vec3, push: vec3, h: dtype):
        """The velocity after a ``move`` was changed: v + change/h, but along the push that of the move.

        The velocity of midpoint is not that of the move, so v + change/h would throw the vertex back.
        """
        size = wp.dot(push, push)
        found = v + (change - push) / h
        if size > zero:
            found += wp.dot((move + change) / h - v, push) / size * push
        return found

    @wp.func
    def stopped(shape: shapes(dtype), c: int, X: vec3, move: vec3, least: dtype, landing: dtype, slides: bool):
        """The end of a move from X, its change and push, and whether it would come nearer than ``least``.

        Then it ends at most ``landing`` before that distance. With ``slides`` it continues along the tangent plane there,
        raised to twice ``least`` so that rounding does not stop it.
        """
        end = X + move
        change = vec3()
        push = vec3()
        hit = kept(shape, c, X, move, least) < dtype(1.0)
        if hit:
            t = kept(shape, c, X, move, least + landing)
            end = X + t * move
            change = (t - dtype(1.0)) * move
            push = change
            if slides:
                d, n = gap(shape, c, end)
                left, push = along(-change, n, shape.friction[c])
                end += left + wp.max(dtype(2.0) * least - d, zero) * n
                change += left
        return end, change, push, hit

    @wp.func
    def end_outside(x: vec3, end: vec3, v: vec3, h: dtype, i: int, step: int, colliders: filters(dtype), notes: FilterNotes):
        copy = i // colliders.per_copy
        move = end - x
        rounded = colliders.least + dtype(8.0) * epsilon(colliders.least) * wp.max(wp.abs(end))
        change = vec3()
        push = vec3()
        cuts = wp.int32(0)
        last = wp.int32(0)
        rounds = wp.int32(0)
        while rounds <= cuts and rounds < ROUNDS:  # another round after each cut
            rounds += 1
            for c in range(colliders.shape.radius.shape[0]):
                pose = colliders.poses.after[copy, c]
                X = to_local(colliders.poses.before[copy, c], x)
                X, less, pushed, hit = stopped(
                    colliders.shape, c, X, to_local(pose, end) - X, rounded, colliders.landing, rounds <= SLIDING
                )
                if hit:
                    end = to_space(pose, X)
                    change += rotated(pose, less)
                    push += rotated(pose, pushed)
                    cuts = rounds
                    last = c
        if cuts > 0:
            after = velocity(v, move, change, push, h)
            note_cut(notes, copy, i, end - x - move, after - v)
            v = after
        if cuts == ROUNDS:
            for c in range(colliders.shape.radius.shape[0]):
                d, _n = gap(colliders.shape, c, to_local(colliders.poses.after[copy, c], end))
                if d <= dtype(0.0):
                    note_inside(notes, copy, c, step, i - copy * colliders.per_copy, colliders.per_copy, last)
        return end, v, cuts > 0

    return end_outside


@cache
def entry(dtype, solids):
    """Device function (x, end, …) that notes a vertex that is not free if it enters a collider between x and ``end``."""
    vec3, _ = types(dtype)
    gap, kept = gap_of(dtype, solids), kept_part(dtype, solids)

    @wp.func
    def note_entry(x: vec3, end: vec3, i: int, step: int, colliders: filters(dtype), notes: FilterNotes):
        copy = i // colliders.per_copy
        rounding = dtype(8.0) * epsilon(colliders.least)
        for c in range(colliders.shape.radius.shape[0]):
            X = to_local(colliders.poses.before[copy, c], x)
            way = to_local(colliders.poses.after[copy, c], end) - X
            d, _n = gap(colliders.shape, c, X)
            deep = -rounding * wp.max(wp.max(wp.abs(end)), wp.max(wp.abs(X)))  # a vertex that moves along may touch
            if d > deep and kept(colliders.shape, c, X, way, deep) < dtype(1.0):
                note_inside(
                    notes, copy, c, step, i - copy * colliders.per_copy, colliders.per_copy, colliders.shape.radius.shape[0]
                )

    return note_entry


@cache
def filter_step(dtype, solids):
    """Kernel over vertices at the end of a step: keeps free vertices and their ``move`` (or None) outside colliders.

    It notes vertices that are not free and enter a collider.
    """
    vec3, _ = types(dtype)
    end_outside, note_entry = outside(dtype, solids), entry(dtype, solids)

    @wp.kernel(module="unique", enable_backward=False)
    def filter_vertices(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        colliders: filters(dtype),
        # state in
        x_before: wp.array(dtype=vec3),
        # parameters
        h: dtype,
        # in and out
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        notes: FilterNotes,
    ):
        i = wp.tid()
        now = notes.steps[i // colliders.per_copy]
        if inverse_mass[i] > dtype(0.0):
            end, after, short = end_outside(x_before[i], x[i], v[i], h, i, now, colliders, notes)
            if short:
                if move:
                    move[i] = move[i] + (end - x[i])
                x[i] = end
                v[i] = after
        else:
            note_entry(x_before[i], x[i], i, now, colliders, notes)

    return filter_vertices


@cache
def hold_locked(dtype):
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
def note_fixed(dtype, solids):
    """Kernel over the vertices of all copies that are not free: notes those that enter a collider in the step."""
    vec3, _ = types(dtype)
    note_entry = entry(dtype, solids)

    @wp.kernel(module="unique", enable_backward=False)
    def note(
        # elements
        fixed: wp.array(dtype=wp.int32),
        colliders: filters(dtype),
        # state in
        x_before: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        # in and out
        notes: FilterNotes,
    ):
        p = wp.tid()
        i = fixed[p]
        note_entry(x_before[p], x[i], i, notes.steps[i // colliders.per_copy], colliders, notes)

    return note
