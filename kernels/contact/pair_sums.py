"""Factories of the kernels that sum energies, forces and Hessians of pairs: those of contact, and those of friction.

The energy of a pair is a function of y = Σ wᵢxᵢ: vertex i gets wᵢ ∂U/∂y, and wᵢwⱼ ∂²U/∂y² joins vertices i and j. Kernels
gather, with a thread for each vertex, in order and in float64. For the CPU they scatter: one thread takes the pairs with a
force in order, so that no list of the pairs of a vertex is needed, and products find Σ wⱼpⱼ of each pair once. Both agree up to
rounding.
"""

from functools import cache

import warp as wp

from ..pairs import Pairs, pair_blocks, turned_pull
from ..term import PairTerm
from ..vectors import types
from .self_gaps import ZERO


@wp.struct
class PairForces:
    """Values of each pair at some positions, in float64: w, U [J], ∂U/∂y [N] and ∂²U/∂y² [N/m].

    ∂²U/∂y² is the ``definite`` part, positive semi-definite, and the ``rest``, of which the matrix takes the factor that a
    :class:`..term.HessianPolicy` gives the negative part; ``block`` is their sum. For kernels that scatter, ``pressing`` lists
    the ``count`` [0] pairs with a force, in order, and ``joining`` the ``count`` [1] ones that join vertices: those with a mesh
    may have only one.

    If w changes with the positions, the rest has more entries, see :func:`..pairs.turned_pull`: of the ``turns`` t, two numbers
    [1/m] for each vertex, two vectors e, the ``ways``, the ``normal`` n of the data, and ``twist``, α [N] and β [N·m].
    ``twisted`` is the share of ``twist`` that the policy gives. Without, these arrays are None.
    """

    weights: wp.array(dtype=wp.vec4d)
    energy: wp.array(dtype=wp.float64)
    force: wp.array(dtype=wp.vec3d)
    definite: wp.array(dtype=wp.mat33d)
    rest: wp.array(dtype=wp.mat33d)
    block: wp.array(dtype=wp.mat33d)
    turns: wp.array(dtype=wp.types.matrix((4, 2), wp.float64))
    ways: wp.array(dtype=wp.types.matrix((2, 3), wp.float64))
    normal: wp.array(dtype=wp.vec3d)
    twist: wp.array(dtype=wp.vec2d)
    twisted: wp.array(dtype=wp.vec2d)
    pressing: wp.array(dtype=wp.int32)
    joining: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)


@wp.func
def is_single(s: wp.vec4i):
    """Whether a pair has only one vertex of the cloth, which is the first; others are obstacles, with w = 0."""
    return s[1] == s[0] and s[2] == s[0] and s[3] == s[0]


@wp.func
def note_pressing(forces: PairForces, e: int, s: wp.vec4i):
    """Lists a pair with a force, if kernels scatter."""
    if forces.pressing:
        forces.pressing[wp.atomic_add(forces.count, 0, 1)] = e
        if not is_single(s):
            forces.joining[wp.atomic_add(forces.count, 1, 1)] = e


@wp.struct
class PairRow:
    """The constraint rows C of a pair: w, ∂C/∂y of both rows, 0 if inactive, C, and the stiffness k [N/m].

    ``size`` is the length of what cancels in y, without the correction [m]. ``fixed`` is the part of the force of the first row
    that does not follow from C [N]. A row without stiffness has that alone.
    """

    weights: wp.vec4d
    first: wp.vec3d
    second: wp.vec3d
    C: wp.vec2d
    stiffness: wp.float64
    size: wp.float64
    fixed: wp.float64


@cache
def taken_by(scatters: bool):
    """Device functions (pairs, forces, thread) → its range, and (pairs, forces, k) → pair e and the range of its corners."""

    @wp.func
    def range_of(pairs: Pairs, forces: PairForces, thread: int):
        if wp.static(scatters):
            return wp.int32(0), forces.count[0]
        else:
            return pairs.first[thread], pairs.first[thread + 1]

    @wp.func
    def corners_at(pairs: Pairs, forces: PairForces, k: int):
        if wp.static(scatters):
            return forces.pressing[k], wp.int32(0), wp.int32(4)
        else:
            e = pairs.corners[k] // 4
            i = pairs.corners[k] - 4 * e
            return e, i, i + 1

    return range_of, corners_at


@cache
def pair_forces(term: PairTerm, dtype, scatters: bool):
    """Kernel over threads: out += ∂U/∂x."""
    vec3, _ = types(dtype)
    range_of, corners_at = taken_by(scatters)

    @wp.kernel(module=term.of(dtype, scatters), enable_backward=False)
    def add_forces_of_pairs(
        # elements
        pairs: Pairs,
        # state in
        forces: PairForces,
        # in and out
        out: wp.array(dtype=vec3),
    ):
        v = wp.tid()
        total = wp.vec3d()
        first, end = range_of(pairs, forces, v)
        for k in range(first, end):
            e, corner, end_corner = corners_at(pairs, forces, k)
            s = pairs.stencils[e]
            w = forces.weights[e]
            whole = forces.force[e]
            for i in range(corner, end_corner):
                force = w[i] * whole
                if wp.static(scatters):
                    out[s[i]] = out[s[i]] + vec3(force)
                total += force
        if wp.static(not scatters):
            out[v] = out[v] + vec3(total)

    return add_forces_of_pairs


@cache
def pair_energies(term: PairTerm, dtype, scatters: bool):
    """Kernel over threads: adds the energies [J] of the pairs to those of their first vertices."""
    range_of, corners_at = taken_by(scatters)

    @wp.kernel(module=term.of(dtype, scatters), enable_backward=False)
    def add_energies_of_pairs(
        # elements
        pairs: Pairs,
        # state in
        forces: PairForces,
        # in and out
        energies: wp.array(dtype=wp.float64),
    ):
        first, end = range_of(pairs, forces, wp.tid())
        for k in range(first, end):
            e, corner, _end = corners_at(pairs, forces, k)
            if corner == 0:
                v = pairs.stencils[e][0]
                energies[v] = energies[v] + forces.energy[e]

    return add_energies_of_pairs


@cache
def set_pair_blocks(term: PairTerm, dtype, scatters: bool):
    """Kernel over pairs: ``block`` with the ``policy`` (B,), and the :func:`..pairs.pair_blocks` if products are gathered."""
    vec3, mat33 = types(dtype)
    vec4, vec2, mat42, mat23 = (
        wp.types.vector(4, dtype),
        wp.types.vector(2, dtype),
        wp.types.matrix((4, 2), dtype),
        wp.types.matrix((2, 3), dtype),
    )

    @wp.kernel(module=term.of(dtype, scatters), enable_backward=False)
    def set_blocks_of_pairs(
        # elements
        pairs: Pairs,
        inverse_mass: wp.array(dtype=dtype),
        # parameters
        policy: wp.array(dtype=wp.float64),
        # in and out
        forces: PairForces,
        # out
        out: pair_blocks(dtype),
    ):
        for e in range(wp.tid(), pairs.number[0], pairs.threads):
            s = pairs.stencils[e]
            share = wp.max(policy[s[0] // pairs.layout.per_copy], ZERO)
            block = forces.definite[e] + share * forces.rest[e]
            forces.block[e] = block
            if forces.turns:
                forces.twisted[e] = share * forces.twist[e]
            if wp.static(not scatters):
                w = forces.weights[e]
                for i in range(4):
                    if inverse_mass[s[i]] == dtype(0.0):
                        w[i] = ZERO
                out.weights[e] = vec4(w)
                out.blocks[e] = mat33(block)
                if forces.turns:
                    turns = forces.turns[e]
                    for i in range(4):
                        if inverse_mass[s[i]] == dtype(0.0):
                            turns[i] = wp.vec2d()
                    out.turns[e] = mat42(turns)
                    out.ways[e] = mat23(forces.ways[e])
                    out.normal[e] = vec3(forces.normal[e])
                    out.twisted[e] = vec2(forces.twisted[e])

    return set_blocks_of_pairs


@cache
def pair_diagonal(term: PairTerm, dtype, scatters: bool):
    """Kernel over threads: adds ∂²U/∂xᵢ² = Σ wᵢ² ∂²U/∂y², with its turns, to the diagonal of a Hessian, except at pins."""
    _, mat33 = types(dtype)
    range_of, corners_at = taken_by(scatters)

    @wp.kernel(module=term.of(dtype, scatters), enable_backward=False)
    def add_diagonal_of_pairs(
        # elements
        pairs: Pairs,
        inverse_mass: wp.array(dtype=dtype),
        diagonal: wp.array(dtype=wp.int32),
        # state in
        forces: PairForces,
        # in and out
        values: wp.array(dtype=mat33),
    ):
        v = wp.tid()
        total = wp.mat33d()
        first, end = range_of(pairs, forces, v)
        for k in range(first, end):
            e, corner, end_corner = corners_at(pairs, forces, k)
            s = pairs.stencils[e]
            w = forces.weights[e]
            block = forces.block[e]
            for i in range(corner, end_corner):
                if inverse_mass[s[i]] > dtype(0.0):
                    own = w[i] * w[i] * block
                    if forces.turns:
                        t = forces.turns[e][i]
                        n = forces.normal[e]
                        twisted = forces.twisted[e]
                        mixed = (w[i] * twisted[0]) * wp.outer(wp.transpose(forces.ways[e]) * t, n)
                        own += mixed + wp.transpose(mixed) + (twisted[1] * wp.dot(t, t)) * wp.outer(n, n)
                    if wp.static(scatters):
                        values[diagonal[s[i]]] = values[diagonal[s[i]]] + mat33(own)
                    total += own
        if wp.static(not scatters):
            values[diagonal[v]] = values[diagonal[v]] + mat33(total)

    return add_diagonal_of_pairs


@cache
def pair_products(term: PairTerm, dtype, scatters: bool):
    """Kernel over threads: q += wᵢ ∂²U/∂y² Σⱼ wⱼpⱼ over the other vertices j of each pair, with its turns, in active copies."""
    vec3, _ = types(dtype)
    range_of, corners_at = taken_by(scatters)

    @wp.kernel(module=term.of(dtype, scatters), enable_backward=False)
    def add_products_of_pairs(
        # elements
        pairs: Pairs,
        inverse_mass: wp.array(dtype=dtype),
        # state in
        forces: PairForces,
        p: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
        # in and out
        q: wp.array(dtype=vec3),
    ):
        v = wp.tid()
        total = wp.vec3d()
        first, end = range_of(pairs, forces, v)
        if wp.static(scatters):
            end = forces.count[1]
        for k in range(first, end):
            e, corner, end_corner = corners_at(pairs, forces, k)
            if wp.static(scatters):
                e = forces.joining[k]
            s = pairs.stencils[e]
            if active[s[0] // pairs.layout.per_copy] != 0:
                w = forces.weights[e]
                block = forces.block[e]
                y = wp.vec3d()
                z = wp.vec2d()
                for i in range(4):
                    if inverse_mass[s[i]] > dtype(0.0):
                        y += w[i] * wp.vec3d(p[s[i]])
                        if forces.turns:
                            z += wp.dot(forces.normal[e], wp.vec3d(p[s[i]])) * forces.turns[e][i]
                for i in range(corner, end_corner):
                    if inverse_mass[s[i]] > dtype(0.0):
                        others = y - w[i] * wp.vec3d(p[s[i]])
                        pull = w[i] * (block * others)
                        if forces.turns:
                            t = forces.turns[e][i]
                            n = forces.normal[e]
                            turned = z - wp.dot(n, wp.vec3d(p[s[i]])) * t
                            pull += turned_pull(w[i], t, forces.ways[e], n, forces.twisted[e], others, turned)
                        if wp.static(scatters):
                            q[s[i]] = q[s[i]] + vec3(pull)
                        total += pull
        if wp.static(not scatters):
            q[v] = q[v] + vec3(total)

    return add_products_of_pairs
