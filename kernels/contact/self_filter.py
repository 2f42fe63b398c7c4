"""Kernels of the filter, which moves each vertex only as far as the planes of :mod:`.self_planes` allow.

The filter ends each step, and shortens search directions of a minimiser whose iterates must stay apart.
"""

from functools import cache

import warp as wp

from ..pairs import Layout, Pairs
from ..vectors import types
from .gap_notes import FIRST
from .obstacles import copy_of, has_obstacle, vector_within
from .self_gaps import ONE, PLANAR, ZERO
from .self_pairs import StepPairs, module_of
from .self_planes import bounded_share

# Pins of hard pairs may approach by this fraction of their gap in a step. The second is for pairs with a free vertex, which
# lags behind pins that turn.
TOGETHER, LAGGING = wp.constant(wp.float64(0.01)), wp.constant(wp.float64(0.5))


@cache
def keep_apart(dtype):
    """Kernel over vertices: x ← x + u + t(δ − u), with the ``common`` move u and t at most the ``share`` that planes allow.

    ``most`` bounds t‖δ − u‖, so that unlisted pairs cannot cross. ``cuts`` (B,) counts the vertices whose move this bound alone
    shortened. Copies whose ``walk`` is 0 do not move.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def keep_each_apart(
        # state in
        share: wp.array(dtype=wp.float64),
        least_share: wp.array(dtype=wp.float64),
        x_ref: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        common: wp.array(dtype=wp.vec3d),
        walk: wp.array(dtype=wp.int32),
        # parameters
        per_copy: int,
        most: wp.float64,
        # out
        x: wp.array(dtype=vec3),
        cuts: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        copy = i // per_copy
        if walk[copy] == 0:
            return
        u = common[copy]
        move = wp.vec3d(target[i]) - wp.vec3d(x_ref[i]) - u
        far = bounded_share(move, most)
        t = wp.min(far, share[i])
        if t < ONE:
            if t < least_share[i]:
                t = ZERO
            end = wp.vec3d(x_ref[i]) + u + t * move
            x[i] = vec3(end)
            if share[i] >= far:
                wp.atomic_add(cuts, copy, 1)
        else:
            x[i] = target[i]

    return keep_each_apart


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def another_round(
    # parameters
    most: int,
    # in and out
    cuts: wp.array(dtype=wp.int32),
    rounds: wp.array(dtype=wp.int32),
    # out
    walk: wp.array(dtype=wp.int32),
    proceed: wp.array(dtype=wp.int32),
):
    """Kernel over copies: ``walk`` and ``proceed`` are 1 while the bound of the list cuts a move, in up to ``most`` rounds."""
    c = wp.tid()
    rounds[c] = rounds[c] + 1
    walk[c] = 0
    if cuts[c] > 0 and rounds[c] < most:
        walk[c] = 1
        proceed[0] = 1
    cuts[c] = 0


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def end_move(
    # state in
    fraction: wp.array(dtype=wp.float64),
    rounds: wp.array(dtype=wp.int32),
    steps: wp.array(dtype=wp.int32),
    # parameters
    most: int,
    per_frame: int,
    # in and out
    active: wp.array(dtype=wp.int32),
    # out
    proceed: wp.array(dtype=wp.int32),
    first: wp.array(dtype=wp.int64),
):
    """Kernel over copies: ``active`` is 0 for those that have moved the whole way, and ``proceed`` 1 if one has not.

    After ``most`` rounds pins stop, and meshes go through what is in their way: ``first`` is FIRST − frame for the first
    such frame.
    """
    c = wp.tid()
    if fraction[c] == ONE:
        active[c] = 0
    elif active[c] != 0:
        if rounds[0] < most:
            proceed[0] = 1
        else:
            wp.atomic_max(first, c, FIRST - wp.int64(steps[c] // per_frame + 1))


@wp.struct
class HeldPins:
    """The prescribed moves that the filter has shortened after ``steps`` (B,).

    ``first`` is FIRST − (step·n + vertex) for the first pinned coordinate that was held back, or 0, and ``farthest`` the
    largest distance by which one was held back [m].
    """

    steps: wp.array(dtype=wp.int32)
    per_copy: wp.int32
    first: wp.array(dtype=wp.int64)
    farthest: wp.array(dtype=wp.float64)


@wp.func
def note_held(held: HeldPins, i: int, back: wp.float64):
    if back == ZERO:
        return
    copy = i // held.per_copy
    key = wp.int64(held.steps[copy]) * wp.int64(held.per_copy) + wp.int64(i - copy * held.per_copy)
    wp.atomic_max(held.first, copy, FIRST - key)
    wp.atomic_max(held.farthest, copy, back)


@wp.func
def turned_gap(of_vertex: bool, n: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """The gap of a pair at a, b, c and d along its common normal, n before it moved, and the sine of the rotation of n.

    The normal is that of the triangle bcd, or of the edges ab and cd. A pair without one keeps n.
    """
    first = wp.where(of_vertex, c - b, b - a)
    second = wp.where(of_vertex, d - b, d - c)
    normal = wp.cross(first, second)
    square = wp.dot(normal, normal)
    if square <= PLANAR * wp.dot(first, first) * wp.dot(second, second):
        return wp.dot(n, a - c), ZERO
    normal = normal / wp.sqrt(square)
    if wp.dot(normal, n) < ZERO:
        normal = -normal
    return wp.dot(normal, a - c), wp.length(wp.cross(n, normal))


@cache
def share_of_pins(dtype):
    """Kernel over pairs: reduces the ``share`` of each pin, the fraction of its move to x that other pins leave it.

    It acts on pairs with pins on both sides whose nearest points are inside a triangle or inside both edges. Pins that would
    pass through one another stop at the contact distance or, if smaller, the gap at the start. So do pins of ``hard`` pairs
    that would come nearer by more than TOGETHER of it, LAGGING if a vertex is free, or, if larger, the sine of the rotation of
    their normal, because gaps shrink on chords of a rotation. Else free vertices count as if they moved with the pins, because
    x omits contact.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def find_each_share_of_pins(
        # elements
        pairs: Pairs,
        inverse_mass: wp.array(dtype=dtype),
        # state in
        step: StepPairs,
        x_before: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        # parameters
        hard: bool,
        # in and out
        share: wp.array(dtype=wp.float64),
    ):
        e = wp.tid()
        if e >= pairs.counts[0] + pairs.counts[1]:
            return
        s = pairs.stencils[e]
        if has_obstacle(pairs.layout, s):
            return
        w = step.weights[e]
        for i in range(4):
            if w[i] == ZERO:
                return
        n = step.normal[e]
        sides = wp.where(e < pairs.counts[0], 1, 2)
        gap = step.gap[e]
        floor = wp.min(gap, pairs.distances[e])
        most = TOGETHER
        pins = ZERO
        move = vec3()
        for i in range(4):
            if inverse_mass[s[i]] > dtype(0.0):
                most = LAGGING
            else:
                pins += ONE
                move += x[s[i]] - x_before[s[i]]
        move /= dtype(wp.max(pins, ONE))
        at = wp.matrix(shape=(4, 3), dtype=wp.float64)
        for i in range(4):
            follows = inverse_mass[s[i]] > dtype(0.0) and not hard
            at[i] = wp.vec3d(wp.where(follows, x_before[s[i]] + move, x[s[i]]))
        end, turned = turned_gap(e < pairs.counts[0], n, at[0], at[1], at[2], at[3])
        lost = wp.where(hard, wp.max(most, turned), ONE) * floor
        if end < floor - lost:
            t = wp.max(gap - floor, ZERO) / (gap - end)
            for i in range(sides):
                for j in range(sides, 4):
                    if inverse_mass[s[i]] == dtype(0.0) and inverse_mass[s[j]] == dtype(0.0):
                        wp.atomic_min(share, s[i], t)
                        wp.atomic_min(share, s[j], t)

    return find_each_share_of_pins


@cache
def hold_pins(dtype):
    """Kernel over vertices: pins make the ``share`` of their moves from x_before, and v changes with them."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def hold_each_pin(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        # state in
        share: wp.array(dtype=wp.float64),
        x_before: wp.array(dtype=vec3),
        # in and out
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        held: HeldPins,
    ):
        i = wp.tid()
        if inverse_mass[i] == dtype(0.0) and share[i] < ONE:
            move = wp.vec3d(x[i]) - wp.vec3d(x_before[i])
            end = wp.vec3d(x_before[i]) + share[i] * move
            note_held(held, i, (ONE - share[i]) * wp.length(move))
            x[i] = vec3(end)
            v[i] = dtype(share[i]) * v[i]

    return hold_each_pin


@cache
def end_filter(dtype):
    """Kernel over vertices: adds the change of x by the filter to ``move``, which may be None, and the change over h to v.

    ``cut`` counts the free vertices among them, and ``held`` notes pins, whose last move took ``pin_h`` [s].
    """
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def end_each_filter(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        mobility: wp.array(dtype=vec3),
        # state in
        target: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        # parameters
        h: dtype,
        pin_h: dtype,
        # in and out
        v: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        cut: wp.array(dtype=wp.int64),
        held: HeldPins,
    ):
        i = wp.tid()
        change = x[i] - target[i]
        if wp.length_sq(change) > dtype(0.0):
            pinned = wp.vec3d(change)
            if inverse_mass[i] > dtype(0.0):
                wp.atomic_add(cut, i // held.per_copy, wp.int64(1))
                for axis in range(3):
                    free = True
                    if mobility:
                        free = mobility[i][axis] > dtype(0.0)
                    if free:
                        pinned[axis] = ZERO
            if wp.length_sq(pinned) > ZERO:
                note_held(held, i, wp.length(pinned))
            v[i] = v[i] + change / wp.where(inverse_mass[i] > dtype(0.0), h, pin_h)
            if move:
                move[i] = move[i] + change

    return end_each_filter


@cache
def find_short(dtype):
    """Kernel over vertices: ``walk`` and ``some`` become 1 for a copy cut more often than ``before`` and not at its target."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def find_each_short(
        # state in
        x: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        before: wp.array(dtype=wp.int64),
        cut: wp.array(dtype=wp.int64),
        # parameters
        per_copy: int,
        # out
        walk: wp.array(dtype=wp.int32),
        some: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        copy = i // per_copy
        if cut[copy] > before[copy] and not (x[i] == target[i]):
            walk[copy] = 1
            some[0] = 1

    return find_each_short


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def take_back(
    # state in
    before: wp.array(dtype=wp.int64),
    walk: wp.array(dtype=wp.int32),
    # in and out
    first: wp.array(dtype=wp.int64),
):
    copy = wp.tid()
    if walk[copy] == 1:
        first[copy] = before[copy]


@cache
def walk_from_start(dtype):
    """Kernel over vertices from ``first`` on: x = x_before in copies that ``walk``."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def walk_each_from_start(
        # state in
        x_before: wp.array(dtype=vec3),
        walk: wp.array(dtype=wp.int32),
        # parameters
        layout: Layout,
        first: int,
        # out
        x: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        copy = copy_of(layout, first + i)
        if walk[copy] == 1:
            x[i] = x_before[i]

    return walk_each_from_start


@cache
def find_held(dtype):
    """Kernel over vertices: ``mobile`` is 1/m, or 0 for those not at their position ``outside`` of colliders.

    ``within`` becomes 1 if there is one and fewer than ``most`` turns were made.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def find_each_held(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        # state in
        x: wp.array(dtype=vec3),
        outside: wp.array(dtype=vec3),
        turns: wp.array(dtype=wp.int32),
        # parameters
        most: int,
        # out
        mobile: wp.array(dtype=dtype),
        within: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        mobile[i] = inverse_mass[i]
        if wp.length_sq(outside[i] - x[i]) > dtype(0.0):
            mobile[i] = dtype(0.0)
            if turns[0] < most:
                within[0] = 1

    return find_each_held


@cache
def push_pairs(dtype):
    """Kernel of one thread: each pair in turn moves the ends of moves p apart along n, to its gap or ``left`` [m] if smaller.

    If it ``opens``, to twice its gap, so that rounding does not stop pairs that should move together. Obstacles cannot be
    pushed.
    """
    vec3, _ = types(dtype)
    vector_or_zero = vector_within(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def push_each_pair(
        # elements
        pairs: Pairs,
        mobile: wp.array(dtype=dtype),
        # state in
        step: StepPairs,
        # parameters
        left: wp.float64,
        opens: bool,
        # in and out
        p: wp.array(dtype=vec3),
    ):
        count = wp.min(pairs.counts[0] + pairs.counts[1], pairs.stencils.shape[0])
        for e in range(count):
            s = pairs.stencils[e]
            n = step.normal[e]
            w = step.weights[e]
            gap = step.gap[e]
            one = wp.vec3d(vector_or_zero(p, s[0]))  # relative to this, so that equal moves change no gap
            W = ZERO
            for i in range(4):
                if s[i] < mobile.shape[0]:
                    W += w[i] * w[i] * wp.float64(mobile[s[i]])
                gap += w[i] * wp.dot(n, wp.vec3d(vector_or_zero(p, s[i])) - one)
            short = wp.min(wp.where(opens, step.gap[e] + step.gap[e], step.gap[e]), left) - gap
            if short > ZERO and W > ZERO:
                for i in range(4):
                    if s[i] < mobile.shape[0]:
                        move = w[i] * wp.float64(mobile[s[i]]) * short / W * n
                        p[s[i]] = p[s[i]] + vec3(move)

    return push_each_pair


@cache
def scale_directions(dtype):
    """Kernel over vertices: p ← ``fraction``·p of the copy (B,), or 0 if that is below 1 and ``whole``."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def scale_each_direction(
        # state in
        fraction: wp.array(dtype=wp.float64),
        # parameters
        layout: Layout,
        whole: bool,
        # in and out
        p: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        part = fraction[copy_of(layout, i)]
        p[i] = dtype(wp.where(whole and part < ONE, ZERO, part)) * p[i]

    return scale_each_direction


@wp.kernel(module="warpcloth.near_colliders", enable_backward=False)
def copies_near_colliders(
    # state in
    near: wp.array(dtype=wp.int32),
    active: wp.array(dtype=wp.int32),
    # parameters
    always: bool,
    # out
    touching: wp.array(dtype=wp.int32),
    some: wp.array(dtype=wp.int32),
):
    """Kernel over copies: ``touching`` is 1 for ``active`` copies ``near`` colliders, else 0; then ``some`` becomes 1.

    ``near`` (B,) is None if that holds ``always`` or never.
    """
    copy = wp.tid()
    is_near = always
    if near:
        is_near = near[copy] != 0
    touching[copy] = wp.where(is_near, active[copy], 0)
    if touching[copy] != 0:
        some[0] = 1


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def copies_free(
    # state in
    fraction: wp.array(dtype=wp.float64),
    # in and out
    wanted: wp.array(dtype=wp.int32),
    # out
    some: wp.array(dtype=wp.int32),
):
    """Kernel over copies: ``wanted`` becomes 0 where the fraction is below 1; ``some`` is 1 if one is left."""
    copy = wp.tid()
    if fraction[copy] < ONE:
        wanted[copy] = 0
    elif wanted[copy] == 1:
        some[0] = 1


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def copies_in_contact(
    # elements
    pairs: Pairs,
    # state in
    active: wp.array(dtype=wp.int32),
    # out
    touching: wp.array(dtype=wp.int32),
    some: wp.array(dtype=wp.int32),
):
    """Kernel over contacts: ``touching`` and ``some`` become 1 for ``active`` copies."""
    e = wp.tid()
    if e >= pairs.number[0]:
        return
    copy = pairs.stencils[e][0] // pairs.layout.per_copy
    if active[copy] != 0:
        touching[copy] = 1
        some[0] = 1


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def copies_with_pairs(
    # elements
    pairs: Pairs,
    # out
    listed: wp.array(dtype=wp.int32),
):
    e = wp.tid()
    if e < pairs.counts[0] + pairs.counts[1]:
        listed[copy_of(pairs.layout, pairs.stencils[e][0])] = 1


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def divide_copies(
    # state in
    fraction: wp.array(dtype=wp.float64),
    # out
    walk: wp.array(dtype=wp.int32),
    stand: wp.array(dtype=wp.int32),
    some: wp.array(dtype=wp.int32),
):
    """Kernel over copies: ``walk`` is 1 where a part of the way is left, ``stand`` elsewhere; ``some`` is 1 if one walks."""
    c = wp.tid()
    walk[c] = wp.where(fraction[c] < ONE, 1, 0)
    stand[c] = 1 - walk[c]
    if walk[c] != 0:
        some[0] = 1


@cache
def aim(dtype):
    """Kernel over vertices: p = goal − x along ``free`` axes, pinned ones, or both, else 0.

    Copies whose ``fraction`` (B,) is 1 keep p; it may be None.
    """
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def aim_each(
        # state in
        inverse_mass: wp.array(dtype=dtype),
        mobility: wp.array(dtype=vec3),
        goal: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        # parameters
        free: bool,
        pinned: bool,
        fraction: wp.array(dtype=wp.float64),
        per_copy: int,
        # in and out
        p: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if fraction:
            if fraction[i // per_copy] >= ONE:
                return
        mobile = vec3(inverse_mass[i])
        if mobility:
            mobile = mobility[i]
        move = goal[i] - x[i]
        for axis in range(3):
            if not wp.where(mobile[axis] > dtype(0.0), free, pinned):
                move[axis] = dtype(0.0)
        p[i] = move

    return aim_each
