"""Kernels over rigid clusters: target positions of their vertices, and Gauss–Seidel sweeps.

Cluster c has the elements offsets[c] to offsets[c+1], one per vertex, with a rest position ``shape`` relative to the centre of
mass and a rest state (t, m).
"""

from functools import cache

import warp as wp

from .project import nth_of_thread, spread_compliance, sweep_turn
from .rotation import nearest_rotation
from .vectors import types


@cache
def cluster_fit(dtype, corrected: bool, precision=None):
    """Device function that sets t = c + R q − (x + d) of elements first to last − 1 and returns R; d counts if ``corrected``.

    Positions are relative to the first vertex, in the ``precision``, by default that of x and d.
    """
    vec3, _ = types(dtype)
    number = precision or dtype
    wide, mat33 = types(number)
    rest_type = wp.types.vector(4, dtype)

    @wp.func
    def from_first(stencil: wp.array2d(dtype=wp.int32), first: int, e: int, x: wp.array(dtype=vec3), d: wp.array(dtype=vec3)):
        relative = wide(x[stencil[e, 0]]) - wide(x[stencil[first, 0]])
        if wp.static(corrected):
            relative += wide(d[stencil[e, 0]]) - wide(d[stencil[first, 0]])
        return relative

    @wp.func
    def fit_cluster(
        first: int,
        last: int,
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        shape: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
    ):
        total = number(0.0)
        for e in range(first, last):
            total += number(rest[e][3])
        centre = wide()
        for e in range(first, last):
            centre += (number(rest[e][3]) / total) * from_first(stencil, first, e, x, d)
        S = mat33()
        for e in range(first, last):
            S += wp.outer((number(rest[e][3]) / total) * (from_first(stencil, first, e, x, d) - centre), wide(shape[e]))
        R = nearest_rotation(S)
        for e in range(first, last):
            t = centre + R * wide(shape[e]) - from_first(stencil, first, e, x, d)
            rest[e] = rest_type(dtype(t[0]), dtype(t[1]), dtype(t[2]), rest[e][3])
        return R

    return fit_cluster


@cache
def fit_targets(dtype, corrected: bool):
    """Kernel over clusters: targets t of their elements at x, or if ``corrected`` at x + d in float64."""
    vec3, _ = types(dtype)
    rest_type = wp.types.vector(4, dtype)
    fit_cluster = cluster_fit(dtype, corrected, wp.float64 if corrected else dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def fit_all(
        # elements
        offsets: wp.array(dtype=wp.int32),
        stencil: wp.array2d(dtype=wp.int32),
        shape: wp.array(dtype=vec3),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # in and out
        rest: wp.array(dtype=rest_type),
    ):
        c = wp.tid()
        _R = fit_cluster(offsets[c], offsets[c + 1], stencil, rest, shape, x, d)

    return fit_all


@cache
def correct_clusters(dtype, multipliers: bool, per_step: bool, axes: bool = False):
    """Kernel of a Gauss–Seidel sweep over clusters, of which the vertices move at once.

    Δxᵢ = (tᵢ − α̃λᵢ/mᵢ)/(1 + α̃), α̃ = 1/(κh²), λᵢ += mᵢΔxᵢ; a thread takes ``each`` clusters. With ``axes``, vertices move
    along free axes only.
    """
    vec3, _ = types(dtype)
    rest_type, lambda_type = wp.types.vector(4, dtype), wp.types.matrix((1, 3), dtype)
    fit_cluster, spread = cluster_fit(dtype, True), spread_compliance(dtype)
    mass_type = vec3 if axes else dtype

    @wp.func
    def largest(inverse_mass: mass_type):
        if wp.static(axes):
            return wp.max(inverse_mass)
        else:
            return inverse_mass

    @wp.kernel(module="unique", enable_backward=False)
    def correct(
        # elements
        offsets: wp.array(dtype=wp.int32),
        shape: wp.array(dtype=vec3),
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        # state in
        inverse_mass: wp.array(dtype=mass_type),
        x: wp.array(dtype=vec3),
        # parameters
        turn: sweep_turn(dtype),
        # in and out
        lambdas: wp.array(dtype=lambda_type),
        d: wp.array(dtype=vec3),
    ):
        for k in range(wp.abs(turn.each)):
            c = nth_of_thread(turn.first, turn.each, wp.tid(), k)
            _R = fit_cluster(offsets[c], offsets[c + 1], stencil, rest, shape, x, d)
            for e in range(offsets[c], offsets[c + 1]):
                v = stencil[e, 0]
                compliance = dtype(1.0) / (stiffness[e] * turn.h * turn.h)
                if wp.static(per_step):
                    compliance = spread(dtype(1.0), compliance, turn.sweeps)
                mobility = largest(inverse_mass[v])
                if mobility > dtype(0.0) and wp.isfinite(compliance):
                    t = vec3(rest[e][0], rest[e][1], rest[e][2])
                    if wp.static(multipliers):
                        t = t - (compliance * mobility) * lambdas[e][0]
                    move = (turn.relaxation / (dtype(1.0) + compliance)) * t
                    if wp.static(axes):
                        for axis in range(3):
                            if inverse_mass[v][axis] == dtype(0.0):
                                move[axis] = dtype(0.0)
                    d[v] = d[v] + move
                    if wp.static(multipliers):
                        after = lambdas[e]
                        after[0] = after[0] + move / mobility
                        lambdas[e] = after

    return correct
