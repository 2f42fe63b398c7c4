"""Factory of the kernel of damping, which sets the rest states of damped elements at the start of a step."""

from functools import cache

import warp as wp

from .local import local_coordinate
from .term import Term
from .vectors import types


@cache
def set_damped_rest(term: Term, dtype, bdf2: bool, midpoint: bool):
    """Kernel over elements: out[e] = the rest state of damping for s̃ = s(x) plus a change, see :class:`.term.Dissipation`.

    With d = scale·move, the change is 0 for Euler, where move may be None. For BDF2, with the last move d, it is
    (s(x) − s(x − d))/3. For midpoint, with d = hₑ v, it is s(x) − ½(s(x + d) + s(x − d)) ≈ −½ddᵀ∂²s. Without it, s at the mean
    of two states would stand for the mean of s. That is of first order, and damps rotations.
    """
    vec3, _ = types(dtype)
    rest_type = wp.types.vector(term.parameters, dtype)
    out_type = wp.types.vector((term.dissipation.term or term).parameters, dtype)
    y_of, change_of, rest_of = local_coordinate(term, dtype, False), term.dissipation.change, term.dissipation.rest

    @wp.kernel(module="unique", enable_backward=False)
    def set_rest(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        share: wp.array(dtype=dtype),
        # state in
        x: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        # parameters
        scale: dtype,
        # out
        out: wp.array(dtype=out_type),
    ):
        e = wp.tid()
        y = y_of(stencil, e, rest[e], x, x)
        change = change_of(y, y, rest[e])
        if wp.static(bdf2):
            d = scale * y_of(stencil, e, rest[e], move, move)
            change = -change_of(y, y - d, rest[e]) / dtype(3.0)
        if wp.static(midpoint):
            d = scale * y_of(stencil, e, rest[e], move, move)
            change = -dtype(0.5) * (change_of(y, y + d, rest[e]) + change_of(y, y - d, rest[e]))
        out[e] = rest_of(y, change, rest[e], share[e])

    return set_rest
