"""Functions of one element, and structs of the arrays of several terms, for kernels that take all terms in one pass.

Such a kernel has one function and one struct of arrays per term, each of which contains those of the following terms.
"""

from functools import cache
from typing import NamedTuple

import warp as wp

from ..term import Term


class TermFacts(NamedTuple):
    """Facts about the elements of one term, for which a kernel is compiled.

    Attributes:
        term: The :class:`.term.Term`.
        damped: Whether it has damping, evaluated at x + h v relative to the state x, see :class:`..term.Dissipation`.
        shared: Whether all elements share one stiffness. For gathered pairs without damping, whether all pairs of a vertex do;
            ``stiffness`` then has one value per vertex.
        pairs: For gathered pairs, the numbers of slots of a vertex as first and as second of a pair. Incidences then store the
            other vertex and a rest state, slot by slot. None if they store elements.
        rows: For the rows of the matrix of a quadratic energy, the number of slots of a vertex. Incidences then store the other
            vertices of the row, slot by slot, and ``stiffness`` its numbers. 0 otherwise.
        padded: Whether incidences that store elements have the same number of slots for each vertex, slot by slot.
        exact: Whether elements are evaluated in double precision, see :func:`..assemble.of_element`.
    """

    term: Term
    damped: bool = False
    shared: bool = False
    pairs: tuple[int, int] | None = None
    rows: int = 0
    padded: bool = False
    exact: bool = False

    def precision(self, dtype):
        """The type of y, and of the rest state from which it is computed."""
        return wp.float64 if self.exact else dtype


@cache
def local_gradient(part: TermFacts, dtype, corrected: bool = False):
    """Device function (k, β, rest, y, dy, h) → kA ∂u/∂y at y plus the force of damping at y + dy, (M, 3).

    Without damping, ``corrected`` evaluates the first at y + dy. A damped term has one dy, so it cannot be corrected too: no
    explicit step with damping is compensated (:func:`warpcloth.fast.compensation.needs_compensation`), and in the gradients of
    other solvers damping is an energy.
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
    """The end of a chain of structs."""

    unused: int


def chain_of(parts: tuple[TermFacts, ...], dtype, struct_of=elements_struct):
    """Struct of the arrays of all terms: that of the first, and the chain of the others.

    Args:
        parts: The facts of each term.
        dtype: A Warp scalar type.
        struct_of: Function (part, dtype) → the struct of one term.
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
