"""Factories of the kernels of damping: the rest state of damped elements where a step begins, and where it leads to."""

from functools import cache

import warp as wp

from .assemble import local_coordinate, types
from .term import Term


@cache
def set_damped_rest(term: Term, dtype, two_states: bool):
    """Kernel over elements: out[e], the rest state that :class:`..kernels.term.Dissipation` has of y at x and at x − move.

    Without ``two_states`` the state before counts as the same, and move may be None.
    """
    vec3, _ = types(dtype)
    rest_type = wp.types.vector(term.parameters, dtype)
    out_type = wp.types.vector((term.dissipation.term or term).parameters, dtype)
    y_of, rest_of = local_coordinate(term, dtype, False), term.dissipation.rest

    @wp.kernel(module="unique", enable_backward=False)
    def set_rest(
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        share: wp.array(dtype=dtype),
        x: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        # out
        out: wp.array(dtype=out_type),
    ):
        e = wp.tid()
        y = y_of(stencil, e, rest[e], x, x)
        before = y
        if wp.static(two_states):
            before = y - y_of(stencil, e, rest[e], move, move)
        out[e] = rest_of(y, before, rest[e], share[e])

    return set_rest


@cache
def advance(dtype):
    """Kernel over vertices: out = h v."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def advance_vertices(v: wp.array(dtype=vec3), h: dtype, out: wp.array(dtype=vec3)):
        i = wp.tid()
        out[i] = h * v[i]

    return advance_vertices
