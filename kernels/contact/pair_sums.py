"""Factories of the kernels that sum energies, forces and Hessians of pairs: those of contact, and those of friction.

The energy of a pair is a function of y = Σ wᵢxᵢ, so vertex i gets wᵢ ∂U/∂y, and wᵢwⱼ ∂²U/∂y² joins vertices i and j. A
:class:`PairTerm` finds these in :class:`PairForces`. Kernels named *gather* have a thread per vertex, which takes its pairs in
order. Those named *scatter*, for the CPU, have one thread, which takes the pairs with a force in order and adds to the vertices
of each. They need no list of the pairs of a vertex, and products with the Hessian take each pair once. Both agree up to
rounding.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from ..vectors import types
from .self_gaps import ZERO, vertex_of
from .self_pairs import near_pairs


@wp.struct
class PairForces:
    """Values of each pair at some positions, in float64: w, U [J] and ∂U/∂y [N].

    ∂²U/∂y² = bend[0]·along alongᵀ + bend[1]·across acrossᵀ [N/m], where ``across`` is for terms of rank 2. Both ``bend`` are 0
    for pairs without a force. ``pressing`` lists the ``count`` (1,) pairs with a force, in order, for kernels that scatter.
    """

    weights: wp.array(dtype=wp.vec4d)
    energy: wp.array(dtype=wp.float64)
    force: wp.array(dtype=wp.vec3d)
    bend: wp.array(dtype=wp.vec2d)
    along: wp.array(dtype=wp.vec3d)
    across: wp.array(dtype=wp.vec3d)
    pressing: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)


@dataclass(frozen=True)
class PairTerm:
    """The record of an energy of pairs.

    Attributes:
        name: Its name in reports.
        module: Name of the Warp module of its kernels, without the precision.
        rank: The rank of its ∂²U/∂y², 1 or 2.
        data: Warp struct of what the step holds of each pair, among it its normal n.
        near: Function of a precision, which makes the device function (pairs, data, turn, e, x, d, always) → whether pair e may
            have a force at x + d, v, n and w, for a sweep; n is a unit vector. v is the y of friction, and the gap along n of
            contact. Pair e is number ``turn`` of those that act. With ``always``, w and v are found in any case.
        push: Device function (pairs, data, e, v, n, D, least, h, hard) → λ = −h²∂U/∂y at v + Dλ [kg·m], v without the force of
            the pair. D is Σ wᵢ²/mᵢ along n, and ``least`` its bound for ``hard`` pairs, see :mod:`.pair_sweeps`.
        row: Function of a precision, which makes the device function (pairs, data, e, x, d, λ of its rows) → :class:`PairRow`.
        isotropic: Whether D is that of a vertex without locked axes, because ``push`` needs one D for all directions.
    """

    name: str
    module: str
    rank: int
    data: Any
    near: Callable
    push: Callable
    row: Callable
    isotropic: bool

    def of(self, dtype):
        """Returns the name of the module that has the kernels that scatter, for a precision."""
        return f"{self.module}.{dtype.__name__}"


@wp.struct
class PairRow:
    """The constraint rows C of a pair at some positions: w, ∂C/∂y of both rows, 0 if inactive, C, λ, and the stiffness k [N/m].

    ``size`` is the length of what cancels in y, without the correction [m].
    """

    weights: wp.vec4d
    first: wp.vec3d
    second: wp.vec3d
    C: wp.vec2d
    held: wp.vec2d
    stiffness: wp.float64
    size: wp.float64


@wp.func
def presses(forces: PairForces, e: int):
    """Whether a pair has a force."""
    return wp.max(forces.bend[e]) > ZERO


@cache
def gather_pair_forces(term: PairTerm, dtype):
    """Kernel over vertices: out += ∂U/∂x."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{term.of(dtype)}.gather", enable_backward=False)
    def gather_forces_of_pairs(
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
            if presses(forces, e):
                total += forces.weights[e][pairs.corners[k] - 4 * e] * forces.force[e]
        out[i] = out[i] + vec3(dtype(total[0]), dtype(total[1]), dtype(total[2]))

    return gather_forces_of_pairs


@cache
def scatter_pair_forces(term: PairTerm, dtype):
    """Kernel of one thread: the sums of :func:`gather_pair_forces`."""
    vec3, _ = types(dtype)

    @wp.kernel(module=term.of(dtype), enable_backward=False)
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
            for i in range(4):
                own = forces.weights[e][i] * forces.force[e]
                out[s[i]] = out[s[i]] + vec3(dtype(own[0]), dtype(own[1]), dtype(own[2]))

    return scatter_forces_of_pairs


@cache
def gather_pair_energies(term: PairTerm, dtype):
    """Kernel over vertices: adds the energies [J] of the pairs whose first vertex it is."""

    @wp.kernel(module=f"{term.of(dtype)}.gather", enable_backward=False)
    def gather_energies_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        forces: PairForces,
        # in and out
        energies: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        total = ZERO
        for k in range(pairs.first[i], pairs.first[i + 1]):
            e = pairs.corners[k] // 4
            if pairs.corners[k] == 4 * e and presses(forces, e):
                total += forces.energy[e]
        energies[i] = energies[i] + total

    return gather_energies_of_pairs


@cache
def scatter_pair_energies(term: PairTerm, dtype):
    """Kernel of one thread: the sums of :func:`gather_pair_energies`."""

    @wp.kernel(module=term.of(dtype), enable_backward=False)
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
def curvature_of(rank: int):
    """Device functions (forces, e) → ∂²U/∂y², (forces, e, p) → c, the components of p along its directions, and (forces, e, c)
    → ∂²U/∂y² p."""

    @wp.func
    def curvature(forces: PairForces, e: int):
        block = forces.bend[e][0] * wp.outer(forces.along[e], forces.along[e])
        if wp.static(rank == 2):
            block += forces.bend[e][1] * wp.outer(forces.across[e], forces.across[e])
        return block

    @wp.func
    def components(forces: PairForces, e: int, p: wp.vec3d):
        found = wp.vec2d(wp.dot(forces.along[e], p), ZERO)
        if wp.static(rank == 2):
            found[1] = wp.dot(forces.across[e], p)
        return found

    @wp.func
    def product(forces: PairForces, e: int, c: wp.vec2d):
        pull = forces.bend[e][0] * c[0] * forces.along[e]
        if wp.static(rank == 2):
            pull += forces.bend[e][1] * c[1] * forces.across[e]
        return pull

    return curvature, components, product


@cache
def gather_pair_diagonal(term: PairTerm, dtype):
    """Kernel over vertices: adds Σ wᵢ² ∂²U/∂y² to the diagonal blocks of a Hessian, except those of pins."""
    _, mat33 = types(dtype)
    curvature, _components, _product = curvature_of(term.rank)

    @wp.kernel(module=f"{term.of(dtype)}.gather", enable_backward=False)
    def gather_diagonal_of_pairs(
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
            if presses(forces, e):
                w = forces.weights[e][pairs.corners[k] - 4 * e]
                total += w * w * curvature(forces, e)
        values[diagonal[i]] = values[diagonal[i]] + mat33(total)

    return gather_diagonal_of_pairs


@cache
def scatter_pair_diagonal(term: PairTerm, dtype):
    """Kernel of one thread: the sums of :func:`gather_pair_diagonal`."""
    _, mat33 = types(dtype)
    curvature, _components, _product = curvature_of(term.rank)

    @wp.kernel(module=term.of(dtype), enable_backward=False)
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
            block = curvature(forces, e)
            for i in range(4):
                if inverse_mass[s[i]] != dtype(0.0):
                    w = forces.weights[e][i]
                    values[diagonal[s[i]]] = values[diagonal[s[i]]] + mat33(w * w * block)

    return scatter_diagonal_of_pairs


@cache
def gather_pair_products(term: PairTerm, dtype):
    """Kernel over vertices: q += wᵢ ∂²U/∂y² Σⱼ wⱼpⱼ over the other vertices j of its pairs, in active copies."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    _curvature, components, product = curvature_of(term.rank)

    @wp.kernel(module=f"{term.of(dtype)}.gather", enable_backward=False)
    def gather_products_of_pairs(
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
            if presses(forces, e):
                corner = pairs.corners[k] - 4 * e
                s = pairs.stencils[e]
                w = forces.weights[e]
                others = wp.vec2d()
                for j in range(4):
                    if j != corner and inverse_mass[s[j]] > dtype(0.0):
                        others += w[j] * components(forces, e, exact(p[s[j]]))
                total += w[corner] * product(forces, e, others)
        q[i] = q[i] + vec3(dtype(total[0]), dtype(total[1]), dtype(total[2]))

    return gather_products_of_pairs


@cache
def scatter_pair_products(term: PairTerm, dtype):
    """Kernel of one thread: the sums of :func:`gather_pair_products`."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    _curvature, components, product = curvature_of(term.rank)

    @wp.kernel(module=term.of(dtype), enable_backward=False)
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
                w = forces.weights[e]
                whole = wp.vec2d()
                for i in range(4):
                    if inverse_mass[s[i]] > dtype(0.0):
                        whole += w[i] * components(forces, e, exact(p[s[i]]))
                for i in range(4):
                    if inverse_mass[s[i]] > dtype(0.0):
                        more = w[i] * product(forces, e, whole - w[i] * components(forces, e, exact(p[s[i]])))
                        q[s[i]] = q[s[i]] + vec3(dtype(more[0]), dtype(more[1]), dtype(more[2]))

    return scatter_products_of_pairs
