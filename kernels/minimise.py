"""Factories of the kernels that minimise φ(d) = s/2‖d‖²_M + U(base + d) − load·Σ m g·d over the free vertices of each copy.

φ is the objective of implicit Euler for base = x̃, s = 1/h² and load = 0. It is the potential energy under gravity for base =
the start, s = 0 and load = 1.
"""

from functools import cache

import warp as wp

from .vectors import types

MODULE = "warpcloth.minimise"  # of the kernels over copies


@cache
def set_trial(dtype):
    """Kernel over vertices: trial = d + step·p, with the step length of the copy; resets the gradient to 0."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def set_each_trial(
        # state in
        correction: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        step: wp.array(dtype=wp.float64),
        # parameters
        per_copy: int,
        # out
        trial: wp.array(dtype=vec3),
        gradient: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        trial[i] = correction[i] + dtype(step[i // per_copy]) * direction[i]
        gradient[i] = vec3()

    return set_each_trial


@cache
def add_inertia(dtype):
    """Kernel over vertices: gradient += s m d − load m g, or = 0 for pins; work[i] = s/2 m d·d − load m g·d [J]."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def add(
        # elements
        mass: wp.array(dtype=dtype),
        inverse_mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        # state in
        correction: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        s: dtype,
        load: dtype,
        # in and out
        gradient: wp.array(dtype=vec3),
        # out
        work: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        if inverse_mass[i] > dtype(0.0):
            d = correction[i]
            pull = load * gravity[i // per_copy]
            gradient[i] = gradient[i] + mass[i] * (s * d - pull)
            work[i] = wp.float64(mass[i]) * wp.float64(wp.dot(dtype(0.5) * s * d - pull, d))
        else:
            gradient[i] = vec3()
            work[i] = wp.float64(0.0)

    return add


@cache
def begin_search():
    """Kernel over copies: step = 1 for active copies, 0 for the others; starts their line searches."""

    @wp.kernel(module=MODULE, enable_backward=False)
    def begin(
        # parameters
        active: wp.array(dtype=wp.int32),
        # out
        step: wp.array(dtype=wp.float64),
        searching: wp.array(dtype=wp.int32),
        trials: wp.array(dtype=wp.int32),
        proceed: wp.array(dtype=wp.int32),
    ):
        copy = wp.tid()
        step[copy] = wp.float64(active[copy])
        searching[copy] = active[copy]
        trials[0] = 0
        proceed[0] = 1

    return begin


@cache
def check_trial():
    """Kernel over copies: accepts a trial step or halves it; sets it to 0 after ``most`` trials.

    A step is accepted if φ(α) ≤ φ(0) + 1e-4 α φ'(0) (Armijo). It is also accepted if φ(α) ≤ φ(0) + noise and
    φ'(α) ≤ −(1 − 2e-4)·φ'(0), where rounding hides the decrease of φ (approximate Wolfe, Hager and Zhang 2005). NaN is never
    accepted.
    """

    @wp.kernel(module=MODULE, enable_backward=False)
    def check(
        # state in
        start: wp.array(dtype=wp.float64),
        trial: wp.array(dtype=wp.float64),
        slope: wp.array(dtype=wp.float64),
        trial_slope: wp.array(dtype=wp.float64),
        # parameters
        noise: wp.float64,
        trials: wp.array(dtype=wp.int32),
        most: int,
        # in and out
        step: wp.array(dtype=wp.float64),
        searching: wp.array(dtype=wp.int32),
        # out
        proceed: wp.array(dtype=wp.int32),
    ):
        copy = wp.tid()
        if searching[copy] == 1:
            decrease = trial[copy] <= start[copy] + wp.float64(1.0e-4) * step[copy] * slope[copy]
            level = trial[copy] <= start[copy] + noise * wp.abs(start[copy])
            flat = trial_slope[copy] <= -wp.float64(1.0 - 2.0e-4) * slope[copy]
            if decrease or (level and flat):
                searching[copy] = 0
            else:
                step[copy] = wp.float64(0.5) * step[copy]
                proceed[0] = 1
                if trials[0] >= most:
                    step[copy] = wp.float64(0.0)

    return check
