"""Factories of the kernels that record the gaps between cloth and cloth at the end of frames."""

from functools import cache

import warp as wp

from ..vectors import types
from .obstacles import cloth_vertex, copy_of, has_obstacle
from .pair_potential import CLOSE, Laws
from .self_contact import least_gap
from .self_gaps import ONE, SIDE, ZERO, farthest
from .self_pairs import Pairs, StepPairs, module_of

# The least gap that coarse positions leave is 6 units in the last place. Rounding changes gaps by two of them.
ROUNDED = wp.constant(wp.float64(4.0 / 3.0))
MORE = wp.constant(wp.float32(0.75 * 2.0**-23))
FIRST = wp.constant(wp.int64(2**62))


@wp.struct
class GapNotes:
    """The smallest gaps in the frames so far, (copies,).

    ``nearest`` is 1/d for the smallest gap d [1/m]. The others are FIRST − (frame·n + vertex), with n vertices, of the first
    frame and vertex, or 0: of gaps that float32 does not resolve, of pairs nearer than half the distance where contact begins,
    of cloth with cloth and with meshes (copies, 2), and of pairs that rounding, far from the origin, stops where contact
    begins.
    """

    nearest: wp.array(dtype=wp.float64)
    too_near: wp.array(dtype=wp.int64)
    pressed: wp.array2d(dtype=wp.int64)
    unresolved: wp.array(dtype=wp.int64)


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def find_frames(
    # state in
    steps: wp.array(dtype=wp.int32),
    # parameters
    per_frame: int,
    # out
    some: wp.array(dtype=wp.int32),
):
    """Kernel over copies, where a step begins: some = 1 if a frame of one ends there."""
    if steps[wp.tid()] % per_frame == 0:
        some[0] = 1


@cache
def cutoff_of(dtype):
    """Device function (pairs, laws, e) → the gap at which contact of a pair begins [m]; 0 if it has none."""

    @wp.func
    def contact_distance(pairs: Pairs, laws: Laws, e: int):
        s = pairs.stencils[e]
        r = wp.float64(dtype(laws.distance[wp.where(has_obstacle(pairs.layout, s), 1, 0)]))
        if pairs.distances[e] != r:
            return ZERO
        close = e >= pairs.counts[0] or s[0] >= pairs.layout.cloth
        return wp.where(close, CLOSE, ONE) * r

    return contact_distance


@cache
def note_gaps(dtype):
    """Kernel over pairs at the start of a step: records their gaps if a frame ends there.

    ``least`` is the least gap [m] of a filter that keeps iterates apart, without rounding, else 0.
    """
    vec3, _ = types(dtype)
    contact_distance, least_gap_of = cutoff_of(dtype), least_gap(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def note_each_gap(
        # elements
        pairs: Pairs,
        # state in
        step: StepPairs,
        x: wp.array(dtype=vec3),
        steps: wp.array(dtype=wp.int32),
        # parameters
        laws: Laws,
        per_frame: int,
        least: wp.float64,
        # out
        notes: GapNotes,
    ):
        e = wp.tid()
        if e >= pairs.counts[0] + pairs.counts[1]:
            return
        s = pairs.stencils[e]
        copy = copy_of(pairs.layout, s[0])
        d = step.gap[e]
        if steps[copy] % per_frame != 0:
            return
        inverse = ONE / d
        if inverse > notes.nearest[copy]:
            wp.atomic_max(notes.nearest, copy, inverse)
        frame = wp.int64(steps[copy] // per_frame)
        first = cloth_vertex(pairs.layout, s) - copy * pairs.layout.per_copy
        key = FIRST - frame * wp.int64(pairs.layout.per_copy) - wp.int64(first)
        far = wp.float32(farthest(x, s))
        next = far + MORE * far  # 0.75 to 1.5 units more, which is rounded to the next number
        if not d >= wp.float64(4.0) * wp.float64(next - far):
            wp.atomic_max(notes.too_near, copy, key)
        begins = contact_distance(pairs, laws, e)
        law = wp.where(has_obstacle(pairs.layout, s), 1, 0)
        if d < SIDE * begins and (law == 0 or least > ZERO):  # edges have no contact with meshes in explicit steps
            wp.atomic_max(notes.pressed, copy, law, key)
        f = least_gap_of(s, x, least)
        if least > ZERO and begins > ZERO and wp.max(begins, d) <= ROUNDED * f:
            wp.atomic_max(notes.unresolved, copy, key)

    return note_each_gap


@cache
def count_pairs(dtype):
    """Kernel over pairs at the start of a step: for each copy the listed pairs, those in contact, and 1/d of the nearest."""
    contact_distance = cutoff_of(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def count_each_pair(
        # elements
        pairs: Pairs,
        # state in
        step: StepPairs,
        # parameters
        laws: Laws,
        # out
        counts: wp.array2d(dtype=wp.int32),
        nearest: wp.array(dtype=wp.float64),
    ):
        e = wp.tid()
        if e >= pairs.counts[0] + pairs.counts[1]:
            return
        s = pairs.stencils[e]
        copy = copy_of(pairs.layout, s[0])
        wp.atomic_add(counts, copy, 0, 1)
        wp.atomic_max(nearest, copy, ONE / step.gap[e])
        if step.gap[e] < contact_distance(pairs, laws, e):
            wp.atomic_add(counts, copy, 1, 1)

    return count_each_pair
