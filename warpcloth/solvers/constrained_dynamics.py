"""Constrained dynamics: implicit Euler with multipliers of compliant constraints."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import warp as wp

from ..base.checks import ranged
from ..core.capture import Mirror, Segment
from ..core.status import Residual, Result
from ..core.sums import RowSums, Sums
from ..kernels import elementwise as kernels
from ..kernels.work import add_scaled
from ..model.model import Model
from ..numerics.constraints import Constraints
from ..numerics.iterate import ResidualScale
from ..numerics.linear import ConjugateGradients, FactorisedRows
from ..numerics.multigrid import MIN_VERTICES
from ..numerics.primal import PrimalSolver
from ..numerics.search import Search
from ..terms.needs import FINITE, MERGED_DAMPING, ROWS, STEADY_ROWS
from .facts import Benchmark, Facts, grid
from .implicit import ImplicitStepper
from .solver import Stepper
from .step import ImplicitStep

# Maximum number of iterations of one conjugate gradient solve.
LINEAR_ITERATIONS = 10_000
# Hard constraints contradict one another if the acceleration that would close one at the end exceeds this fraction of gravity.
CARRIED = 1e-2


@dataclass(frozen=True)
class ConstrainedDynamics(ImplicitStep):
    """Implicit Euler with compliant constraints and multipliers λ (Servin, Lacoursière and Melin 2006, *Interactive simulation
    of elastic deformable materials*; Tournier et al. 2015, *Stable constrained dynamics*), from x = x̃ and λ = 0.

    An energy ½kA·C² is a constraint C with λ = −kAh²C. With J = ∂C/∂x and α̃ = 1/(kAh²), 0 for infinite stiffness, each
    iteration solves

        [M̃, −Jᵀ; J, α̃][Δx; Δλ] = −[M(x − x̃) − Jᵀλ; C(x) + α̃λ]

    through (J M̃⁻¹Jᵀ + α̃)Δλ = −(C + α̃λ) + J M̃⁻¹(M(x − x̃) − Jᵀλ).
    Springs and hinges have a scalar C; other terms have the rows C = y − p(y) with p fixed in an iteration; sliding friction
    has those of a softer spring to its anchor. The fixed point is the x(t+h) of :class:`warpcloth.Newton`, and for infinite
    stiffness the point of C = 0 that is nearest to x̃.

    One iteration with M̃ = M is the published method. It leaves out −λ∂²C, so a spring overshoots perpendicular to itself if
    its tension is above about m l/h². More iterations need a safeguard: geometric stiffness (Tournier et al. 2015) adds
    [−λ∂²C]₊ to M̃; a line search on 1/(2h²)‖x − x̃‖²_M + U shortens Δx.

    Constraints may be redundant: α̃ of a hard one is at least ε^0.7 of the diagonal of J W Jᵀ, so a gap of that fraction
    (1e-11, in float32 1e-5) of the move that they cause in a step remains. Those that contradict one another end at a
    compromise; the status says so, and their violation is the residual. A hard spring of rest length 0 may not converge.

    Attributes:
        dt, substeps, integrator, error: See :class:`ImplicitStep`.
        iterations: Maximum number of iterations in a step.
        tolerance: Tolerance of the residual, relative to :class:`warpcloth.numerics.iterate.ResidualScale`: the largest
            unbalanced acceleration of a vertex, ‖M(x − x̃) − Jᵀλ‖/(m h²), or the largest one with which a single constraint
            would reach C + α̃λ = 0 in a step.
        stabilisation: ``"none"``, ``"geometric-stiffness"`` or ``"line-search"``, which is for finite stiffness.
        linear: ``"cg"`` solves by conjugate gradients over λ; on meshes of 200 vertices and more over positions, with
            multigrid, unless rigid clusters, plates or self-contact have rows. ``"factorised"`` factorises on the host.
    """

    name = "constrained-dynamics"
    needs, locks = (MERGED_DAMPING, ROWS, STEADY_ROWS), True
    touches_itself = True
    facts = Facts(
        method="implicit steps with hard or compliant constraints and Lagrange multipliers",
        suits="constraints of any stiffness, met at the point nearest to x̃; bodies that hang from one another",
        weakness="slower than `Newton` on soft cloth; one iteration overshoots",
        benchmarks=(Benchmark({"substeps": 4, "iterations": 1}, cpu=(8, 16, 32), cuda=(16, 32, 64)),),
        runs=(
            *grid([(4, 1), (8, 1), (16, 1), (32, 1)], integrator="midpoint"),
            *grid([(4, 1)], integrator="bdf2"),
            *grid([(4, 1), (16, 1)]),
        ),
        # Its linear systems are solved to a tenth of the tolerance, and none better than that costs less.
        one_step=tuple(
            {"stabilisation": stabilisation, "tolerance": 1e-8} for stabilisation in ("geometric-stiffness", "line-search")
        ),
        limits=("h² = m/(k(L/l − 1))",),
    )
    residual = Residual("largest residual of a vertex or a constraint (as an acceleration)")

    iterations: int = ranged(20, whole=True, least=1)
    tolerance: float = ranged(1e-3, above=0.0)
    stabilisation: Literal["none", "geometric-stiffness", "line-search"] = "geometric-stiffness"
    linear: Literal["cg", "factorised"] = "cg"

    def bind(self, model: Model) -> Stepper:
        """Binds the solver to ``model``.

        Raises:
            ValueError: A term has no constraint, or infinite stiffness where that is not allowed.
        """
        self.refuse(model)
        self.refuse_hard(model)
        if self.stabilisation == "line-search":
            self.refuse(model, (FINITE,), "stabilisation='line-search'", "stabilisation='geometric-stiffness'")
        return self._on(ConstrainedDynamicsStepper, model)


class ConstrainedDynamicsStepper(ImplicitStepper):
    """:class:`ConstrainedDynamics` on a model.

    Attributes:
        constraints: The :class:`warpcloth.numerics.constraints.Constraints`, with λ of the last step.
        correction: x − x̃ of the last step, (N,) [m].
    """

    def __init__(self, options, model):
        super().__init__(options, model)
        self._build()
        self.ready()

    def _build(self):
        options, model, device = self.options, self.model, self.model.device
        self.constraints = Constraints(model, self.he, options.stabilisation == "geometric-stiffness")
        self._sums, self._row_sums = Sums(model), RowSums(model, self.constraints.per_copy)
        self._search = None
        if options.stabilisation == "line-search":
            self._search = Search(model, self.state.x, self._sums, 1.0 / self.he**2, self.filter)
            self.correction, self._direction, self._step = self._search.correction, self._search.direction, self._search.step
        else:
            self.correction, self._direction = model.vectors(), model.vectors()
            self._step = model.scalars()
        self._moves, self._mismatch = model.vectors(), model.vectors()
        self._right, self._change = (wp.zeros(self.constraints.count, dtype=model.dtype, device=device) for _ in range(2))
        self._ones = model.constant(1.0, model.count)

        self._active, self._stepped = Mirror(model.scalars(wp.int32)), Mirror(self._step)
        if options.linear == "cg":
            through = model.per_copy >= MIN_VERTICES and self.constraints.of_elements
            self._linear = (PrimalSolver if through else ConjugateGradients)(self.constraints, LINEAR_ITERATIONS)
            self._tolerance = Mirror(self._linear.tolerance)
        else:
            self._linear = FactorisedRows(self.constraints, (self._right, self._change, self._active.array))
        self._unbalanced, self._open, self._rounding, self._carried = (Mirror(model.scalars()) for _ in range(4))
        self._of_vectors = model.launcher(((kernels.mismatch, kernels.add_step), model.dtype), ((kernels.begin_step,),))
        self._of_rows = model.launcher(((kernels.negate,), model.dtype), ((kernels.add_step,), model.dtype, True))
        self._scale = ResidualScale(model).acceleration
        self._start = Segment(device, self._launch_start)
        self._solve = Segment(device, self._launch_solve) if self._linear.capturable else self._launch_solve
        self._move = Segment(device, self._launch_move)

    def record_again(self):
        self._build()
        self._record_end()

    def start(self):
        self._start()
        self._stuck = np.zeros(self.model.copies, dtype=bool)

    def measure(self):
        self._residual = self._accelerations() / self._scale
        rounded = self._residual * self._scale * self.he**2 <= self._rounding.read()
        return self._residual, {Result.ROUNDED: rounded, Result.STALLED: self._stuck}

    def iterate(self, active):
        self._active.write(active)
        if self._linear.capturable:  # to a tenth of the tolerance of the step
            least = 1e3 * float(np.finfo(self.model.numpy_dtype).eps)
            wanted = 0.1 * self.options.tolerance / np.where(active, self._residual, 1.0)
            self._tolerance.write(np.clip(wanted, least, 0.1))
        self._solve()
        self._move()
        self._stuck = self._stepped.read() == 0.0

    def constraint_forces(self, collider=None):
        """See :meth:`Stepper.constraint_forces`: adds −Jᵀλ/hₑ²."""
        model, constraints = self.model, self.constraints
        of_terms = [part for part in constraints.parts if part.elements is not None]
        hard = [part for part in of_terms if part.elements.hard and collider in (None, part.elements.collider)]
        add, pulls = model.kernel(add_scaled, model.dtype), model.vectors()

        def launch(out):
            pulls.zero_()
            for part in hard:
                part.launch_transpose(constraints.multipliers, pulls)
            model.launch(add, model.count, [pulls, -1.0 / self.he**2], [out])

        return launch

    def note(self, results, residual):
        """Notes how a step ended. Hard constraints that keep a gap contradict one another."""
        carried = self._carried.read() / (self._scale * self.he**2)
        resolved = self._carried.read() > self._rounding.read()  # the rounding of positions and lengths leaves gaps too
        contradicted = np.isfinite(residual) & resolved & (carried > max(self.options.tolerance, CARRIED))
        results = [Result.CONTRADICTED if each else result for result, each in zip(results, contradicted, strict=True)]
        super().note(results, np.where(contradicted, np.maximum(residual, carried), residual))

    def _accelerations(self):
        """Returns the larger of both accelerations of each copy, (B,) [m/s²]."""
        return np.maximum(self._unbalanced.read(), self._open.read()) / self.he**2

    # What the segments record.

    def _launch_start(self):
        self.launch_prediction()
        self.launch_first(self.correction)
        if self._search:
            self._search.launch_again()
        self.constraints.multipliers.zero_()
        self._launch_linearise()

    def _launch_linearise(self):
        constraints, model = self.constraints, self.model
        constraints.launch_linearise(self.state.x, self.correction)
        constraints.launch_moves(constraints.multipliers, self._moves)
        self._of_vectors(kernels.mismatch, model.count, [self.correction, self._moves], [self._mismatch])
        self._of_rows(kernels.negate, constraints.count, [constraints.gap], [self._right])
        constraints.launch_apply(self._mismatch, self._right)
        self._sums.largest(self._ones, self._mismatch, self._unbalanced.array)
        self._row_sums.largest(constraints.residual, self._open.array)
        self._row_sums.largest(constraints.rounding, self._rounding.array)
        self._row_sums.largest(constraints.carried, self._carried.array)

    def _launch_solve(self):
        self._change.zero_()
        self._linear.solve(self._right, self._change, self._active.array)

    def _launch_move(self):
        """Launches Δx = W JᵀΔλ − (x − x̃ − W Jᵀλ), and a step along Δx and Δλ."""
        model, constraints = self.model, self.constraints
        constraints.launch_moves(self._change, self._moves)
        self._of_vectors(kernels.mismatch, model.count, [self._moves, self._mismatch], [self._direction])
        self.filter.launch_limit(self._direction)
        if self._search:
            self._search.launch(self._active.array)
        else:
            self._of_vectors(kernels.begin_step, model.copies, [self._active.array], [self._step])
            given = [self._step, self._direction, model.per_copy]
            self._of_vectors(kernels.add_step, model.count, given, [self.correction])
        self.filter.launch_trial(self.state.x, self.correction)
        given = [self._step, self._change, constraints.per_copy]
        self._of_rows(kernels.add_step, constraints.count, given, [constraints.multipliers])
        self._launch_linearise()
