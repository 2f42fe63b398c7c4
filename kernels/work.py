"""Kernels of the forces of multipliers and of the work of pins and loads."""

from functools import cache

import warp as wp

from .local import local_coordinate
from .project import multiplier_type
from .term import Term
from .transpose import LocalSource, gather, scatter
from .vectors import types


@cache
def multiplier_pull(term: Term, dtype, scalar: bool):
    """:class:`.transpose.LocalSource` of factor·λ, or with ``scalar`` of factor·λ ∂C/∂y."""
    vec3, _ = types(dtype)
    rest_type, lambda_type = wp.types.vector(term.parameters, dtype), multiplier_type(term, dtype, scalar)
    y_of, slope = local_coordinate(term, dtype, False), term.constraint_gradient

    @wp.struct
    class Multipliers:
        stencil: wp.array2d(dtype=wp.int32)
        values: wp.array(dtype=lambda_type)
        x: wp.array(dtype=vec3)
        factor: dtype

    @wp.func
    def pull(data: Multipliers, e: int, r: rest_type):
        if wp.static(scalar):
            z = data.values[e] * slope(y_of(data.stencil, e, r, data.x, data.x), r)
        else:
            z = data.values[e]
        return data.factor * z

    return LocalSource(Multipliers, pull)


def scatter_multipliers(term: Term, dtype, scalar: bool):
    """Kernel over elements: out += factor·Gᵀλ."""
    return scatter(term, dtype, multiplier_pull(term, dtype, scalar))


def gather_multipliers(term: Term, dtype, scalar: bool):
    return gather(term, dtype, multiplier_pull(term, dtype, scalar))


@cache
def add_scaled(dtype):
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add(
        # state in
        a: wp.array(dtype=vec3),
        # parameters
        factor: dtype,
        # in and out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        out[i] = out[i] + factor * a[i]

    return add


@cache
def step_back(dtype):
    """Kernel over vertices: d = h v, before = x − d."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def back(
        # state in
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        # parameters
        h: dtype,
        # out
        before: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        d[i] = h * v[i]
        before[i] = x[i] - d[i]

    return back


@cache
def past(dtype):
    """Struct of positions, ∂U/∂x and forces of loads before a step."""
    vec3, _ = types(dtype)

    @wp.struct
    class Past:
        x: wp.array(dtype=vec3)
        gradient: wp.array(dtype=vec3)
        force: wp.array(dtype=vec3)

    return Past


@cache
def wide_dot(dtype):
    vec3, _ = types(dtype)

    @wp.func
    def product(a: vec3, b: vec3):
        return wp.float64(a[0]) * wp.float64(b[0]) + wp.float64(a[1]) * wp.float64(b[1]) + wp.float64(a[2]) * wp.float64(b[2])

    return product


@cache
def add_work(dtype):
    """Kernel over vertices, after a step: work of loads += f·Δx, of pins += (½(∇U₀ + ∇U₁) − m g − f)·Δx along held axes.

    −∇U is the force of the cloth on a pin. The mean of both ∇U is exact for quadratic energies in midpoint. f is the force of
    loads, or with ``share`` ½ its mean over the step.
    """
    vec3, _ = types(dtype)
    product = wide_dot(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add(
        # elements
        mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        held: wp.array(dtype=vec3),
        # state in
        x: wp.array(dtype=vec3),
        gradient: wp.array(dtype=vec3),
        force: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        share: dtype,
        # in and out
        before: past(dtype),
        of_pins: wp.array(dtype=wp.float64),
        of_loads: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        move = x[i] - before.x[i]
        f = vec3()
        if force.shape[0] > 0:
            f = (dtype(1.0) - share) * force[i] + share * before.force[i]
            of_loads[i] = of_loads[i] + product(f, move)
            before.force[i] = force[i]
        if held.shape[0] > 0:
            pull = dtype(0.5) * (before.gradient[i] + gradient[i]) - mass[i] * gravity[i // per_copy] - f
            of_pins[i] = of_pins[i] + product(pull, wp.cw_mul(held[i], move))
            before.gradient[i] = gradient[i]
        before.x[i] = x[i]

    return add


@cache
def add_rubbing_work(dtype):
    """Kernel over vertices, after a step: work against friction += ∇H·Δx."""
    vec3, _ = types(dtype)
    product = wide_dot(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add_each_rubbing(
        # state in
        gradient: wp.array(dtype=vec3),
        x_before: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        # in and out
        against_friction: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        against_friction[i] = against_friction[i] + product(gradient[i], x[i] - x_before[i])

    return add_each_rubbing
