"""Factories of the kernels that decide whether pairs must be found again, by the motion of the connected pieces of a cloth."""

from functools import cache

import warp as wp

from ..pairs import Layout
from ..vectors import types
from .obstacles import copy_of, vector_within
from .proximity_grid import MODULE

NUMBERS = wp.array(dtype=wp.int32)
SAMPLES = wp.constant(9)  # vertices whose median motion is that of a piece


@cache
def pieces(dtype):
    """Struct of the connected pieces of all copies: the piece of each vertex, or −1, and the drift of each piece [m].

    The drift is its motion: along each axis the median of that of its ``samples`` (pieces·SAMPLES,). A part that moves alone,
    such as a fold that rolls, hardly changes it. If a copy has more than one piece (``per_copy``), each also has a box, and the
    largest motion of its vertices relative to the drift [m]. The first are those of the ``cloth``, which meet one another if it
    meets ``itself``, and the others are meshes.
    """
    vec3, _ = types(dtype)

    @wp.struct
    class Pieces:
        piece: wp.array(dtype=wp.int32)
        samples: wp.array(dtype=wp.int32)
        drift: wp.array(dtype=vec3)
        per_copy: wp.int32
        cloth: wp.int32
        itself: wp.bool
        layout: Layout
        lower: wp.array(dtype=vec3)
        upper: wp.array(dtype=vec3)
        motion: wp.array(dtype=dtype)

    return Pieces


@cache
def extend_boxes(dtype):
    """Kernel over vertices: extends the boxes of their pieces."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def extend_each_box(
        # state in
        x: wp.array(dtype=vec3),
        # in and out
        pieces: pieces(dtype),
    ):
        i = wp.tid()
        p = pieces.piece[i]
        if p >= 0:
            if wp.max(wp.max(pieces.lower[p] - x[i], x[i] - pieces.upper[p])) > dtype(0.0):  # few are
                wp.atomic_min(pieces.lower, p, x[i])
                wp.atomic_max(pieces.upper, p, x[i])

    return extend_each_box


@wp.func
def note_moved(active: NUMBERS, copy: int, moved: NUMBERS, some: NUMBERS, due: NUMBERS):
    if active:
        if active[copy] == 0:
            return
    moved[copy] = 1
    some[0] = 1
    due[0] = 1


@cache
def add_positions(dtype):
    """Kernel over vertices: out = a + sign·b in the copies that are ``active``, or in all; b may be None, or end before a."""
    vec3, _ = types(dtype)
    vector_or_zero = vector_within(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def add_each_position(
        # state in
        a: wp.array(dtype=vec3),
        b: wp.array(dtype=vec3),
        # parameters
        sign: dtype,
        active: wp.array(dtype=wp.int32),
        layout: Layout,
        # out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if active:
            if active[copy_of(layout, i)] == 0:
                return
        found = a[i]
        if b:
            found = found + sign * vector_or_zero(b, i)
        out[i] = found

    return add_each_position


@cache
def find_drift(dtype):
    """Kernel over pieces: their drift from ``found`` to x + d, d (N,) or None; 0 if it is not finite."""
    vec3, _ = types(dtype)
    vector_or_zero = vector_within(dtype)
    numbers = wp.types.vector(SAMPLES, dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def find_each_drift(
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        found: wp.array(dtype=vec3),
        # in and out
        pieces: pieces(dtype),
    ):
        p = wp.tid()
        drift = vec3()
        for axis in range(3):
            sorted = numbers()
            for k in range(SAMPLES):
                i = pieces.samples[p * SAMPLES + k]
                own = x[i][axis]
                if d:
                    own += vector_or_zero(d, i)[axis]
                own -= found[i][axis]
                at = k
                while at > 0:
                    if sorted[at - 1] <= own:
                        break
                    sorted[at] = sorted[at - 1]
                    at -= 1
                sorted[at] = own
            drift[axis] = sorted[SAMPLES // 2]
        if not wp.length_sq(drift) < dtype(wp.inf):
            drift = vec3()
        pieces.drift[p] = drift

    return find_each_drift


@cache
def find_motion(dtype):
    """Kernel over vertices: finds copies in which a vertex at x + d has moved by more than ``most`` since ``found``.

    The motion is relative to the drift of the piece. moved = 1 for such copies among the ``active`` ones, and some = 1 if there
    is one; due = 1 then. d is (N,) or None.
    """
    vec3, _ = types(dtype)
    vector_or_zero = vector_within(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def find_each_motion(
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        found: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
        most: dtype,
        # in and out
        pieces: pieces(dtype),
        # out
        moved: wp.array(dtype=wp.int32),
        some: wp.array(dtype=wp.int32),
        due: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        p = pieces.piece[i]
        if p >= 0:
            at = x[i]
            if d:
                at = at + vector_or_zero(d, i)
            own = wp.length((at - found[i]) - pieces.drift[p])
            if not (own <= most):
                note_moved(active, p // pieces.per_copy, moved, some, due)
            if pieces.per_copy > 1:
                if own > pieces.motion[p]:
                    wp.atomic_max(pieces.motion, p, own)

    return find_each_motion


@cache
def compare_positions(dtype):
    """Kernel over vertices: differ = 1 if one is at other positions in a and b, of which both may be NaN."""
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def compare_each_position(
        # state in
        a: wp.array(dtype=vec3),
        b: wp.array(dtype=vec3),
        # out
        differ: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        if wp.length_sq(a[i] - b[i]) > dtype(0.0) or wp.isfinite(a[i]) != wp.isfinite(b[i]):
            differ[0] = 1

    return compare_each_position


@cache
def compare_motions(dtype):
    """Kernel over pieces: moved, some and due as in :func:`find_motion`, if it and a later one of its copy may be too near.

    That is, if their approach may exceed ``most`` plus the excess of the distance of their boxes over ``radius``, up to which
    pairs are listed.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def compare_each_motion(
        # state in
        pieces: pieces(dtype),
        # parameters
        active: wp.array(dtype=wp.int32),
        radius: dtype,
        most: dtype,
        # out
        moved: wp.array(dtype=wp.int32),
        some: wp.array(dtype=wp.int32),
        due: wp.array(dtype=wp.int32),
    ):
        p = wp.tid()
        first = p + 1
        if p % pieces.per_copy >= pieces.cloth:
            return
        if not pieces.itself:
            first = p // pieces.per_copy * pieces.per_copy + pieces.cloth
        for q in range(first, (p // pieces.per_copy + 1) * pieces.per_copy):
            nearer = wp.length(pieces.drift[q] - pieces.drift[p]) + pieces.motion[p] + pieces.motion[q]
            gap = wp.max(pieces.lower[p] - pieces.upper[q], pieces.lower[q] - pieces.upper[p])
            gap = wp.max(gap, vec3())
            if not (nearer <= most + wp.max(wp.length(gap) - radius, dtype(0.0))):
                note_moved(active, p // pieces.per_copy, moved, some, due)

    return compare_each_motion
