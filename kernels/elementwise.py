"""Elementwise kernels: negation, scaling, differences, steps.

Entries are vectors, or with ``numbers`` scalars, in another module, as Warp would take both for one kernel.
"""

from functools import cache

import warp as wp

from .vectors import types


@cache
def negate(dtype):
    """Kernel over numbers: out = −a."""

    @wp.kernel(module=f"warpcloth.constraint_step.{dtype.__name__}", enable_backward=False)
    def negate_entries(
        # state in
        a: wp.array(dtype=dtype),
        # out
        out: wp.array(dtype=dtype),
    ):
        i = wp.tid()
        out[i] = -a[i]

    return negate_entries


@cache
def scale(dtype, numbers: bool = False):
    """Kernel over entries: out = sᵢ aᵢ; out may be a."""
    value = dtype if numbers else types(dtype)[0]
    module = f"conjugate_gradients.{dtype.__name__}.numbers" if numbers else f"constraint_step.{dtype.__name__}"

    @wp.kernel(module=f"warpcloth.{module}", enable_backward=False)
    def scale_entries(
        # elements
        s: wp.array(dtype=dtype),
        # state in
        a: wp.array(dtype=value),
        # out
        out: wp.array(dtype=value),
    ):
        i = wp.tid()
        out[i] = s[i] * a[i]

    return scale_entries


@cache
def mismatch(dtype):
    """Kernel over vertices: out = d − v; with v = W Jᵀλ the residual of motion [m]."""
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
def add_step(dtype, numbers: bool = False):
    """Kernel over entries: a += step·change, step of the copy."""
    value = dtype if numbers else types(dtype)[0]

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
    """Kernel over copies: step = 1 for active copies, 0 for the others."""

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
