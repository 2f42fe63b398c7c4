"""Projective dynamics: implicit Euler by projections and one constant matrix."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import warp as wp

from ..base.checks import ranged
from ..core.capture import Mirror, Segment
from ..core.constant_matrix import constant_matrices
from ..core.status import UNBALANCED, Residual
from ..core.sums import Sums
from ..fast.plan import plan
from ..kernels.accelerate import plain_step
from ..kernels.terms.air import AIR
from ..model.model import Model
from ..numerics.accelerated_step import AcceleratedStep
from ..numerics.acceleration import accelerated
from ..numerics.contact_system import ContactSystem
from ..numerics.inertia import Inertia
from ..numerics.iterate import ResidualScale
from ..numerics.linear import DiagonalScaling, solve_copies
from ..numerics.local_weights import curvatures
from ..terms.needs import CONSTANT_MATRIX, FINITE
from .facts import Benchmark, Facts, grid
from .implicit import ImplicitStepper
from .solver import Stepper
from .step import ImplicitStep

ACCELERATIONS = ("none", "chebyshev", "anderson", "l-bfgs")


@dataclass(frozen=True)
class ProjectiveDynamics(ImplicitStep):
    """Implicit Euler by alternating local and global steps, from x = x̃ (Liu et al. 2013, Bouaziz et al. 2014).

    For energies ½kA‖y − p(y)‖², y = Gx, with the projections p of all elements fixed, the objective φ of implicit Euler has its
    minimum at S x = (M/h²) x̃ + Σ k A Gᵀp, with the constant matrix S = M/h² + Σ k A GᵀG. As ∂u/∂y = y − p(y), one iteration is
    d ← d − S⁻¹∇φ(d) with d = x − x̃. φ never rises, and the fixed point is the x(t+h) of :class:`warpcloth.Newton`.

    An energy without a projection has k A s GᵀG in S, with the curvature s = ‖∂²u/∂y²‖ at rest (Liu et al. 2017). If a step
    raises φ, its length is halved. Air has no part in S; the iteration converges where hΣ½ρAC|u|/3m < 1, summed over the
    triangles of each vertex.

    For one spring with a fixed end, of length l and rest length L, the error perpendicular to it shrinks only by the factor
    k(L/l)/(m/h² + k) in each iteration, which acceleration improves. Chebyshev takes its bound 1 − min m/(h²D), D the row sums
    of |S|. The plain step is taken where it has the smaller φ.

    Attributes:
        dt, substeps, integrator, error: See :class:`ImplicitStep`.
        iterations: Maximum number of iterations in a step.
        tolerance: Tolerance of the residual, that of :class:`warpcloth.Newton`.
        acceleration: ``"none"``; ``"chebyshev"`` (Wang 2015); ``"anderson"`` (Peng et al. 2018), in the norm of the matrix;
            ``"l-bfgs"`` (Liu et al. 2017), with the matrix as first Hessian.
        window: Number of iterations that Anderson and L-BFGS use.
        linear: ``"factorised"``, or ``"jacobi"``, which replaces S by the diagonal of its row sums Dᵢ = Σⱼ|Sᵢⱼ| (Wang 2015 for
            Chebyshev): slower, and linear momentum is not conserved before convergence. On CUDA, above 300 vertices,
            ``"factorised"`` replaces S⁻¹ by a few cycles of multigrid, a constant B with about 0.6 S⁻¹ ≤ B ≤ S⁻¹.

    Examples:
        >>> import warpcloth as wc
        >>> scene = wc.Scene(wc.Mesh.chain(2), masses=[1, 1], terms=[wc.Spring(stiffness=1e3)], pins=[0])
        >>> wc.simulate(scene, wc.ProjectiveDynamics(substeps=4, tolerance=1e-3), frames=10, dtype="float64").status.ok
        True
    """

    name = "projective-dynamics"
    needs, locks = (FINITE, CONSTANT_MATRIX), True
    touches_itself = double_on_cpu = True
    residual = Residual(UNBALANCED)
    facts = Facts(
        method="implicit steps by local projections and global solves with a constant matrix",
        suits="animation with few iterations; stretches little from the first iteration on",
        weakness=(
            "motion perpendicular to stiff springs lags: each iteration multiplies its error by 1 − μ, where μ is only 0.008 "
            "for n = 8 and h = 1/240 s"
        ),
        benchmarks=(Benchmark({"substeps": 4, "iterations": 20}, cpu=(16, 32, 64), cuda=(32, 64, 128, 256)),),
        runs=(
            *grid([(8, 2), (16, 2), (24, 2), (48, 2), (96, 2)], integrator="midpoint", acceleration="none"),
            *grid([(8, 5), (16, 5)], integrator="bdf2"),
            *grid([(4, 20)]),
        ),
        one_step=tuple({"acceleration": acceleration, "tolerance": 1e-14} for acceleration in ACCELERATIONS),
        limits=("1 + Σk h²/m iterations", "h² = m/(k(L/l − 1))"),
    )

    iterations: int = ranged(20, whole=True, least=1)
    tolerance: float = ranged(1e-3, above=0.0)
    acceleration: Literal["none", "chebyshev", "anderson", "l-bfgs"] = "anderson"
    window: int = ranged(5, whole=True, least=1)
    linear: Literal["factorised", "jacobi"] = "factorised"

    def bind(self, model: Model) -> Stepper:
        """Binds the solver to ``model``.

        Raises:
            ValueError: A term has infinite stiffness, or cells with an energy that is not quadratic.
        """
        self.refuse(model)
        return self._on(ProjectiveDynamicsStepper, model)


class ProjectiveDynamicsStepper(ImplicitStepper):
    """:class:`ProjectiveDynamics` on a model.

    Attributes:
        correction: x − x̃ of the last step, (N,) [m].
        gradient, w: ∇φ there, (N,) [N], and S⁻¹∇φ (N,) [m].
    """

    def __init__(self, options, model):
        super().__init__(options, model)
        model = self.model
        self.inertia, self.sums = Inertia(model, 1.0 / self.he**2), Sums(model)
        constant, bounded = [], True  # whether the matrix bounds the Hessian, so that φ never rises with a plain step
        for elements in model.terms:
            if elements.collider is not None:
                continue
            if elements.term is AIR:
                bounded = False
                continue
            if elements.term.whole.project is None:
                elements, bounded = elements.weighed(curvatures(model, elements)), False
            constant.append(elements)
        matrices = constant_matrices(model.with_terms(constant), self.inertia.s)
        self._sizes = np.stack([np.asarray(abs(matrix).sum(axis=1)).ravel() for matrix in matrices])
        self._linear = solve_copies(model, matrices) if options.linear == "factorised" else DiagonalScaling(model, self._sizes)
        self.factorise_seconds = self._linear.seconds
        self.correction, self.gradient, self.w = (model.vectors() for _ in range(3))
        self._acceleration, self._active = Mirror(model.scalars()), Mirror(model.scalars(wp.int32))
        self._contact = None
        if model.colliders is not None or model.dynamic:
            given = model, self.state.x, self.correction, self._linear, self.gradient, self.w, self._active.array
            self._contact = ContactSystem(*given, sums=self.sums, s=self.inertia.s, pairs=self.pairs)
        self._gradient_of = plan(model).gradient(corrected=True)
        self._plain_step = model.kernel(plain_step, model.dtype)
        self._scale = ResidualScale(model).acceleration
        self._accelerated = None
        if options.acceleration != "none" or not bounded:
            method = accelerated(options.acceleration, model, options.window, self.slowest)
            falls = self._contact is not None or not bounded
            self._accelerated = AcceleratedStep(self, method, falls, shortens=not bounded)
        self._record()
        self.ready()

    def _record(self):
        self._start = Segment(self.model.device, self._launch_start)
        self._move = Segment(self.model.device, self._launch_move)

    def record_again(self):
        self._record()
        self._contact.record()
        self._record_end()

    def start(self):
        self._start()
        if self._accelerated:
            self._accelerated.start()
            if self._contact:
                self._contact.start()

    def measure(self):
        return self._acceleration.read() / self._scale, {}

    def iterate(self, active):
        self._active.update(active)
        self._linear.solve(self.gradient, self.w)
        if self._contact:
            if self._accelerated:
                self._contact.note(self._accelerated.stayed())
            self._contact.correct(active)
        if self._accelerated:
            self._accelerated.propose(active)
        self._move()

    def slowest(self):
        """Returns an upper bound (B,) of the factor by which a plain iteration multiplies the error, if nothing is compressed.

        That is 1 − (1 − ε) min s mᵢ/Σⱼ|Sᵢⱼ|, with the relative error ε of solves.
        """
        mass, free = (array.numpy().reshape(self._sizes.shape) for array in (self.model.mass, self.model.inverse_mass))
        part = np.where(free > 0.0, self.inertia.s * mass.astype(np.float64) / self._sizes, 1.0)
        return 1.0 - (1.0 - self._linear.error) * part.min(axis=1)

    # What the segments record.

    def _launch_start(self):
        self.launch_prediction()
        self.launch_first(self.correction)
        if self._accelerated:
            self._accelerated.launch_start()
        self._launch_gradient()

    def _launch_move(self):
        if self._accelerated:
            self._accelerated.launch_move()
        else:
            self.launch_plain_step(self.correction)
            self.filter.launch_trial(self.state.x, self.correction)
        self._launch_gradient()

    def launch_plain_step(self, out):
        model = self.model
        given = [self.correction, self.w, self._active.array, model.per_copy]
        model.launch(self._plain_step, model.count, given, [out])

    def _launch_gradient(self):
        self.gradient.zero_()
        self._gradient_of.add(self.state.x, self.gradient, self.correction)
        self.inertia.add(self.correction, self.gradient)
        self.sums.largest(self.model.inverse_mass, self.gradient, self._acceleration.array)
