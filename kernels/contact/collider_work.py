"""Kernels of the work of colliders and of their filter [J]."""

from functools import cache

import warp as wp

from ..vectors import types
from ..work import wide_dot
from .colliders import filters, pose_types, step_poses, to_local, to_space

UNCUT, NOW = wp.constant(0), wp.constant(2)  # the filter shortened no move of a vertex, or one in this step (1: in the last)


@cache
def collider_pulls(dtype):
    """Struct of ∂U/∂x of contact and friction with a collider, and of friction alone, or None."""
    vec3, _ = types(dtype)

    @wp.struct
    class Pulls:
        all: wp.array(dtype=vec3)
        friction: wp.array(dtype=vec3)

    return Pulls


@cache
def add_collider_work(dtype):
    """Kernel over vertices, after a step: work of a collider −= ∇U·δ, work against friction += ∇H·(Δx − δ).

    ∇U is that of contact and friction, ∇H that of friction alone, where the step evaluates its forces; δ is the displacement of
    the collider's material there. With ``before``, the trapezoidal rule averages the products with those at the start of the
    step. If the gap changes by more than the contact ``distance``, only the part of Δx that δ shares does work. If the filter
    shortened the move, Δx ends at ``uncut``, only ``now`` counts in this step and the next, and of_filter −= ∇U·(Δx − δ).
    """
    vec3, _ = types(dtype)
    product, (pose_type, _anchor) = wide_dot(dtype), pose_types(dtype)

    @wp.func
    def move_of(poses: step_poses(dtype), pose: pose_type, copy: int, collider: int, x: vec3):
        X = to_local(pose, x)
        return to_space(poses.after[copy, collider], X) - to_space(poses.before[copy, collider], X)

    @wp.func
    def work_on(pulls: collider_pulls(dtype), i: int, move: vec3, moved: vec3, distance: dtype):
        contact = pulls.all[i]
        rubbed = wp.float64(0.0)
        if pulls.friction.shape[0] > 0:
            contact = contact - pulls.friction[i]
            rubbed = product(pulls.friction[i], move)
        work = product(contact, move)
        shared = product(contact, moved)
        if wp.abs(work - shared) > wp.float64(wp.length(contact) * distance):
            work = wp.clamp(shared, wp.min(work, wp.float64(0.0)), wp.max(work, wp.float64(0.0)))
        return work + rubbed

    @wp.kernel(module=f"warpcloth.work.colliders.{dtype.__name__}", enable_backward=False)
    def add(
        # elements
        colliders: filters(dtype),
        # state in
        x_before: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        uncut: wp.array(dtype=vec3),
        cuts: wp.array(dtype=wp.int32),
        now: collider_pulls(dtype),
        # parameters
        collider: int,
        distance: dtype,
        # in and out
        before: collider_pulls(dtype),
        of_collider: wp.array(dtype=wp.float64),
        against_friction: wp.array(dtype=wp.float64),
        of_filter: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        copy = i // colliders.per_copy
        moved = uncut[i] - x_before[i]
        move = move_of(colliders.poses, colliders.poses.at[copy, collider], copy, collider, x[i])
        work = work_on(now, i, move, moved, distance)
        rubbed = wp.float64(0.0)
        if now.friction.shape[0] > 0:
            rubbed = product(now.friction[i], moved - move)
        if cuts[i] == NOW:
            of_filter[i] = of_filter[i] + work + rubbed - product(now.all[i], moved)
        if before.all.shape[0] > 0:
            if cuts[i] == UNCUT:
                move = move_of(colliders.poses, colliders.poses.before[copy, collider], copy, collider, x_before[i])
                work = wp.float64(0.5) * (work + work_on(before, i, move, moved, distance))
                if now.friction.shape[0] > 0:
                    rubbed = wp.float64(0.5) * (rubbed + product(before.friction[i], moved - move))
            before.all[i] = now.all[i]
            if now.friction.shape[0] > 0:
                before.friction[i] = now.friction[i]
        of_collider[i] = of_collider[i] - work
        against_friction[i] = against_friction[i] + rubbed

    return add


@cache
def add_filter_work(dtype):
    """Kernel over vertices, after a step: work of the filter += ½m(v² − v₋²) − (m g + f)·(x − x₋), x₋ and v₋ without it.

    It sets ``uncut`` to x₋, updates ``cuts``, and clears the notes.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module=f"warpcloth.work.colliders.{dtype.__name__}", enable_backward=False)
    def add(
        # elements
        mass: wp.array(dtype=dtype),
        gravity: wp.array(dtype=vec3),
        per_copy: int,
        # state in
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        force: wp.array(dtype=vec3),
        # in and out
        pushed: wp.array(dtype=wp.vec3d),
        kicked: wp.array(dtype=wp.vec3d),
        uncut: wp.array(dtype=vec3),
        cuts: wp.array(dtype=wp.int32),
        of_filter: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        push = pushed[i]
        kick = kicked[i]
        uncut[i] = x[i]
        cuts[i] = cuts[i] // 2
        if wp.dot(push, push) + wp.dot(kick, kick) > wp.float64(0.0):
            uncut[i] = x[i] - vec3(push)
            cuts[i] = NOW
            m = wp.float64(mass[i])
            pull = m * wp.vec3d(gravity[i // per_copy])
            if force.shape[0] > 0:
                pull += wp.vec3d(force[i])
            mean = wp.vec3d(v[i]) - wp.float64(0.5) * kick
            of_filter[i] = of_filter[i] + m * wp.dot(mean, kick) - wp.dot(pull, push)
            pushed[i] = wp.vec3d()
            kicked[i] = wp.vec3d()

    return add


@wp.kernel(module="warpcloth.work.colliders", enable_backward=False)
def add_stored(
    # elements
    stencil: wp.array2d(dtype=wp.int32),
    # state in
    energies: wp.array(dtype=wp.float64),
    cuts: wp.array(dtype=wp.int32),
    # in and out
    before: wp.array(dtype=wp.float64),
    of_filter: wp.array(dtype=wp.float64),
):
    """Kernel over elements of contact: work of the filter += the change of their energy in a step that it shortened."""
    e = wp.tid()
    cut = wp.bool(False)
    for k in range(stencil.shape[1]):
        if cuts[stencil[e, k]] == NOW:
            cut = True
    if cut:
        wp.atomic_add(of_filter, stencil[e, 0], energies[e] - before[e])
    before[e] = energies[e]


@cache
def limit_pulls(dtype):
    """Kernel over vertices: scales ∇U by ‖f‖/‖∇U‖ where that is below ½, f being the contact force of the step.

    Deep inside a collider, ∇U is far larger than f if the step has not converged.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module=f"warpcloth.work.colliders.{dtype.__name__}", enable_backward=False)
    def limit(
        # state in
        given: wp.array(dtype=vec3),
        taken: wp.array(dtype=vec3),
        # in and out
        pulls: collider_pulls(dtype),
    ):
        i = wp.tid()
        most = wp.length(given[i])
        size = wp.length(taken[i])
        if size > dtype(2.0) * most:
            pulls.all[i] = (most / size) * pulls.all[i]
            if pulls.friction.shape[0] > 0:
                pulls.friction[i] = (most / size) * pulls.friction[i]

    return limit
