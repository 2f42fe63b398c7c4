"""Factories of the kernels that sum energies, forces and Hessians of pairs: those of contact, and those of friction.

The vector between the two sides of a pair is y = Σ wᵢxᵢ, so vertex i gets wᵢ ∂U/∂y, and wᵢwⱼ ∂²U/∂y² joins vertices i and j. A
:class:`PairSource` computes these two. Kernels named *gather* have a thread per vertex, which takes its pairs in order. Those
named *scatter*, for the CPU, have one thread, which takes the pairs with a force in order and adds to the vertices of each.
They need no list of the pairs of a vertex, and products with the Hessian take each pair once. Both agree up to rounding.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from ..vectors import types
from .self_gaps import ZERO, vertex_of
from .self_pairs import near_pairs


@dataclass(frozen=True)
class PairSource:
    """How the forces of pairs follow from values that are stored for each, in float64.

    Attributes:
        name: Its name in reports.
        module: Name of the Warp module of its kernels, without the precision.
        data: Warp struct of arrays by pair, among them ``weights`` w, ``energy`` [J] and ``acting``, above 0 for pairs with a
            force; to be scattered also ``pressing``, the pairs with a force, and their ``count`` (1,).
        pair: Device function (data, e) → struct of the values of one pair; the other functions take it and not ``data``, of
            which a call would copy all pointers.
        force: (pair) → ∂U/∂y [N].
        curvature: (pair) → ∂²U/∂y² [N/m].
        part: (pair, wⱼ, pⱼ) → what a product with ∂²U/∂y² needs of wⱼpⱼ; it is linear.
        product: (pair, wᵢ, sum of parts) → wᵢ ∂²U/∂y² Σⱼ wⱼpⱼ.
    """

    name: str
    module: str
    data: Any
    pair: Callable
    force: Callable
    curvature: Callable
    part: Callable
    product: Callable

    def of(self, dtype):
        """Returns the name of the module that has the kernels that scatter, for a precision."""
        return f"{self.module}.{dtype.__name__}"


@cache
def gather_pair_forces(source: PairSource, dtype):
    """Kernel over vertices: out += ∂U/∂x."""
    vec3, _ = types(dtype)
    pair, force = source.pair, source.force

    @wp.kernel(module=f"{source.of(dtype)}.gather", enable_backward=False)
    def gather_forces_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        data: source.data,
        # in and out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        total = wp.vec3d()
        for k in range(pairs.first[i], pairs.first[i + 1]):
            e = pairs.corners[k] // 4
            if data.acting[e] > ZERO:
                total += data.weights[e][pairs.corners[k] - 4 * e] * force(pair(data, e))
        out[i] = out[i] + vec3(dtype(total[0]), dtype(total[1]), dtype(total[2]))

    return gather_forces_of_pairs


@cache
def scatter_pair_forces(source: PairSource, dtype):
    """Kernel of one thread: the sums of :func:`gather_pair_forces`."""
    vec3, _ = types(dtype)
    pair, force = source.pair, source.force

    @wp.kernel(module=source.of(dtype), enable_backward=False)
    def scatter_forces_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        data: source.data,
        # in and out
        out: wp.array(dtype=vec3),
    ):
        for t in range(data.count[0]):
            e = data.pressing[t]
            s = pairs.stencils[e]
            whole = force(pair(data, e))
            for i in range(4):
                own = data.weights[e][i] * whole
                out[s[i]] = out[s[i]] + vec3(dtype(own[0]), dtype(own[1]), dtype(own[2]))

    return scatter_forces_of_pairs


@cache
def gather_pair_energies(source: PairSource, dtype):
    """Kernel over vertices: adds the energies [J] of the pairs whose first vertex it is."""

    @wp.kernel(module=f"{source.of(dtype)}.gather", enable_backward=False)
    def gather_energies_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        data: source.data,
        # in and out
        energies: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        total = ZERO
        for k in range(pairs.first[i], pairs.first[i + 1]):
            e = pairs.corners[k] // 4
            if pairs.corners[k] == 4 * e and data.acting[e] > ZERO:
                total += data.energy[e]
        energies[i] = energies[i] + total

    return gather_energies_of_pairs


@cache
def scatter_pair_energies(source: PairSource, dtype):
    """Kernel of one thread: the sums of :func:`gather_pair_energies`."""

    @wp.kernel(module=source.of(dtype), enable_backward=False)
    def scatter_energies_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        # state in
        data: source.data,
        # in and out
        energies: wp.array(dtype=wp.float64),
    ):
        for t in range(data.count[0]):
            e = data.pressing[t]
            first = pairs.stencils[e][0]
            energies[first] = energies[first] + data.energy[e]

    return scatter_energies_of_pairs


@cache
def gather_pair_diagonal(source: PairSource, dtype):
    """Kernel over vertices: adds Σ wᵢ² ∂²U/∂y² to the diagonal blocks of a Hessian, except those of pins."""
    _, mat33 = types(dtype)
    pair, curvature = source.pair, source.curvature

    @wp.kernel(module=f"{source.of(dtype)}.gather", enable_backward=False)
    def gather_diagonal_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=dtype),
        diagonal: wp.array(dtype=wp.int32),
        # state in
        data: source.data,
        # in and out
        values: wp.array(dtype=mat33),
    ):
        i = wp.tid()
        if inverse_mass[i] == dtype(0.0):
            return
        total = wp.mat33d()
        for k in range(pairs.first[i], pairs.first[i + 1]):
            e = pairs.corners[k] // 4
            if data.acting[e] > ZERO:
                w = data.weights[e][pairs.corners[k] - 4 * e]
                total += w * w * curvature(pair(data, e))
        values[diagonal[i]] = values[diagonal[i]] + mat33(total)

    return gather_diagonal_of_pairs


@cache
def scatter_pair_diagonal(source: PairSource, dtype):
    """Kernel of one thread: the sums of :func:`gather_pair_diagonal`."""
    _, mat33 = types(dtype)
    pair, curvature = source.pair, source.curvature

    @wp.kernel(module=source.of(dtype), enable_backward=False)
    def scatter_diagonal_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=dtype),
        diagonal: wp.array(dtype=wp.int32),
        # state in
        data: source.data,
        # in and out
        values: wp.array(dtype=mat33),
    ):
        for t in range(data.count[0]):
            e = data.pressing[t]
            s = pairs.stencils[e]
            block = curvature(pair(data, e))
            for i in range(4):
                if inverse_mass[s[i]] != dtype(0.0):
                    w = data.weights[e][i]
                    values[diagonal[s[i]]] = values[diagonal[s[i]]] + mat33(w * w * block)

    return scatter_diagonal_of_pairs


@cache
def gather_pair_products(source: PairSource, dtype):
    """Kernel over vertices: q += wᵢ ∂²U/∂y² Σⱼ wⱼpⱼ over the other vertices j of its pairs, in active copies."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    pair, part, product = source.pair, source.part, source.product

    @wp.kernel(module=f"{source.of(dtype)}.gather", enable_backward=False)
    def gather_products_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=dtype),
        # state in
        data: source.data,
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
            if data.acting[e] > ZERO:
                corner = pairs.corners[k] - 4 * e
                s = pairs.stencils[e]
                w = data.weights[e]
                own = pair(data, e)
                others = part(own, ZERO, wp.vec3d())
                for j in range(4):
                    if j != corner and inverse_mass[s[j]] > dtype(0.0):
                        others += part(own, w[j], exact(p[s[j]]))
                total += product(own, w[corner], others)
        q[i] = q[i] + vec3(dtype(total[0]), dtype(total[1]), dtype(total[2]))

    return gather_products_of_pairs


@cache
def scatter_pair_products(source: PairSource, dtype):
    """Kernel of one thread: the sums of :func:`gather_pair_products`."""
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)
    pair, part, product = source.pair, source.part, source.product

    @wp.kernel(module=source.of(dtype), enable_backward=False)
    def scatter_products_of_pairs(
        # elements
        pairs: near_pairs(dtype),
        inverse_mass: wp.array(dtype=dtype),
        # state in
        data: source.data,
        p: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        # in and out
        q: wp.array(dtype=vec3),
    ):
        for t in range(data.count[0]):
            e = data.pressing[t]
            s = pairs.stencils[e]
            if active[s[0] // per_copy] != 0:
                w = data.weights[e]
                own = pair(data, e)
                whole = part(own, ZERO, wp.vec3d())
                for i in range(4):
                    if inverse_mass[s[i]] > dtype(0.0):
                        whole += part(own, w[i], exact(p[s[i]]))
                for i in range(4):
                    if inverse_mass[s[i]] > dtype(0.0):
                        more = product(own, w[i], whole - part(own, w[i], exact(p[s[i]])))
                        q[s[i]] = q[s[i]] + vec3(dtype(more[0]), dtype(more[1]), dtype(more[2]))

    return scatter_products_of_pairs
