"""Sums over the self-contact pairs with a force, by one thread of the CPU, which adds to the vertices of each pair.

They equal those of :mod:`..contact.self_contact` up to rounding. They are faster because few acting pairs have a force, and
because products with the Hessian take each pair once, not once for each of its vertices.
"""

from functools import cache

import warp as wp

from ..contact.self_contact import PairForces
from ..contact.self_gaps import vertex_of
from ..contact.self_pairs import module_of, near_pairs
from ..vectors import types


@cache
def scatter_forces(dtype):
    """Kernel of one thread: out += ∂U/∂x."""
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def scatter_forces_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        forces: PairForces,
        # in and out
        out: wp.array(dtype=vec3),
    ):
        for t in range(forces.count[0]):
            e = forces.pressing[t]
            s = pairs.stencils[e]
            force = forces.slope[e] * forces.normal[e]
            for i in range(4):
                own = forces.weights[e][i] * force
                out[s[i]] = out[s[i]] + vec3(dtype(own[0]), dtype(own[1]), dtype(own[2]))

    return scatter_forces_of_pairs


@cache
def scatter_energies(dtype):
    """Kernel of one thread: energies[first vertex] += the energy of each pair [J]."""

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def scatter_energies_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        forces: PairForces,
        # in and out
        energies: wp.array(dtype=wp.float64),
    ):
        for t in range(forces.count[0]):
            e = forces.pressing[t]
            first = pairs.stencils[e][0]
            energies[first] = energies[first] + forces.energy[e]

    return scatter_energies_of_pairs


@cache
def scatter_diagonal(dtype):
    """Kernel of one thread: adds kAφ″ wᵢ²nnᵀ to the diagonal blocks of a Hessian, except those of pins."""
    _, mat33 = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def scatter_diagonal_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=dtype),
        diagonal: wp.array(dtype=wp.int32),
        # state in
        forces: PairForces,
        # in and out
        values: wp.array(dtype=mat33),
    ):
        for t in range(forces.count[0]):
            e = forces.pressing[t]
            s = pairs.stencils[e]
            block = forces.bend[e] * wp.outer(forces.normal[e], forces.normal[e])
            for i in range(4):
                if inverse_mass[s[i]] != dtype(0.0):
                    w = forces.weights[e][i]
                    values[diagonal[s[i]]] = values[diagonal[s[i]]] + mat33(w * w * block)

    return scatter_diagonal_of_pairs


@cache
def scatter_products(dtype):
    """Kernel of one thread: q += kAφ″ wᵢ n Σⱼ wⱼ nᵀpⱼ over the other vertices j of pairs, in active copies."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def scatter_products_of_pairs(
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
        for t in range(forces.count[0]):
            e = forces.pressing[t]
            s = pairs.stencils[e]
            if active[s[0] // per_copy] != 0:
                n = forces.normal[e]
                w = forces.weights[e]
                along = wp.vec4d()
                for i in range(4):
                    if inverse_mass[s[i]] > dtype(0.0):
                        along[i] = w[i] * wp.dot(n, exact(p[s[i]]))
                total = along[0] + along[1] + along[2] + along[3]
                for i in range(4):
                    if inverse_mass[s[i]] > dtype(0.0):
                        own = forces.bend[e] * w[i] * (total - along[i]) * n
                        q[s[i]] = q[s[i]] + vec3(dtype(own[0]), dtype(own[1]), dtype(own[2]))

    return scatter_products_of_pairs
