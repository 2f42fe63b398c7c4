"""Factories of the kernels by which the contacts of sweeps follow the iterate.

Sweeps leave w and n as they were found. Then all forces are removed, contacts are found anew where the iterate is now, and the
new ones start with the λ of the old ones.
"""

import warp as wp

from ..memory import load
from ..pairs import Pairs
from ..terms import contact
from .pair_potential import Contacts
from .self_gaps import ONE, SIDE, ZERO
from .self_pairs import slot_with

slope, _number = contact.slope, load(wp.int32)


@wp.kernel(module="warpcloth.pair_follow", enable_backward=False)
def carry_forces(
    # elements
    pairs: Pairs,
    # state in
    multipliers: wp.array(dtype=wp.vec3d),
    # in and out
    contacts: Contacts,
):
    """Kernel over contacts: carries over λ along n, before the contacts are found elsewhere."""
    for e in range(wp.tid(), pairs.number[0], pairs.threads):
        contacts.followed.keys[e] = pairs.keys[e]
        contacts.followed.carried[e] = wp.dot(multipliers[e], contacts.normal[e])
        contacts.followed.stencils[e] = contacts.parts[e]


@wp.kernel(module="warpcloth.pair_follow", enable_backward=False)
def start_forces(
    # elements
    lists: Pairs,
    pairs: Pairs,
    # parameters
    h: wp.float64,
    vertices: int,
    # in and out
    contacts: Contacts,
):
    """Kernel over contacts: the start of λ is that of the same contact before, else −h²kAφ′, but 0 below r/2."""
    for e in range(wp.tid(), pairs.number[0], pairs.threads):
        gap = contacts.gap[e]
        r = contacts.distance[e]
        found = ZERO
        if gap >= SIDE * r:
            found = -contacts.stiffness[e] * slope(gap, r) * h * h
        # The list may have been made anew, so that the contact now has another key of its row.
        half = lists.stencils.shape[0]
        key = pairs.keys[e]
        row = contacts.parts[e][0]
        if key >= lists.counts[0] and key < half:
            row = vertices
            above = lists.rows.shape[0] - 1
            while above - row > 1:
                middle = (row + above) // 2
                if _number(lists.rows, middle) <= key:
                    row = middle
                else:
                    above = middle
        first = contacts.followed.rows[row]
        end = wp.min(contacts.followed.rows[row + 1], half)
        if key >= half:
            first = half + 3 * first
            end = wp.min(half + 3 * end, 2 * half)
        for k in range(first, end):
            before = slot_with(contacts.followed.slots, contacts.followed.keys, contacts.followed.number, k)
            if before >= 0 and contacts.followed.carried[before] > ZERO:
                if contacts.parts[e] == contacts.followed.stencils[before]:
                    found = contacts.followed.carried[before]
        contacts.followed.start[e] = wp.where(contacts.stiffness[e] > ZERO, found, ZERO)


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def count_sweep(
    # parameters
    every: int,
    listed: wp.array(dtype=wp.int32),
    # in and out
    turn: wp.array(dtype=wp.int32),
    # out
    due: wp.array(dtype=wp.int32),
):
    """Kernel of one thread: counts a sweep; ``due`` is 1 after ``every`` sweeps, and so on, if any pair is ``listed``."""
    due[0] = wp.where(turn[0] % every == 0 and turn[0] > 0, listed[0], 0)
    turn[0] = turn[0] + 1


@wp.kernel(module="warpcloth.pair_follow", enable_backward=False)
def fix_forces(
    # elements
    lists: Pairs,
    pairs: Pairs,
    # parameters
    h: wp.float64,
    # in and out
    contacts: Contacts,
):
    """Kernel over vertices: the part of the forces of contacts over a valley that sweeps do not compute anew, as λ [kg·m].

    That is −h²(1 − share)kAφ′ along n, and all of negative contacts, in proportion to the λ of the positive ones, because the
    positions where the contacts were found may be far from the solution.
    """
    v = wp.tid()
    first = lists.rows[v]
    count = lists.rows[v + 1] - first
    half = lists.stencils.shape[0]
    extra = half + 3 * first
    if count < 2 or extra + 3 * count > 2 * half:
        return
    for i in range(4 * count):
        one = slot_with(pairs.slots, pairs.keys, pairs.number, wp.where(i < count, first + i, extra + i - count))
        if one < 0:
            continue
        k = contacts.stiffness[one]
        share = wp.where(k > ZERO, contacts.share[one], ZERO)
        if share < ONE:
            held = ZERO
            whole = ZERO
            for j in range(4 * count):
                other = slot_with(pairs.slots, pairs.keys, pairs.number, wp.where(j < count, first + j, extra + j - count))
                if other < 0:
                    continue
                A = contacts.stiffness[other]
                if A > ZERO and wp.dot(contacts.normal[one], contacts.normal[other]) > ZERO:
                    held += contacts.followed.start[other]
                    whole -= h * h * A * slope(contacts.gap[other], contacts.distance[other])
            if held > ZERO and whole > ZERO:
                part = wp.min(held / whole, ONE) * (ONE - share)
                contacts.fixed[one] = -part * h * h * k * slope(contacts.gap[one], contacts.distance[one])
