"""Local coordinates y = Dx = Σᵢ wᵢ ⊗ xᵢ of an element."""

from functools import cache

import warp as wp

from .memory import load
from .term import Term
from .vectors import types


@cache
def from_corner(term: Term, dtype):
    """Device function (rest, i, x) → wᵢ ⊗ x, the part of vertex i in y."""
    vec3, _ = types(dtype)
    M, weight = wp.constant(term.rows), term.weight
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)

    @wp.func
    def part_of(rest: rest_type, corner: int, x: vec3):
        w = weight(rest, corner)
        y = y_type()
        for m in range(M):
            y[m] = w[m] * x
        return y

    return part_of


@cache
def local_coordinate(term: Term, dtype, corrected: bool, precision=None):
    """Device function (stencil, element, rest, x, d) → y = Σᵢ wᵢ ⊗ xᵢ, or if ``corrected`` Σᵢ wᵢ ⊗ (xᵢ + dᵢ) without loss of
    digits of d.

    Rest state and y have the ``precision``, by default that of x and d.
    """
    vec3, _ = types(dtype)
    wide = types(precision or dtype)[0]
    K, rest_type = wp.constant(term.vertices), wp.types.vector(term.parameters, precision or dtype)
    part_of, vector, vertex = from_corner(term, precision or dtype), load(vec3), load(wp.int32, 2)

    @wp.func
    def y_of(stencil: wp.array2d(dtype=wp.int32), e: int, rest: rest_type, x: wp.array(dtype=vec3), d: wp.array(dtype=vec3)):
        y = part_of(rest, 0, wide(vector(x, vertex(stencil, K * e))))
        for i in range(1, K):
            y += part_of(rest, i, wide(vector(x, vertex(stencil, K * e + i))))
        if wp.static(corrected):
            for i in range(K):
                y += part_of(rest, i, wide(vector(d, vertex(stencil, K * e + i))))
        return y

    return y_of
