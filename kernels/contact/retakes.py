"""Factories of the kernels of steps that are taken again, see :mod:`warpcloth.solvers.retakes`."""

from functools import cache

import warp as wp

from ..vectors import types


@cache
def take_impact(dtype):
    """Kernel over vertices: x = ``end`` along free axes, in copies that are ``again``; v and ``move`` change with it.

    ``cut`` (B,) counts the vertices that it moves.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def take_each_impact(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        mobility: wp.array(dtype=vec3),
        # state in
        end: wp.array(dtype=vec3),
        again: wp.array(dtype=wp.int32),
        # parameters
        per_copy: int,
        he: dtype,
        # in and out
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        cut: wp.array(dtype=wp.int64),
    ):
        i = wp.tid()
        if again[i // per_copy] == 0 or inverse_mass[i] == dtype(0.0):
            return
        change = end[i] - x[i]
        if mobility:
            for axis in range(3):
                if mobility[i][axis] == dtype(0.0):
                    change[axis] = dtype(0.0)
        if wp.length_sq(change) > dtype(0.0):
            wp.atomic_add(cut, i // per_copy, wp.int64(1))
        x[i] = x[i] + change
        v[i] = v[i] + change / he
        if move:
            move[i] = move[i] + change

    return take_each_impact


@cache
def correct_to(dtype):
    """Kernel over vertices: ``correction`` = target − x along free axes, else 0, in ``copies`` (B,) that are 1."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def correct_each_to(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        mobility: wp.array(dtype=vec3),
        # state in
        target: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        copies: wp.array(dtype=wp.int32),
        # parameters
        per_copy: int,
        # out
        correction: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if copies[i // per_copy] == 0:
            return
        change = vec3()
        if inverse_mass[i] > dtype(0.0):
            change = target[i] - x[i]
        if mobility:
            for axis in range(3):
                if mobility[i][axis] == dtype(0.0):
                    change[axis] = dtype(0.0)
        correction[i] = change

    return correct_each_to
