"""Factories of the kernels of the energy of self-contact and its derivatives.

U = Σ kA φ(d) over the acting pairs, with the gap d of :mod:`.self_gaps`, the area A of :mod:`.self_pairs`, and φ as for
colliders (:mod:`..terms.contact`). The nearest points minimise ‖y‖, so their motion does not contribute to the gradient
∂U/∂xᵢ = kA φ′ wᵢn, n = y/d (Danskin's theorem). The Hessian is approximated by its semi-definite part kA φ″ wᵢwⱼnnᵀ.

Everything is computed in float64 for every precision of the model, so that positions are exact.
"""

from functools import cache

import warp as wp

from ..terms import contact
from ..vectors import types
from .self_gaps import SIDE, ZERO, gap_along, nearest, signed_gap, vertex_of
from .self_pairs import StepPairs, module_of, near_pairs

potential, slope, bend = contact.potential, contact.slope, contact.bend


@wp.struct
class PairForces:
    """n, w, kAφ [J], kAφ′ [N] and kAφ″ [N/m] of each pair at some positions.

    On the CPU ``pressing`` lists the ``count`` (1,) pairs with a force, in order.
    """

    normal: wp.array(dtype=wp.vec3d)
    weights: wp.array(dtype=wp.vec4d)
    energy: wp.array(dtype=wp.float64)
    slope: wp.array(dtype=wp.float64)
    bend: wp.array(dtype=wp.float64)
    pressing: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)


@cache
def find_forces(dtype, bounded: bool):
    """Kernel over acting pairs: kAφ, kAφ′, kAφ″, w and n at x, or x + correction; φ = ½(r − d)² if ``bounded``."""
    vec3, _ = types(dtype)
    at, _exact = vertex_of(dtype)

    @wp.kernel(module=f"{module_of(dtype)}.{bounded}", enable_backward=False)
    def find_forces_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        step: StepPairs,
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        # out
        forces: PairForces,
    ):
        t = wp.tid()
        if t >= pairs.number[0]:
            return
        e = pairs.acting[t]
        forces.energy[e] = ZERO
        forces.slope[e] = ZERO
        forces.bend[e] = ZERO
        k = step.stiffness[e]
        r = wp.float64(pairs.distances[e])
        s = pairs.stencils[e]
        a = at(x, correction, s[0])
        b = at(x, correction, s[1])
        c = at(x, correction, s[2])
        d = at(x, correction, s[3])
        of_vertex = e < pairs.counts[0]
        if gap_along(of_vertex, step.normal[e], a, b, c, d) >= r:
            return
        w, y, inside = nearest(of_vertex, a, b, c, d)
        gap, n = signed_gap(y, step.normal[e], inside)
        if gap < r:
            forces.normal[e] = n
            forces.weights[e] = w
            if wp.static(bounded):
                forces.energy[e] = SIDE * k * (r - gap) * (r - gap)
                forces.slope[e] = k * (gap - r)
                forces.bend[e] = k
            else:
                forces.energy[e] = k * potential(gap, r)
                forces.slope[e] = k * slope(gap, r)
                forces.bend[e] = k * bend(gap, r)
            if forces.pressing:
                forces.pressing[wp.atomic_add(forces.count, 0, 1)] = e

    return find_forces_of_pairs


@cache
def add_forces(dtype):
    """Kernel over vertices: out += ∂U/∂x, in the order of the pairs."""
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def add_forces_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        forces: PairForces,
        # in and out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        total = wp.vec3d()
        for k in range(pairs.first[i], pairs.first[i + 1]):
            e = pairs.corners[k] // 4
            if forces.slope[e] != ZERO:
                total += forces.weights[e][pairs.corners[k] - 4 * e] * forces.slope[e] * forces.normal[e]
        out[i] = out[i] + vec3(dtype(total[0]), dtype(total[1]), dtype(total[2]))

    return add_forces_of_pairs


@cache
def sum_energies(dtype):
    """Kernel over vertices: sums of the energies [J] of the pairs whose first vertex it is."""

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def sum_energies_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        forces: PairForces,
        # out
        energies: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        total = ZERO
        for k in range(pairs.first[i], pairs.first[i + 1]):
            if pairs.corners[k] % 4 == 0:
                total += forces.energy[pairs.corners[k] // 4]
        energies[i] = total

    return sum_energies_of_pairs


@cache
def add_diagonal(dtype):
    """Kernel over vertices: adds Σ kAφ″ wᵢ²nnᵀ to the diagonal blocks of a Hessian, except those of pins."""
    _, mat33 = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def add_diagonal_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=dtype),
        diagonal: wp.array(dtype=wp.int32),
        # state in
        forces: PairForces,
        # in and out
        values: wp.array(dtype=mat33),
    ):
        i = wp.tid()
        if inverse_mass[i] == dtype(0.0):
            return
        total = wp.mat33d()
        for k in range(pairs.first[i], pairs.first[i + 1]):
            e = pairs.corners[k] // 4
            if forces.bend[e] != ZERO:
                w = forces.weights[e][pairs.corners[k] - 4 * e]
                total += forces.bend[e] * w * w * wp.outer(forces.normal[e], forces.normal[e])
        values[diagonal[i]] = values[diagonal[i]] + mat33(total)

    return add_diagonal_of_pairs


@cache
def add_products(dtype):
    """Kernel over vertices: q += Σ kAφ″ wᵢ n Σⱼ wⱼ nᵀpⱼ over the other vertices j of its pairs, in active copies."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def add_products_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=dtype),
        # state in
        forces: PairForces,
        p: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        # in and out
        q: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if inverse_mass[i] == dtype(0.0) or active[i // per_copy] == 0:
            return
        total = wp.vec3d()
        for k in range(pairs.first[i], pairs.first[i + 1]):
            e = pairs.corners[k] // 4
            if forces.bend[e] != ZERO:
                corner = pairs.corners[k] - 4 * e
                s = pairs.stencils[e]
                w = forces.weights[e]
                n = forces.normal[e]
                along = ZERO
                for j in range(4):
                    if j != corner and inverse_mass[s[j]] > dtype(0.0):
                        along += w[j] * wp.dot(n, exact(p[s[j]]))
                total += forces.bend[e] * w[corner] * along * n
        q[i] = q[i] + vec3(dtype(total[0]), dtype(total[1]), dtype(total[2]))

    return add_products_of_pairs
