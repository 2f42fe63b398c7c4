"""Factories of the tests whether a step without self-contact may need it: before the step, and after it."""

from functools import cache

import warp as wp

from ..memory import load
from ..vectors import types


@cache
def far_limits(dtype):
    """Struct of the limits of a step without contact, with the vertices per copy and per range.

    The list of pairs must be that of ``found``. Since then, each vertex may have moved by ``way``, relative to the ``drift``
    of its copy [m]. In the step of ``h`` it may move by ``most``, relative to the first vertex of the copy if all move
    ``together``. A range is a loop over ``size`` vertices without branches, for the CPU.
    """

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
def stays_far(dtype):
    """Device function (since, move, listed − found, limits) → 1 if a vertex keeps within the limits, else 0."""
    vec3, _ = types(dtype)

    @wp.func
    def stays(since: vec3, move: vec3, other: vec3, limits: far_limits(dtype)):
        kept = wp.where(wp.dot(move, move) <= limits.most * limits.most, 1, 0)
        kept = wp.where(wp.dot(since, since) <= limits.way * limits.way, kept, 0)
        return wp.where(wp.dot(other, other) <= dtype(0.0), kept, 0)

    return stays


@cache
def find_near(dtype):
    """Kernel over copies and ranges at the start of a step: near = 1 if h v is beyond the limits; stores x and v."""
    vec3, _ = types(dtype)
    vector, stays = load(vec3), stays_far(dtype)

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
        i = first + part * limits.size
        end = wp.min(i + limits.size, first + limits.per_copy)
        quiet = end - i
        while i < end:
            before = vector(x, i)
            velocity = vector(v, i)
            at_list = vector(found, i)
            quiet -= stays(before - at_list - common, limits.h * velocity - own_move, at_list - vector(listed, i), limits)
            x_kept[i] = before
            v_kept[i] = velocity
            i += 1
        if quiet != 0:
            near[0] = 1

    return find_near_vertices


@cache
def find_far(dtype):
    """Kernel over copies and ranges at the end of a step: near = 1 if it began or moved beyond the limits."""
    vec3, _ = types(dtype)
    vector, stays = load(vec3), stays_far(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def find_far_vertices(
        # state in
        drift: wp.array(dtype=vec3),
        found: wp.array(dtype=vec3),
        listed: wp.array(dtype=vec3),
        x_before: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        # parameters
        limits: far_limits(dtype),
        # out
        near: wp.array(dtype=wp.int32),
    ):
        copy, part = wp.tid()
        first = copy * limits.per_copy
        common = drift[copy]
        own_move = vec3()
        if limits.together:
            own_move = x[first] - x_before[first]
        i = first + part * limits.size
        end = wp.min(i + limits.size, first + limits.per_copy)
        quiet = end - i
        while i < end:
            before = vector(x_before, i)
            at_list = vector(found, i)
            quiet -= stays(before - at_list - common, vector(x, i) - before - own_move, at_list - vector(listed, i), limits)
            i += 1
        if quiet != 0:
            near[0] = 1

    return find_far_vertices
