"""The kernel that sets rest states of damped elements at the start of a step."""

from functools import cache

import warp as wp

from .local import local_coordinate
from .term import Term
from .vectors import types


@cache
def set_damped_rest(term: Term, dtype, parts: int, both: bool):
    """Kernel over elements: out[e] = the rest state of damping for s̃ = s(x) plus a change.

    With d = scale·move, the change is (s(x) − s(x − d))/parts, or, with ``both``, (2s(x) − s(x + d) − s(x − d))/parts. With 0
    parts it is 0, as for Euler. For BDF2 d is the last move, with 3 parts; for midpoint hₑ v, with both and 2 parts.
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
        if wp.static(parts > 0):
            d = scale * y_of(stencil, e, rest[e], move, move)
            change = change_of(y, y - d, rest[e])
            if wp.static(both):
                change = change_of(y, y + d, rest[e]) + change
            change = -change / dtype(parts)
        out[e] = rest_of(y, change, rest[e], share[e])

    return set_rest
