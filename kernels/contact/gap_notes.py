"""Factories of the kernels that record the gaps between cloth and cloth at the end of frames."""

from functools import cache

import warp as wp

from ..pairs import Pairs
from ..vectors import types
from .obstacles import cloth_vertex, copy_of, has_obstacle
from .pair_potential import CLOSE, Laws
from .self_contact import least_gap
from .self_gaps import ONE, SIDE, ZERO, farthest
from .self_pairs import StepPairs, module_of

# The least gap that coarse positions leave is 6 units in the last place. Rounding changes gaps by two of them.
ROUNDED = wp.constant(wp.float64(4.0 / 3.0))
MORE = wp.constant(wp.float32(0.75 * 2.0**-23))
FIRST = wp.constant(wp.int64(2**62))


@wp.struct
class GapNotes:
    """The smallest gaps in the frames so far, (copies,), or of one state if there are ``counts``.

    ``nearest`` is 1/d for the smallest gap d [1/m]. The next are FIRST − (frame·n + vertex), with n vertices, of the first
    frame and vertex, or 0: of gaps that float32 does not resolve, of pairs nearer than half the distance where contact begins,
    of cloth with cloth and with meshes (copies, 2), and of pairs that rounding, far from the origin, stops where contact
    begins. ``counts`` (copies, 2) has the listed pairs and those in contact instead, or is None.
    """

    nearest: wp.array(dtype=wp.float64)
    too_near: wp.array(dtype=wp.int64)
    pressed: wp.array2d(dtype=wp.int64)
    unresolved: wp.array(dtype=wp.int64)
    counts: wp.array2d(dtype=wp.int32)


@cache
def note_gaps(dtype):
    """Kernel over pairs at the start of a step: records their gaps if a frame ends there.

    ``least`` is the least gap [m] of a filter that keeps iterates apart, without rounding, else 0.
    """
    vec3, _ = types(dtype)
    least_gap_of = least_gap(dtype)

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
        if steps[copy] % per_frame != 0:
            return
        d = step.gap[e]
        inverse = ONE / d
        if inverse > notes.nearest[copy]:
            wp.atomic_max(notes.nearest, copy, inverse)
        law = wp.where(has_obstacle(pairs.layout, s), 1, 0)
        r = wp.float64(dtype(laws.distance[law]))
        begins = ZERO
        if pairs.distances[e] == r:
            begins = wp.where(e >= pairs.counts[0] or s[0] >= pairs.layout.cloth, CLOSE, ONE) * r
        if notes.counts:
            wp.atomic_add(notes.counts, copy, 0, 1)
            if d < begins:
                wp.atomic_add(notes.counts, copy, 1, 1)
            return
        frame = wp.int64(steps[copy] // per_frame)
        first = cloth_vertex(pairs.layout, s) - copy * pairs.layout.per_copy
        key = FIRST - frame * wp.int64(pairs.layout.per_copy) - wp.int64(first)
        far = wp.float32(farthest(x, s))
        next = far + MORE * far  # 0.75 to 1.5 units more, which is rounded to the next number
        if not d >= wp.float64(4.0) * wp.float64(next - far):
            wp.atomic_max(notes.too_near, copy, key)
        if d < SIDE * begins and (law == 0 or least > ZERO):  # edges have no contact with meshes in explicit steps
            wp.atomic_max(notes.pressed, copy, law, key)
        f = least_gap_of(s, x, least)
        if least > ZERO and begins > ZERO and wp.max(begins, d) <= ROUNDED * f:
            wp.atomic_max(notes.unresolved, copy, key)

    return note_each_gap
