"""Factories of the tests whether a step without self-contact may need it: before the step, and after it."""

from functools import cache

import warp as wp

from ..memory import load
from ..vectors import types


@cache
def far_limits(dtype):
    """Struct of the limits of a step without contact, see :func:`find_near`, with the vertices per copy and per range."""

    @wp.struct
    class FarLimits:
        per_copy: wp.int32
        size: wp.int32
        h: dtype
        way: dtype
        most: dtype
        together: wp.bool

    return FarLimits


@cache
def find_near(dtype):
    """Kernel over copies and ranges of ``size`` vertices at the start of a step: near = 1 if contact is possible; stores x, v.

    That is the case if the list is not that of ``found``; if a vertex has moved by more than ``way`` since then, relative to
    the ``drift`` of its copy; or if h v is longer than ``most``, relative to the first vertex of the copy if all move
    ``together``. A range is a loop without branches, for the CPU.
    """
    vec3, _ = types(dtype)
    vector = load(vec3)

    @wp.kernel(module="unique", enable_backward=False)
    def find_near_vertices(
        # state in
        drift: wp.array(dtype=vec3),
        found: wp.array(dtype=vec3),
        listed: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        # parameters
        limits: far_limits(dtype),
        # out
        x_kept: wp.array(dtype=vec3),
        v_kept: wp.array(dtype=vec3),
        near: wp.array(dtype=wp.int32),
    ):
        copy, part = wp.tid()
        first = copy * limits.per_copy
        common = drift[copy]
        own_move = vec3()
        if limits.together:
            own_move = limits.h * v[first]
        far = limits.way * limits.way
        long = limits.most * limits.most
        i = first + part * limits.size
        end = wp.min(i + limits.size, first + limits.per_copy)
        quiet = end - i
        while i < end:
            before = vector(x, i)
            velocity = vector(v, i)
            at_list = vector(found, i)
            since = before - at_list - common
            move = limits.h * velocity - own_move
            other = at_list - vector(listed, i)
            kept = wp.where(wp.dot(since, since) <= far, wp.where(wp.dot(move, move) <= long, 1, 0), 0)
            quiet -= wp.where(wp.dot(other, other) <= dtype(0.0), kept, 0)
            x_kept[i] = before
            v_kept[i] = velocity
            i += 1
        if quiet != 0:
            near[0] = 1

    return find_near_vertices


@cache
def find_far(dtype):
    """Kernel over copies and ranges of ``size`` vertices at the end of a step: near = 1 if a move is longer than ``most``.

    Moves are x − ``x_before``, relative to that of the first vertex of the copy if all move ``together``.
    """
    vec3, _ = types(dtype)
    vector = load(vec3)

    @wp.kernel(module="unique", enable_backward=False)
    def find_far_vertices(
        # state in
        x_before: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        # parameters
        limits: far_limits(dtype),
        # out
        near: wp.array(dtype=wp.int32),
    ):
        copy, part = wp.tid()
        first = copy * limits.per_copy
        own_move = vec3()
        if limits.together:
            own_move = x[first] - x_before[first]
        long = limits.most * limits.most
        i = first + part * limits.size
        end = wp.min(i + limits.size, first + limits.per_copy)
        quiet = end - i
        while i < end:
            move = vector(x, i) - vector(x_before, i) - own_move
            quiet -= wp.where(wp.dot(move, move) <= long, 1, 0)
            i += 1
        if quiet != 0:
            near[0] = 1

    return find_far_vertices
