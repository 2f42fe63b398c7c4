"""Functions of one element, and structs of the arrays of several terms, for kernels that take all terms in one pass.

Such a kernel is made of one function and one struct of arrays a term, each with those of the terms after it inside.
"""

from functools import cache
from typing import NamedTuple

import warp as wp

from ..term import Term


class TermFacts(NamedTuple):
    """Facts about the elements of one term by which a kernel is compiled.

    Attributes:
        term: The :class:`.term.Term`.
        damped: Whether it has damping, taken at x + h v about the state x, see :class:`.term.Dissipation`.
        shared: Whether all elements share one stiffness. For gathered pairs without damping, whether all pairs of a vertex do;
            ``stiffness`` then has one value per vertex.
        pairs: Slots of a vertex, for gathering, as first and as second of a pair, where incidences name the other vertex and
            have a rest state of their own, slot by slot; None where they name elements.
        rows: Slots of a vertex, for gathering, where incidences name the other vertices of a row of the matrix of a quadratic
            energy, slot by slot, and ``stiffness`` is its numbers; 0 where they do not.
        padded: Whether incidences that name elements have as many slots for each vertex, slot by slot.
    """

    term: Term
    damped: bool = False
    shared: bool = False
    pairs: tuple[int, int] | None = None
    rows: int = 0
    padded: bool = False


@cache
def local_gradient(part: TermFacts, dtype, corrected: bool = False):
    """The device function (k, β, rest, y, dy, h) → kA ∂u/∂y (M, 3) and the force of damping at y + dy.

    With ``corrected`` all of it is taken at y + dy.
    """
    term = part.term
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    gradient, measure = term.gradient, term.measure

    @wp.func
    def elastic(k: dtype, beta: dtype, r: rest_type, y: y_type, dy: y_type, h: dtype):
        return (k * measure(r)) * gradient(y, r)

    @wp.func
    def ahead(k: dtype, beta: dtype, r: rest_type, y: y_type, dy: y_type, h: dtype):
        return (k * measure(r)) * gradient(y + dy, r)

    if not part.damped:
        return ahead if corrected else elastic
    damped = term.dissipation.term or term
    change_of, rest_of, damped_gradient, damped_measure = (
        term.dissipation.change,
        term.dissipation.rest,
        damped.gradient,
        damped.measure,
    )

    @wp.func
    def with_damping(k: dtype, beta: dtype, r: rest_type, y: y_type, dy: y_type, h: dtype):
        s = rest_of(y, change_of(y, y, r), r, dtype(1.0))
        return elastic(k, beta, r, y, dy, h) + (beta / h * damped_measure(s)) * damped_gradient(y + dy, s)

    return with_damping


@cache
def elements_struct(part: TermFacts, dtype):
    """The struct of the arrays of one term.

    Swept: block b has the pieces offsets[b] to offsets[b+1]; ``codes`` are the first element and the count of each, see
    :mod:`.block_forces`. Gathered: ``codes`` are K·element + corner of the incidences of vertex i from offsets[i] on. They
    are stored slot by slot if padded. For pairs, they are the other vertex, or the vertex itself in an empty slot.
    """

    @wp.struct
    class Elements:
        offsets: wp.array(dtype=wp.int32)
        codes: wp.array(dtype=wp.int32)
        stencil: wp.array2d(dtype=wp.int32)
        stiffness: wp.array(dtype=dtype)
        damping: wp.array(dtype=dtype)
        rest: wp.array(dtype=wp.types.vector(part.term.parameters, dtype))

    return Elements


@wp.struct
class Nothing:
    """The end of a chain."""

    unused: int


def chain_of(parts: tuple[TermFacts, ...], dtype, struct_of=elements_struct):
    """The struct of the arrays of all terms: that of the first, and the chain of the others.

    Args:
        parts: The facts of each term.
        dtype: A Warp scalar type.
        struct_of: (part, dtype) → the struct of one.
    """
    return _chain(tuple(struct_of(part, dtype) for part in parts))


@cache
def _chain(structs):
    if not structs:
        return Nothing
    first_type, others_type = structs[0], _chain(structs[1:])

    @wp.struct
    class Chain:
        first: first_type
        others: others_type

    return Chain
