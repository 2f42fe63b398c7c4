"""Factories of the kernels that record the gaps between cloth and cloth at the end of frames.

Frames are stored in float32, so gaps are computed from positions rounded to float32.
"""

from functools import cache

import warp as wp

from ..vectors import types
from . import self_gaps
from .self_gaps import ONE, ZERO, vertex_of
from .self_pairs import StepPairs, module_of, near_pairs
from .self_planes import ULP

nearest_points = self_gaps.nearest
FOUR = wp.constant(wp.float64(4.0))
MORE = wp.constant(wp.float32(0.75 * 2.0**-23))
FIRST = wp.constant(wp.int64(2**62))


@wp.struct
class GapNotes:
    """The smallest gaps in the frames so far, (copies,).

    ``nearest`` is 1/d for the smallest gap d [1/m]. ``too_near`` is 0 if float32 resolves all gaps. Else it is
    FIRST − (frame·n + vertex) with n vertices: the first frame with an unresolved pair, and the first vertex of such a pair.
    """

    nearest: wp.array(dtype=wp.float64)
    too_near: wp.array(dtype=wp.int64)


@cache
def stored_gap(dtype):
    """Device function (of_vertex, s, x, d) → the gap of a pair after rounding to float32, and four units in the last place.

    d is the gap at x. The unit is that of the largest coordinate of the pair.
    """
    vec3, _ = types(dtype)
    _at, exact = vertex_of(dtype)

    @wp.func
    def rounded(v: vec3):
        return wp.vec3d(wp.float64(wp.float32(v[0])), wp.float64(wp.float32(v[1])), wp.float64(wp.float32(v[2])))

    @wp.func
    def stored(of_vertex: bool, s: wp.vec4i, x: wp.array(dtype=vec3), d: wp.float64):
        far = ZERO
        for i in range(4):
            far = wp.max(far, wp.max(wp.abs(exact(x[s[i]]))))
        # 0.75 to 1.5 units more, which is rounded to the next number.
        next = wp.float32(far) + MORE * wp.float32(far)
        fine = FOUR * wp.float64(next - wp.float32(far))
        found = d
        if d < FOUR * FOUR * ULP * far:
            a = rounded(x[s[0]])
            _w, y, _inside = nearest_points(of_vertex, a, rounded(x[s[1]]), rounded(x[s[2]]), rounded(x[s[3]]))
            found = wp.length(y)
        return found, fine

    return stored


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
def note_gaps(dtype):
    """Kernel over pairs at the start of a step: records their gaps if a frame ends there."""
    vec3, _ = types(dtype)
    stored = stored_gap(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def note_each_gap(
        # elements
        pairs: near_pairs(dtype),
        # state in
        step: StepPairs,
        x: wp.array(dtype=vec3),
        steps: wp.array(dtype=wp.int32),
        # parameters
        per_frame: int,
        per_copy: int,
        # out
        notes: GapNotes,
    ):
        e = wp.tid()
        if e >= pairs.counts[0] + pairs.counts[1]:
            return
        s = pairs.stencils[e]
        copy = s[0] // per_copy
        if steps[copy] % per_frame != 0 or not step.gap[e] < wp.float64(wp.inf):
            return
        d, fine = stored(e < pairs.counts[0], s, x, step.gap[e])
        inverse = ONE / d
        if inverse > notes.nearest[copy]:
            wp.atomic_max(notes.nearest, copy, inverse)
        if not d >= fine:
            frame = wp.int64(steps[copy] // per_frame)
            key = frame * wp.int64(per_copy) + wp.int64(s[0] - copy * per_copy)
            wp.atomic_max(notes.too_near, copy, FIRST - key)

    return note_each_gap


@cache
def count_pairs(dtype):
    """Kernel over pairs at the start of a step: for each copy the listed pairs, those in contact, and 1/d of the nearest."""
    vec3, _ = types(dtype)
    stored = stored_gap(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def count_each_pair(
        # elements
        pairs: near_pairs(dtype),
        # state in
        step: StepPairs,
        x: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        # out
        counts: wp.array2d(dtype=wp.int32),
        nearest: wp.array(dtype=wp.float64),
    ):
        e = wp.tid()
        if e >= pairs.counts[0] + pairs.counts[1]:
            return
        s = pairs.stencils[e]
        copy = s[0] // per_copy
        wp.atomic_add(counts, copy, 0, 1)
        if step.gap[e] < wp.float64(wp.inf):
            d, _fine = stored(e < pairs.counts[0], s, x, step.gap[e])
            wp.atomic_max(nearest, copy, ONE / d)
            if step.gap[e] < wp.float64(pairs.distances[e]):
                wp.atomic_add(counts, copy, 1, 1)

    return count_each_pair
