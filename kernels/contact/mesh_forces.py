"""Factories of the kernels that sum forces between cloth and mesh colliders, for records."""

import warp as wp

from ..pairs import Pairs
from .obstacles import copy_of, obstacle_of
from .pair_sums import PairForces
from .self_gaps import ZERO


@wp.kernel(module="warpcloth.mesh_forces", enable_backward=False)
def keep_forces(
    # elements
    pairs: Pairs,
    parts: wp.array(dtype=wp.vec4i),
    colliders: wp.array(dtype=wp.int32),
    # parameters
    kept: int,
    # in and out
    forces: PairForces,
):
    """Kernel over contacts: forces and energies of contacts with other colliders than ``kept`` become 0.

    ``colliders`` is the collider of each obstacle of a copy; −1 keeps contact of cloth with cloth.
    """
    e = wp.tid()
    if e >= pairs.number[0]:
        return
    own = obstacle_of(pairs.layout, parts[e])
    if own >= 0:
        own = colliders[own]
    if own != kept:
        forces.energy[e] = ZERO
        forces.force[e] = wp.vec3d()


@wp.kernel(module="warpcloth.mesh_forces", enable_backward=False)
def work_of_meshes(
    # elements
    pairs: Pairs,
    parts: wp.array(dtype=wp.vec4i),
    colliders: wp.array(dtype=wp.int32),
    # state in
    travel: wp.array(dtype=wp.vec3d),
    forces: PairForces,
    # in and out
    out: wp.array2d(dtype=wp.float64),
):
    """Kernel of one thread: out (B, C) += Σ ∂U/∂y·travel, the work of mesh colliders on the cloth in a step [J]."""
    for e in range(pairs.number[0]):
        other = obstacle_of(pairs.layout, parts[e])
        if other >= 0:
            c = colliders[other]
            copy = copy_of(pairs.layout, parts[e][0])
            out[copy, c] = out[copy, c] + wp.dot(forces.force[e], travel[e])
