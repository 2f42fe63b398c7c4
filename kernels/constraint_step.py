"""Factories of the kernels of a step of constrained dynamics over vertices and rows: differences, scalings, steps."""

from functools import cache

import warp as wp

from .vectors import types


@cache
def weigh(dtype):
    """Kernel over vertices: v = w v, w the inverse mass."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"warpcloth.constraint_step.{dtype.__name__}", enable_backward=False)
    def weigh_vertices(
        # state in
        inverse_mass: wp.array(dtype=dtype),
        # in and out
        v: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        v[i] = inverse_mass[i] * v[i]

    return weigh_vertices


@cache
def mismatch(dtype):
    """Kernel over vertices: out = d − v; with v = W Jᵀλ what inertia and constraints disagree by [m]."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"warpcloth.constraint_step.{dtype.__name__}", enable_backward=False)
    def subtract(
        # state in
        d: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        # out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        out[i] = d[i] - v[i]

    return subtract


@cache
def add_step(dtype, vectors: bool):
    """Kernel over vertices, or rows of numbers: a += step·change, step that of the copy."""
    value = types(dtype)[0] if vectors else dtype

    @wp.kernel(module="unique", enable_backward=False)
    def add_steps(
        # state in
        step: wp.array(dtype=wp.float64),
        change: wp.array(dtype=value),
        # parameters
        per_copy: int,
        # in and out
        a: wp.array(dtype=value),
    ):
        i = wp.tid()
        a[i] = a[i] + dtype(step[i // per_copy]) * change[i]

    return add_steps


@cache
def begin_step():
    """Kernel over copies: step 1 for those that still iterate, 0 for the rest."""

    @wp.kernel(module="unique", enable_backward=False)
    def begin(
        # parameters
        active: wp.array(dtype=wp.int32),
        # out
        step: wp.array(dtype=wp.float64),
    ):
        copy = wp.tid()
        step[copy] = wp.float64(active[copy])

    return begin


@cache
def scale_rows(dtype):
    """Kernel over rows: out = factors·a."""

    @wp.kernel(module=f"warpcloth.constraint_step.{dtype.__name__}", enable_backward=False)
    def scale(
        # state in
        factors: wp.array(dtype=dtype),
        a: wp.array(dtype=dtype),
        # out
        out: wp.array(dtype=dtype),
    ):
        i = wp.tid()
        out[i] = factors[i] * a[i]

    return scale


@cache
def negate_rows(dtype):
    """Kernel over rows: out = −a."""

    @wp.kernel(module=f"warpcloth.constraint_step.{dtype.__name__}", enable_backward=False)
    def negate(
        # state in
        a: wp.array(dtype=dtype),
        # out
        out: wp.array(dtype=dtype),
    ):
        i = wp.tid()
        out[i] = -a[i]

    return negate
