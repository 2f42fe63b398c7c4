"""Kernels that find how far a step ended from its minimiser."""

from functools import cache

import warp as wp

from .vectors import types


@cache
def add_moves(dtype):
    """Kernel over vertices: out = d + part (x − unfiltered), after contact moved vertices."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add(
        # state in
        d: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        unfiltered: wp.array(dtype=vec3),
        # parameters
        part: dtype,
        # out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        out[i] = d[i] + part * (x[i] - unfiltered[i])

    return add


@cache
def finish_residual(dtype):
    """Kernel over vertices: from ∂U/∂x, r = s m d + ∂U/∂x [N], or 0 for pins, and weighted = r/√m."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def finish(
        # elements
        mass: wp.array(dtype=dtype),
        inverse_mass: wp.array(dtype=dtype),
        # state in
        d: wp.array(dtype=vec3),
        # parameters
        s: dtype,
        # in and out
        r: wp.array(dtype=vec3),
        # out
        weighted: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if inverse_mass[i] > dtype(0.0):
            r[i] = r[i] + (s * mass[i]) * d[i]
        else:
            r[i] = vec3()
        weighted[i] = wp.sqrt(inverse_mass[i]) * r[i]

    return finish


@cache
def normal_moves(dtype):
    """Kernel over vertices: out = n·move n/r, n the direction of the contact force, or 0."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def project(
        # state in
        force: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        # parameters
        r: dtype,
        # out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        n = wp.normalize(force[i])
        out[i] = (wp.dot(n, move[i]) / r) * n

    return project


@cache
def energy_above():
    """Kernel over elements: out = (√u − √allowed)² where u is larger, else 0 [J]."""

    @wp.kernel(module="unique", enable_backward=False)
    def subtract(
        # state in
        u: wp.array(dtype=wp.float64),
        allowed: wp.array(dtype=wp.float64),
        # out
        out: wp.array(dtype=wp.float64),
    ):
        e = wp.tid()
        above = wp.sqrt(wp.max(u[e], wp.float64(0.0))) - wp.sqrt(wp.max(allowed[e], wp.float64(0.0)))
        out[e] = wp.where(above > wp.float64(0.0), above * above, wp.float64(0.0))

    return subtract


@cache
def unresolved_contact(dtype):
    """Kernel over vertices: counts frames in a row where half of a contact force f is unbalanced and f h²/m > r, so that it
    would move the vertex out of contact in a step.

    ``forces`` are of colliders, ``forces_of_cloth`` of self-contact or None, ``r`` the contact distances. out = (1, 0, 0) after
    two such frames.
    """
    vec3, _ = types(dtype)

    @wp.func
    def presses(force: vec3, residual: vec3, mobility: dtype, r: dtype):
        f = wp.length(force)
        return wp.abs(wp.dot(wp.normalize(force), residual)) > dtype(0.5) * f and mobility * f > r

    @wp.kernel(module="unique", enable_backward=False)
    def count(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        # state in
        forces: wp.array(dtype=vec3),
        forces_of_cloth: wp.array(dtype=vec3),
        residual: wp.array(dtype=vec3),
        # parameters
        square: dtype,
        r: dtype,
        r_of_cloth: dtype,
        # in and out
        frames: wp.array(dtype=wp.int32),
        # out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        mobility = square * inverse_mass[i]
        wrong = presses(forces[i], residual[i], mobility, r)
        if forces_of_cloth:
            wrong = wrong or presses(forces_of_cloth[i], residual[i], mobility, r_of_cloth)
        if wrong:
            frames[i] = frames[i] + 1
        else:
            frames[i] = 0
        out[i] = vec3()
        if frames[i] > 1:
            out[i] = vec3(dtype(1.0), dtype(0.0), dtype(0.0))

    return count
