"""Kernels of an explicit step, v += h(g − M⁻¹∇U), x += h v, with a given ∇U."""

from functools import cache

import warp as wp

from .vectors import types


@cache
def kick_and_drift(dtype, symplectic: bool, compensated: bool = False):
    """Device function (x, residual, v, a, h) → x, residual, v after a step.

    If ``symplectic``, x moves with the new v. ``compensated`` sums x + residual by compensation (Dekker 1971, *A floating-point
    technique for extending the available precision*).
    """
    vec3, _ = types(dtype)

    @wp.func
    def step(x: vec3, residual: vec3, v: vec3, a: vec3, h: dtype):
        after = v + h * a
        if wp.static(symplectic):
            move = h * after
        else:
            move = h * v
        if wp.static(compensated):
            move += residual
        position = x + move
        if wp.static(compensated):
            residual = move - (position - x)
        return position, residual, after

    return step


@cache
def explicit_step(dtype, symplectic: bool, compensated: bool = False):
    """Kernel over vertices: x, v after a step with a = g − ∇U/m, but for pins; resets the gradient."""
    vec3, _ = types(dtype)
    step = kick_and_drift(dtype, symplectic, compensated)

    @wp.kernel(module="unique", enable_backward=False)
    def step_vertices(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        per_copy: int,
        # parameters
        h: dtype,
        # in and out
        gradient: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        residual: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        w = inverse_mass[i]
        if w > dtype(0.0):
            before = vec3()
            if wp.static(compensated):
                before = residual[i]
            position, after, velocity = step(x[i], before, v[i], gravity[i // per_copy] - w * gradient[i], h)
            x[i] = position
            v[i] = velocity
            if wp.static(compensated):
                residual[i] = after
        gradient[i] = vec3()

    return step_vertices


@cache
def move_ahead(dtype):
    """Kernel over vertices: d = h v, where damping is computed."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def move_vertices_ahead(
        # state in
        v: wp.array(dtype=vec3),
        # parameters
        h: dtype,
        # out
        d: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        d[i] = h * v[i]

    return move_vertices_ahead
