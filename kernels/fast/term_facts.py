"""Functions of one element, and structs of arrays of several terms, for kernels over all terms.

Each struct of a term contains that of the next.
"""

from functools import cache
from typing import NamedTuple

import warp as wp

from ..term import Term


class TermFacts(NamedTuple):
    """Facts about the elements of one term, for which a kernel is compiled.

    Attributes:
        term: The :class:`.term.Term`.
        damped: Whether it has damping, at x + h v relative to x.
        shared: Whether all elements share one stiffness; for gathered pairs without damping all of a vertex, with one
            ``stiffness`` per vertex.
        pairs: For gathered pairs, the slots of a vertex as first and as second of a pair; incidences store the other vertex and
            a rest state, slot by slot. None if they store elements.
        rows: For rows of the matrix of a quadratic energy, the slots of a vertex; incidences store the other vertices,
            ``stiffness`` the numbers. Else 0.
        padded: Whether incidences that store elements have equally many slots per vertex, slot by slot.
        exact: Whether elements are evaluated in float64.
    """

    term: Term
    damped: bool = False
    shared: bool = False
    pairs: tuple[int, int] | None = None
    rows: int = 0
    padded: bool = False
    exact: bool = False

    def precision(self, dtype):
        """The type of y and of its rest state."""
        return wp.float64 if self.exact else dtype


@cache
def local_gradient(part: TermFacts, dtype, corrected: bool = False):
    """Device function (k, β, rest, y, dy, h) → kA ∂u/∂y at y plus the force of damping at y + dy, (M, 3).

    Without damping, ``corrected`` evaluates the first at y + dy.
    """
    term, precision = part.term, part.precision(dtype)
    assert not (part.damped and corrected), f"{term.name} is damped, and evaluated with a position residual"
    rest_type, y_type = wp.types.vector(term.parameters, precision), wp.types.matrix((term.rows, 3), precision)
    force_type = wp.types.matrix((term.rows, 3), dtype)
    gradient, measure = term.gradient, term.measure

    @wp.func
    def elastic(k: dtype, beta: dtype, r: rest_type, y: y_type, dy: y_type, h: dtype):
        return (k * measure(r)) * gradient(y, r)

    @wp.func
    def ahead(k: dtype, beta: dtype, r: rest_type, y: y_type, dy: y_type, h: dtype):
        return force_type((precision(k) * measure(r)) * gradient(y + dy, r))

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
    """Struct of the arrays of one term.

    Swept: block b has the pieces offsets[b] to offsets[b+1]; ``codes`` are first element and count of each
    (:mod:`.block_forces`). Gathered: ``codes`` are K·element + corner of the incidences of vertex i from offsets[i] on, or slot
    by slot if padded; for pairs the other vertex, or the vertex itself if empty.
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
    unused: int


def chain_of(parts: tuple[TermFacts, ...], dtype, struct_of=elements_struct):
    """Struct of the arrays of all terms: ``struct_of`` (part, dtype) of the first, and the chain of the others."""
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
