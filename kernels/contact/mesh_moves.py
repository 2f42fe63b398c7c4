"""Factories of the kernels that move colliders in a step and carry near cloth along, so that it does not get in their way.

A vertex listed with a mesh makes the move of the nearest point there, one that a shape would meet that of the shape, and one
listed with such cloth the move of that. Pairs that would still approach are pushed apart, by :func:`.self_filter.push_pairs`.
Then continuous collision detection says how far all of a copy may move together. If that is not the whole way, pairs are listed
anew, and the rest follows.
"""

from functools import cache

import warp as wp

from ..pairs import Pairs
from ..vectors import types
from .colliders import filters, gap_of, to_local, to_space
from .obstacles import has_obstacle
from .self_gaps import ONE, ZERO
from .self_pairs import StepPairs

PARTS = wp.constant(wp.float64(2.0**20))  # of the contact distance and the skin, in which gaps are compared
SMALL = wp.constant(wp.float64(1e-9))  # a weight, so that their sum is not 0


@cache
def aim_obstacles(dtype):
    """Kernel over obstacles: their moves p to ``goal``. Those that appear or vanish go there at once."""
    vec3, _ = types(dtype)

    @wp.kernel(module="warpcloth.obstacles." + dtype.__name__, enable_backward=False)
    def aim_each_obstacle(
        # state in
        goal: wp.array(dtype=vec3),
        # in and out
        x: wp.array(dtype=vec3),
        # out
        p: wp.array(dtype=vec3),
    ):
        t = wp.tid()
        move = goal[t] - x[t]
        if not wp.isfinite(wp.length_sq(move)):
            x[t] = goal[t]
            move = vec3()
        p[t] = move

    return aim_each_obstacle


@cache
def find_carriers(dtype):
    """Kernel over pairs: the key of the pair that carries each vertex of the cloth, with a mesh or with cloth that is carried.

    Pairs of the vertex itself with a triangle come first, as their nearest point moves as it should where the mesh turns, then
    those with the smallest gap.
    """

    @wp.kernel(module="warpcloth.obstacles." + dtype.__name__, enable_backward=False)
    def find_each_carrier(
        # elements
        pairs: Pairs,
        # state in
        step: StepPairs,
        carried: wp.array(dtype=wp.int64),
        # parameters
        of_meshes: bool,
        max_distance: wp.float64,
        # out
        keys: wp.array(dtype=wp.int64),
        changed: wp.array(dtype=wp.int32),
    ):
        e = wp.tid()
        if e >= wp.min(pairs.counts[0] + pairs.counts[1], pairs.stencils.shape[0]):
            return
        s = pairs.stencils[e]
        if has_obstacle(pairs.layout, s) != of_meshes:
            return
        near = wp.clamp(ONE - step.gap[e] / max_distance, ZERO, ONE)
        sides = wp.where(e < pairs.counts[0], 1, 2)
        for i in range(4):
            order = wp.int64(PARTS * wp.where(i < 2 - sides, ONE + near, near))
            key = order * wp.int64(2147483648) + wp.int64(e) + wp.int64(1)
            if of_meshes:
                if s[i] < pairs.layout.cloth:
                    wp.atomic_max(keys, s[i], key)
            else:
                by = wp.bool(False)
                for j in range(4):
                    if (i < sides) != (j < sides) and carried[s[j]] > wp.int64(0):
                        by = True
                if by and carried[s[i]] == wp.int64(0):
                    wp.atomic_max(keys, s[i], key)
                    changed[0] = 1

    return find_each_carrier


@cache
def carry_with_shapes(dtype, solids):
    """Kernel over vertices of the cloth: p, the move of a shape to ``at`` that is then nearer than ``distance``; its key is 1.

    Pins have none. ``some`` is 1 if a vertex moves.
    """
    vec3, _ = types(dtype)
    gap = gap_of(dtype, solids)

    @wp.kernel(module="unique", enable_backward=False)
    def carry_each_vertex(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        colliders: filters(dtype),
        # state in
        x: wp.array(dtype=vec3),
        # parameters
        distance: dtype,
        # out
        p: wp.array(dtype=vec3),
        keys: wp.array(dtype=wp.int64),
        some: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        if inverse_mass[i] == dtype(0.0):
            return
        copy = i // colliders.per_copy
        nearest = distance
        for c in range(colliders.shape.radius.shape[0]):
            now = colliders.poses.at[copy, c]
            d, _n = gap(colliders.shape, c, to_local(now, x[i]))
            if d < nearest:
                nearest = d
                p[i] = to_space(now, to_local(colliders.poses.before[copy, c], x[i])) - x[i]
                keys[i] = wp.int64(1)
        if wp.length_sq(p[i]) > dtype(0.0):
            some[0] = 1

    return carry_each_vertex


@cache
def carry_vertices(dtype):
    """Kernel over free vertices of the cloth with a new key: p, the move of what carries them on the other side of its pair."""
    vec3, _ = types(dtype)

    @wp.kernel(module="warpcloth.obstacles." + dtype.__name__, enable_backward=False)
    def carry_each_vertex(
        # elements
        pairs: Pairs,
        inverse_mass: wp.array(dtype=dtype),
        mobility: wp.array(dtype=vec3),
        # state in
        step: StepPairs,
        keys: wp.array(dtype=wp.int64),
        carried: wp.array(dtype=wp.int64),
        # in and out
        p: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        key = keys[i]
        if key == carried[i] or inverse_mass[i] == dtype(0.0):
            return
        e = wp.int32((key - wp.int64(1)) % wp.int64(2147483648))
        s = pairs.stencils[e]
        w = step.weights[e]
        sides = wp.where(e < pairs.counts[0], 1, 2)
        own = wp.bool(False)  # whether the vertex is on the first side
        for k in range(sides):
            own = own or s[k] == i
        move = wp.vec3d()  # relative to that of one vertex, so that a translation is exact
        one = wp.int32(-1)
        weight = ZERO
        for k in range(4):
            if (k < sides) != own:
                carries = s[k] >= pairs.layout.cloth
                if not carries:
                    carries = carried[s[k]] > wp.int64(0)
                if carries:
                    if one < 0:
                        one = s[k]
                    near = wp.max(wp.abs(w[k]), SMALL)
                    move += near * (wp.vec3d(p[s[k]]) - wp.vec3d(p[one]))
                    weight += near
        move = wp.vec3d(p[one]) + move / weight
        if mobility:
            for axis in range(3):
                if mobility[i][axis] == dtype(0.0):
                    move[axis] = ZERO
        p[i] = vec3(move)

    return carry_each_vertex
