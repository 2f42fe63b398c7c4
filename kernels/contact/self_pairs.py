"""The structs of the pairs of self-contact, and factories of the kernels that find their gaps and list them by vertex."""

from functools import cache

import warp as wp

from ..pairs import Pairs
from ..vectors import types
from .proximity import sort
from .self_gaps import corners, nearest


@wp.struct
class StepPairs:
    """Normal n, gap d [m] and weights w of each listed pair, where it was listed or the step began."""

    normal: wp.array(dtype=wp.vec3d)
    gap: wp.array(dtype=wp.float64)
    weights: wp.array(dtype=wp.vec4d)


MODULE = "warpcloth.self_contact"


def module_of(dtype):
    """Returns the name of the module of the kernels that every scene with self-contact launches.

    Warp compiles a module as a whole, and again if it has other kernels; so these are in modules of their own.
    """
    return f"{MODULE}.{dtype.__name__}"


@cache
def begin_pairs(dtype):
    """Kernel over pairs: n, d and w at the positions x at the start of a step."""
    vec3, _ = types(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def begin_each_pair(
        # elements
        pairs: Pairs,
        # state in
        x: wp.array(dtype=vec3),
        # out
        step: StepPairs,
    ):
        for e in range(wp.tid(), wp.min(pairs.counts[0] + pairs.counts[1], pairs.stencils.shape[0]), pairs.threads):
            w, y = nearest(e < pairs.counts[0], corners(x, pairs.stencils[e]))
            d = wp.length(y)
            step.gap[e] = d
            step.weights[e] = w
            step.normal[e] = y / wp.max(d, wp.float64(1e-300))

    return begin_each_pair


@wp.func
def take_slot(pairs: Pairs, key: int, s: wp.vec4i):
    """Returns the slot of a new contact, or −1 if none is free; ``number`` counts it in any case."""
    slot = wp.atomic_add(pairs.number, 0, 1)
    if slot >= pairs.stencils.shape[0]:
        return -1
    pairs.keys[slot] = key
    pairs.stencils[slot] = s
    if pairs.slots:
        pairs.slots[key] = slot
    if pairs.corner_counts:
        for i in range(4):
            wp.atomic_add(pairs.corner_counts, s[i], 1)
    return slot


@wp.func
def slot_with(slots: wp.array(dtype=wp.int32), keys: wp.array(dtype=wp.int32), number: wp.array(dtype=wp.int32), key: int):
    """The slot of a key, or −1 if no contact has it. Entries of ``slots`` may be stale (Briggs and Torczon 1993)."""
    slot = slots[key]
    if slot < number[0] and keys[slot] == key:
        return slot
    return -1


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def bound_number(
    # in and out
    pairs: Pairs,
    most: wp.array(dtype=wp.int32),
):
    """Kernel of one thread: raises ``most`` (1,) to the number of contacts, and limits that to the number of slots."""
    most[0] = wp.max(most[0], pairs.number[0])
    pairs.number[0] = wp.min(pairs.number[0], pairs.stencils.shape[0])


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def forget_forces(
    # elements
    pairs: Pairs,
    # out
    multipliers: wp.array(dtype=wp.vec3d),
):
    """Kernel over contacts: their λ become 0."""
    for e in range(wp.tid(), pairs.number[0], pairs.threads):
        multipliers[e] = wp.vec3d()


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def fill_corners(
    # in and out
    pairs: Pairs,
):
    """Kernel over contacts: lists 4·key + corner at each vertex, and counts ``corner_counts`` down to 0."""
    for t in range(wp.tid(), pairs.number[0], pairs.threads):
        e = pairs.number[0] - 1 - t
        s = pairs.stencils[e]
        for i in range(4):
            pairs.corners[pairs.first[s[i]] + wp.atomic_sub(pairs.corner_counts, s[i], 1) - 1] = 4 * pairs.keys[e] + i


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def sort_corners(
    # in and out
    pairs: Pairs,
):
    """Kernel over vertices: sorts the corners of each vertex by key, and then replaces 4·key + corner by 4·slot + corner."""
    i = wp.tid()
    sort(pairs.corners, pairs.first[i], pairs.first[i + 1])
    for k in range(pairs.first[i], pairs.first[i + 1]):
        key = pairs.corners[k] // 4
        pairs.corners[k] = 4 * pairs.slots[key] + pairs.corners[k] - 4 * key


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def note_list(
    # state in
    counts: wp.array(dtype=wp.int32),
    made: wp.array(dtype=wp.int32),
    # in and out
    most: wp.array(dtype=wp.int32),
    lists: wp.array(dtype=wp.int32),
    # out
    listed: wp.array(dtype=wp.int32),
):
    """Kernel over copies: the most pairs in any list, the number of lists, to which it adds ``made`` (1,), and ``listed``."""
    c = wp.tid()
    if c == 0:
        listed[0] = wp.min(counts[0] + counts[1], 1)
    most[c] = wp.max(most[c], wp.max(counts[0] + counts[1], 3 * counts[0]))
    lists[c] = lists[c] + made[0]
