"""The record of an energy: what a file in ``kernels/terms`` fills in, and all that a factory or a solver may know of it."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any


class HessianPolicy(IntEnum):
    """The ways in which ``hessian`` treats the negative curvature of an energy.

    ``RAW`` returns ∂²u/∂y² as it is. ``CLAMP`` drops the negative part, ``ABSOLUTE`` turns its sign; both are
    semi-definite, and equal to ``RAW`` where that is. Closed forms, no numerical eigenvalues.
    """

    RAW = 0
    CLAMP = 1
    ABSOLUTE = 2


@dataclass(frozen=True)
class Dissipation:
    """The dissipation D = Σ (Aβ/2hₑ)‖s(y) − s̃‖² of a step as an energy whose rest state s̃ is set where the step begins.

    s is the term's own invariant and s̃ that of the last state but for a change that makes (s − s̃)/hₑ the rate of s as the
    integrator has it, see :func:`warpcloth.kernels.damping.set_damped_rest`. Where u = ½‖s − s̄‖² with the same s, D merges with
    it: of a stiffness k + β/hₑ the rest state is s̄ + share·(s̃ − s̄), share = (β/hₑ)/(k + β/hₑ); with share 1 it is that of D
    alone.

    Attributes:
        change: (y, another y, rest state of the term) → s of the other − s of y.
        rest: (y, s̃ − s of y, rest state of the term, share) → rest state of ``term``.
        merges: Whether D merges with the energy; else it is one beside it.
        term: The :class:`Term` of the sum, or of D alone where it does not merge, with the same weights; None for the term
            itself.
    """

    change: Any
    rest: Any
    merges: bool = True
    term: Any = None


@dataclass(frozen=True)
class Term:
    """An energy U = Σₑ kₑ Aₑ u(yₑ) over stencils of ``vertices`` = K vertices.

    The local coordinate y = Σᵢ wᵢ ⊗ xᵢ, a matrix of ``rows`` = M rows of 3, is linear in the vertices. The functions are
    ``@wp.func``, generic over float32 and float64; ``rest`` below is one element's vector of ``parameters`` = P numbers.
    None of them knows the stiffness kₑ [the term's unit]: the factories multiply by kₑ Aₑ.

    Attributes:
        name: The name of the energy in reports and kernels.
        vertices: K; 0 of a term whose elements have any number of vertices, see :mod:`warpcloth.terms.sparse`.
        rows: M.
        parameters: P.
        rest_state: NumPy function (points (n, 3) [m], stencil (E, K), …) → (E, P), the rest state of every element; further
            arguments, by keyword, are what the material has beside its stiffness.
        weight: (rest, i) → (M,), the weights of vertex i in y; also ∂y/∂xᵢ. None where K is 0.
        measure: (rest) → Aₑ.
        energy: (y, rest) → u.
        gradient: (y, rest) → ∂u/∂y (M, 3).
        hessian: (y, rest, policy) → ∂²u/∂y² (3M, 3M), y row by row, see :class:`HessianPolicy`.
        dead_zone: Whether there is a range about the rest shape without energy; ``rest_state`` then takes the ratios
            ``least`` and ``most`` of its ends.
        max_lengths: NumPy function (points (n, 3) [m], stencil (E, K), rest (E, P)) → (pairs (E·m, 2), lengths (E·m,) [m],
            factors (E·m,)), element by element: pairs that the energy keeps no farther apart than these lengths (infinite: it
            does not), and how stiff a spring between them would be, kₑ = 1; or None.
        cells: Whether elements of K = 1 are the vertices of cells of any size, see :class:`warpcloth.model.model.Cells`.
        cell: Of the share that a vertex has of a cell the :class:`Term` of the cell, see :mod:`.sparse`; else None.
        project: (y, rest) → p(y) (M, 3), the nearest point of the constraint set, with u = ½‖y − p(y)‖²; or where there is a
            ``prox`` too, any p with ∂u/∂y = y − p(y); or None.
        prox: (v, rest, compliance) → argmin u(y) + ‖y − v‖²/(2·compliance) (M, 3), compliance 0 or more, in closed form, the
            local step where u is not ½‖y − p(y)‖²; or None.
        prox_from: (y, v, rest, compliance) → the same of u as it is about y, the position before the step, for an energy of
            which v may be nearer to another branch, such as the far side of a ball; or None.
        idle: (y, rest, margin) → 1 where there is surely no force within ``margin`` of y, which is quicker to tell than the
            force, else 0; of terms with K = 1; or None.
        clearance: (y, rest) → a distance within which of y there is surely no force, 0 or less where there may be one at y; of
            terms with ``idle``; or None.
        secant: (y, rest) → s, from 0 to 1: where p moves with y, y − p is s times the distance to a point that moves less, and
            constraint rows, which hold p fixed in an iteration, take that point and s k instead; or None.
        linear: Whether p does not depend on y, so that y − p is linear in the vertices.
        quadratic: Whether p is 0 and the weights of an element add up to 0: U is then quadratic in the differences of vertices.
        constraint: (y, rest) → C, a scalar with u = ½C²; or None, and with it the next four.
        constraint_gradient: (y, rest) → ∂C/∂y (M, 3).
        constraint_hessian: (y, rest) → ∂²C/∂y² (3M, 3M).
        stiffening: (y, rest, tension) → B (N, 3M), with BᵀB the positive half of tension·∂²C/∂y².
        stiffening_rows: N.
        dissipation: :class:`Dissipation`, or None for what cannot be damped.
        bounded: The :class:`Term` on the same elements that explicit steps take instead, as the curvature of this one has no
            bound: that of its energy is at most 1, and its ``hessian`` is one that is nowhere smaller than the curvature, by
            which steps are limited; or None.
    """

    name: str
    vertices: int
    rows: int
    parameters: int
    rest_state: Callable
    weight: Any
    measure: Any
    energy: Any
    gradient: Any
    hessian: Any
    dead_zone: bool = False
    max_lengths: Callable | None = None
    cells: bool = False
    cell: Any = None
    project: Any = None
    prox: Any = None
    prox_from: Any = None
    idle: Any = None
    clearance: Any = None
    secant: Any = None
    linear: bool = False
    quadratic: bool = False
    constraint: Any = None
    constraint_gradient: Any = None
    constraint_hessian: Any = None
    stiffening: Any = None
    stiffening_rows: int = 0
    dissipation: Dissipation | None = None
    bounded: Any = None

    @property
    def whole(self):
        """The term of the cells that it is a share of, or itself."""
        return self.cell or self

    @property
    def moves(self):
        """Whether it has a local step: a projection, a scalar constraint, a prox; of cells with weights a quadratic energy."""
        if self.vertices == 0:
            return self.quadratic
        return any(function is not None for function in (self.project, self.constraint, self.prox))
