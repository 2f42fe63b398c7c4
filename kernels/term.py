"""The record of an energy, all that kernels and solvers know of it."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any


class HessianPolicy(IntEnum):
    """The factor of the negative part of ∂²u/∂y² in ``hessian``, between these too.

    ``RAW`` keeps that part, ``CLAMP`` drops it, ``ABSOLUTE`` flips its sign. The latter two are semi-definite, in closed form,
    and equal ``RAW`` where that is.
    """

    RAW = 1
    CLAMP = 0
    ABSOLUTE = -1


@dataclass(frozen=True)
class Dissipation:
    """The dissipation D = Σ (Aβ/2hₑ)‖s(y) − s̃‖² of a step, as an energy with a rest state s̃.

    s is an invariant of the term, and (s − s̃)/hₑ its rate by the integrator. With u = ½‖s − s̄‖², D merges: the sum has the
    stiffness k + β/hₑ and the rest state s̄ + share·(s̃ − s̄), share = (β/hₑ)/(k + β/hₑ), or 1 for D alone.

    Attributes:
        change: (y, other y, rest state of the term) → s(other y) − s(y).
        rest: (y, s̃ − s(y), rest state of the term, share) → rest state of ``term``.
        merges: Whether D merges with the energy.
        term: The :class:`Term` of the sum, or of D alone; None for the term itself.
    """

    change: Any
    rest: Any
    merges: bool = True
    term: Any = None


@dataclass(frozen=True)
class Term:
    """An energy U = Σₑ kₑ Aₑ u(yₑ) over stencils of ``vertices`` = K vertices.

    The local coordinate y = Σᵢ wᵢ ⊗ xᵢ (M, 3), with ``rows`` = M, is linear in the vertices. The functions are ``@wp.func``,
    generic over float32 and float64; ``rest`` has one element's ``parameters`` = P numbers. Kernels multiply by kₑ Aₑ.

    Attributes:
        name: Name of the energy in reports and kernels.
        vertices: K; 0 for any number, see :mod:`warpcloth.terms.sparse`.
        rows: M.
        parameters: P.
        rest_state: NumPy function (points (n, 3) [m], stencil (E, K), …) → (E, P); keywords are material parameters but the
            stiffness.
        weight: (rest, i) → (M,), the weights of vertex i in y, ∂y/∂xᵢ; None where K is 0.
        measure: (rest) → Aₑ.
        energy: (y, rest) → u.
        gradient: (y, rest) → ∂u/∂y (M, 3).
        hessian: (y, rest, negative) → ∂²u/∂y² (3M, 3M), y row by row, its negative part times ``negative``.
        dead_zone: Whether the energy is 0 about the rest shape, in a range whose ends ``rest_state`` takes as ratios ``least``
            and ``most``.
        max_lengths: NumPy function (points (n, 3) [m], stencil (E, K), rest (E, P)) → pairs (E·m, 2), their largest distances
            (E·m,) [m] (infinite: any), and stiffness of a spring between them for kₑ = 1, (E·m,); or None.
        cells: Whether elements of K = 1 are vertices of cells of any size.
        cell: For a vertex of a cell, the :class:`Term` of the cell; else None.
        project: (y, rest) → p(y) (M, 3), the nearest point of the constraint set, with u = ½‖y − p(y)‖²; with a ``prox``, any p
            with ∂u/∂y = y − p(y); or None.
        prox: (v, rest, compliance) → argmin u(y) + ‖y − v‖²/(2·compliance) (M, 3), compliance ≥ 0: the local step if u is not
            ½‖y − p(y)‖²; or None.
        prox_from: (y, v, rest, compliance) → that of the branch of u at y, the position before the step, as v may be nearer to
            another; or None.
        idle: (y, rest, margin) → 1 if there is surely no force within ``margin`` of y, else 0, for K = 1; or None.
        clearance: (y, rest) → a radius about y surely without force, or ≤ 0, for terms with ``idle``; or None.
        gap: Of contact with a collider, (y, rest) → the distance and its gradient; or None.
        law: Of friction with a collider, its :class:`.coulomb.Law`; or None.
        secant: (y, rest) → s, 0 to 1, if p moves with y: y − p is s times the distance to a point that moves less, which
            constraint rows hold, with s k; or None.
        linear: Whether p does not depend on y; the Hessian is then constant.
        quadratic: Whether p is 0 and an element's weights add up to 0, so that U is quadratic in differences of vertices.
        curvature: Of sparse cells that are not quadratic, the largest eigenvalue of ∂²u/∂y² at rest; or None.
        constraint: (y, rest) → C, a scalar with u = ½C²; or None, like the next four fields.
        constraint_gradient: (y, rest) → ∂C/∂y (M, 3).
        constraint_hessian: (y, rest) → ∂²C/∂y² (3M, 3M).
        stiffening: (y, rest, tension) → B (N, 3M), with BᵀB the positive half of tension·∂²C/∂y².
        stiffening_rows: N.
        dissipation: :class:`Dissipation`, or None if it cannot be damped.
        bounded: If the curvature has no bound, the :class:`Term` of explicit steps on the same elements, of curvature ≤ 1,
            whose ``hessian`` is an upper bound; or None.
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
    gap: Any = None
    law: Any = None
    secant: Any = None
    linear: bool = False
    quadratic: bool = False
    curvature: float | None = None
    constraint: Any = None
    constraint_gradient: Any = None
    constraint_hessian: Any = None
    stiffening: Any = None
    stiffening_rows: int = 0
    dissipation: Dissipation | None = None
    bounded: Any = None

    @property
    def whole(self):
        """The term of the cell, for the element of its vertex; else this term."""
        return self.cell or self

    @property
    def moves(self):
        """Whether it has a local step in closed form: a projection, constraint or prox; with cells, a quadratic energy."""
        if self.vertices == 0:
            return self.quadratic
        return any(function is not None for function in (self.project, self.constraint, self.prox))


@dataclass(frozen=True)
class PairTerm:
    """The record of an energy of pairs.

    Attributes:
        name: Its name in reports.
        module: Name of the Warp module of its kernels, without the precision.
        rows: The number of its constraint rows.
        data: Warp struct of the values of each pair in the step, among them its normal n.
        near: Function of a precision, which makes the device function (pairs, data, e, x, d, always) → whether pair e may have
            a force at x + d, v, n and w, for a sweep. v is the y of friction, and the gap along n of contact. With ``always``,
            w and v are found in any case.
        push: Device function (data, e, v, n, D, least, h, hard) → λ = −h²∂U/∂y at v + Dλ [kg·m], v without the force of the
            pair. D is Σ wᵢ²/mᵢ along n, and ``least`` its bound for ``hard`` pairs, see :mod:`.contact.pair_sweeps`.
        row: Device function (pairs, data, e, x, d) → :class:`.contact.pair_sums.PairRow`.
        isotropic: Whether D is that of a vertex without locked axes, because ``push`` needs one D for all directions.
        turns: Whether w changes with the positions, see :class:`.contact.pair_sums.PairForces`. The data then has a ``normal``.
    """

    name: str
    module: str
    rows: int
    data: Any
    near: Callable
    push: Callable
    row: Callable
    isotropic: bool
    turns: bool = False

    def of(self, dtype, scatters):
        """Returns the name of the module of its sums. Those that gather are in one of their own, for the CPU needs none."""
        return f"{self.module}.{dtype.__name__}" + ("" if scatters else ".gather")
