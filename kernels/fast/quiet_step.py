"""Factory of the test whether an explicit step without contact may have needed it."""

from functools import cache

import warp as wp

from ..memory import load
from ..vectors import types


@cache
def find_unquiet(dtype):
    """Kernel over copies and ranges of ``size`` vertices: again = 1 if a step from ``x_before`` to x may have needed contact.

    That is the case if the list is not that of ``found``; if a vertex had moved by more than ``way`` since then, relative to
    the ``drift`` of its copy; or if one moved by more than ``most``, relative to the first vertex of the copy if all
    move ``together``. A range is a loop without branches, for the CPU.
    """
    vec3, _ = types(dtype)
    vector = load(vec3)

    @wp.kernel(module="unique", enable_backward=False)
    def find_unquiet_vertices(
        # state in
        drift: wp.array(dtype=vec3),
        x_before: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        found: wp.array(dtype=vec3),
        listed: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        size: int,
        way: dtype,
        most: dtype,
        together: bool,
        # out
        again: wp.array(dtype=wp.int32),
    ):
        copy, part = wp.tid()
        first = copy * per_copy
        common = drift[copy]
        own_move = vec3()
        if together:
            own_move = x[first] - x_before[first]
        far = way * way
        long = most * most
        i = first + part * size
        end = wp.min(i + size, first + per_copy)
        quiet = end - i
        while i < end:
            before = vector(x_before, i)
            at_list = vector(found, i)
            since = before - at_list - common
            move = vector(x, i) - before - own_move
            other = at_list - vector(listed, i)
            near = wp.where(wp.dot(since, since) <= far, wp.where(wp.dot(move, move) <= long, 1, 0), 0)
            quiet -= wp.where(wp.dot(other, other) <= dtype(0.0), near, 0)
            i += 1
        if quiet != 0:
            again[0] = 1

    return find_unquiet_vertices
