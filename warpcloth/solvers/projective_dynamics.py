"""Projective dynamics: implicit Euler by projections of the elements and one constant matrix, factorised once."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from ..base.checks import choice, number, whole
from ..core.capture import Mirror, Segment
from ..core.constant_matrix import constant_matrices
from ..core.energy import Energy
from ..core.status import UNBALANCED, Residual, Result
from ..core.sums import CHUNKS, Sums
from ..fast.gradient import gradient
from ..kernels import accelerate as kernels
from ..kernels.minimise import add_inertia
from ..numerics.acceleration import LBFGS, Anderson, Chebyshev
from ..numerics.linear import CopyFactors, DiagonalScaling
from ..terms.needs import FINITE, MERGED_DAMPING, PROJECTION
from .facts import Benchmark, Facts, grid
from .solver import Stepper
from .step import ImplicitStep

ACCELERATIONS = ("none", "chebyshev", "anderson", "l-bfgs")


@dataclass(frozen=True)
class ProjectiveDynamics(ImplicitStep):
    """Implicit Euler by a local and a global step in turn (Liu et al. 2013, Bouaziz et al. 2014), from x = x̃.

    For energies ½kA‖y − p(y)‖², y = Gx: with the projections p of all elements fixed, the objective of implicit Euler is least
    where (M/h² + Σ k A GᵀG) x = (M/h²) x̃ + Σ k A Gᵀp. The matrix is constant and scalar and factorised once. As
    ∂u/∂y = y − p(y), one iteration is d ← d − A⁻¹∇φ(d) in terms of d = x − x̃, so that rounding of the solve cures itself. The
    objective φ never rises, and the fixed point is the x(t+h) of :class:`warpcloth.Newton`.

    Motion across stiff elements is slow: of one spring with a fixed end, of length l and rest length L, what is wrong across
    shrinks by k(L/l)/(m/h² + k) an iteration, what is wrong along is gone after one. Hence the accelerations; a proposal whose
    φ is above that of the plain iteration from the same place is dropped for that. Chebyshev needs a bound of that factor and
    takes 1 − min m/(h²D), D the row sums of |A|.

    Attributes:
        dt, substeps, integrator: See :class:`ImplicitStep`.
        iterations: The most iterations a step.
        tolerance: Of the residual, as for :class:`warpcloth.Newton`: the largest unbalanced acceleration of any vertex over
            gravity's (without any, over the largest at x̃).
        acceleration: ``"none"``; ``"chebyshev"`` (Wang 2015); ``"anderson"`` (Peng et al. 2018), in the norm of the matrix;
            ``"l-bfgs"`` (Liu et al. 2017), with the matrix as first Hessian.
        window: Steps that Anderson and L-BFGS remember.
        linear: ``"factorised"``, or ``"jacobi"``: without the matrix, its row sums Dᵢ = Σⱼ|Aᵢⱼ| stand in for it, above which
            it never is, so that φ falls as well, only slower (Wang 2015 for Chebyshev). An iteration then moves nothing further
            than to the next vertices, and until it has converged linear momentum is not kept.

    Raises:
        ValueError: If an option breaks a rule.
    """

    name = "projective-dynamics"
    needs = (FINITE, MERGED_DAMPING, PROJECTION)
    residual = Residual(UNBALANCED, "times the largest at the start of its step")
    facts = Facts(
        benchmarks=(Benchmark({"substeps": 4, "iterations": 20}, cpu=(16, 32, 64), cuda=(32, 64, 128, 256)),),
        runs=(
            *grid([(8, 2), (16, 2), (24, 2), (48, 2), (96, 2)], integrator="midpoint", acceleration="none"),
            *grid([(8, 5), (16, 5)], integrator="bdf2"),
            *grid([(4, 20)]),
        ),
        one_step=tuple({"acceleration": acceleration, "tolerance": 1e-14} for acceleration in ACCELERATIONS),
        limits=("1 + Σk h²/m iterations", "h² = m/(k(L/l − 1))"),
        style=("tab:blue", "^"),
    )

    iterations: int = 20
    tolerance: float = 1e-3
    acceleration: str = "anderson"
    window: int = 5
    linear: str = "factorised"

    def __post_init__(self):
        super().__post_init__()
        whole("iterations", self.iterations, 1)
        number("tolerance", self.tolerance, above=0.0)
        choice("acceleration", self.acceleration, ACCELERATIONS)
        whole("window", self.window, 1)
        choice("linear", self.linear, ("factorised", "jacobi"))

    def bind(self, model):
        """The solver on ``model``, all scratch allocated.

        Raises:
            ValueError: If a term has infinite stiffness, or an energy that is no squared distance.
        """
        self.refuse(model)
        return self._on(ProjectiveDynamicsStepper, model)


class ProjectiveDynamicsStepper(Stepper):
    """:class:`ProjectiveDynamics` on a model.

    Attributes:
        correction: x − x̃ of the last step, (N,) [m].
        iterations: Iterations of the last step.
    """

    def __init__(self, options, model):
        super().__init__(options, model, options.integrator)
        model = self.model
        self.s = 1.0 / self.he**2
        matrices = constant_matrices(model, self.s)
        self._sizes = np.stack([np.asarray(abs(matrix).sum(axis=1)).ravel() for matrix in matrices])
        self._linear = CopyFactors(model, matrices) if options.linear == "factorised" else DiagonalScaling(model, self._sizes)
        self.factorise_seconds = self._linear.seconds
        self._sums, self._gradient_of = Sums(model), gradient(model, corrected=True)
        self.correction, self._gradient, self._w = (model.vectors() for _ in range(3))
        self._work = wp.zeros(model.count, dtype=wp.float64, device=model.device)
        self._acceleration = Mirror(wp.zeros(model.copies, dtype=wp.float64, device=model.device))
        self._active = Mirror(wp.zeros(model.copies, dtype=wp.int32, device=model.device))
        self._add_inertia = model.kernel(add_inertia, model.dtype)
        self._plain_step = model.kernel(kernels.plain_step, model.dtype)
        self._history = None if options.acceleration == "none" else _Accelerator(self)
        self._gravity = np.linalg.norm(model.gravity.numpy().astype(np.float64), axis=1)
        self.iterations = 0
        self._start = Segment(model.device, self._launch_start)
        self._move = Segment(model.device, self._launch_move)
        self._finish = Segment(model.device, lambda: self.launch_finish(self.correction))
        self.integrator.start()

    def step(self):
        self._start()
        first = self._acceleration.read().copy()
        scale = np.where(self._gravity > 0.0, self._gravity, np.where(first != 0.0, first, 1.0))
        if self._history:
            self._history.start()
        self.iterations = 0
        while True:
            residual = self._acceleration.read() / scale
            finite = np.isfinite(residual)
            converged = finite & (residual <= self.options.tolerance)
            active = finite & ~converged
            if not active.any() or self.iterations == self.options.iterations:
                break
            self._active.write(active)
            self._linear.solve(self._gradient, self._w)
            if self._history:
                self._history.propose(self.iterations, active)
            self._move()
            self.iterations += 1
        self._finish()
        self.residual = np.maximum(self.residual, residual)  # keeps NaN
        for copy, before in enumerate(self.results):
            now = Result.CONVERGED if converged[copy] else Result.ITERATIONS_USED_UP if finite[copy] else Result.DIVERGED
            self.results[copy] = before.worse(now)

    def slowest(self):
        """A bound (B,) of the factor by which any part of the error shrinks in a plain iteration, 1 − min s mᵢ/Σⱼ|Aᵢⱼ|.

        For A is at most its row sums, and the Hessian, where nothing is compressed, at least s M.
        """
        mass, free = (array.numpy().reshape(self._sizes.shape) for array in (self.model.mass, self.model.inverse_mass))
        part = np.where(free > 0.0, self.s * mass.astype(np.float64) / self._sizes, 1.0)
        return 1.0 - part.min(axis=1)

    # What the segments record.

    def _launch_start(self):
        self.launch_prediction()
        self.correction.zero_()
        if self._history:
            self._history.slot.zero_()
        self._launch_gradient()

    def _launch_move(self):
        if self._history:
            self._history.launch_move()
        else:
            self.launch_plain_step(self.correction)
        self._launch_gradient()

    def launch_plain_step(self, out):
        """out = d − w."""
        model = self.model
        given = [self._active.array, model.per_copy, self.correction, self._w]
        model.launch(self._plain_step, model.count, given, [out])

    def _launch_gradient(self):
        """∇φ at d, and the largest unbalanced acceleration."""
        self._gradient.zero_()
        self._gradient_of.add(self.state.x, self._gradient, self.correction)
        self.launch_inertia(self.correction, self._gradient)
        self._sums.largest(self.model.inverse_mass, self._gradient, self._acceleration.array)

    def launch_inertia(self, d, gradient):
        """gradient += s M d, 0 for pins; and s/2‖d‖²_M as a sum over vertices."""
        model = self.model
        given = [model.mass, model.inverse_mass, model.gravity, model.per_copy, self.s, 0.0, d]
        model.launch(self._add_inertia, model.count, given, [gradient, self._work])


class _Accelerator:
    """The history of a stepper on the device, and the choice between the plain and the accelerated step."""

    def __init__(self, stepper):
        model, options = stepper.model, stepper.options
        self.stepper, B, device = stepper, model.copies, model.device
        epsilon = 10.0 * float(np.finfo(model.numpy_dtype).eps)
        if options.acceleration == "chebyshev":
            self.method = Chebyshev(B, stepper.slowest())
        else:
            self.method = {"anderson": Anderson, "l-bfgs": LBFGS}[options.acceleration](B, options.window, epsilon)
        m = self.method.window
        self.s, self.y, self.z = (wp.zeros((m, model.count), dtype=model.vec3, device=device) for _ in range(3))
        self.plain, self.accelerated, self.last_gradient, self.last_w, self.unused = (model.vectors() for _ in range(5))
        self.slot = wp.zeros(1, dtype=wp.int32, device=device)
        self.partial = wp.zeros((B, CHUNKS if device.is_cuda else 1, 4 * m), dtype=wp.float64, device=device)
        self.products = Mirror(wp.zeros((B, 4 * m), dtype=wp.float64, device=device))
        self.coefficients = Mirror(wp.zeros((B, 1 + 2 * m), dtype=wp.float64, device=device))
        self.plain_energy, self.energy = (Mirror(wp.zeros(B, dtype=wp.float64, device=device)) for _ in range(2))
        self.energy_of = Energy(model, stepper._sums, corrected=True)
        names = ("note_change", "partial_products", "combine", "choose")
        self.kernels = {name: model.kernel(getattr(kernels, name), model.dtype) for name in names}
        self.kernels |= {name: model.kernel(getattr(kernels, name)) for name in ("finish_products", "next_slot")}
        self._note = Segment(device, self._launch_note)

    def start(self):
        """Before the first iteration of a step."""
        self.method.start()

    def propose(self, iteration, active):
        """Sets the coefficients of the accelerated step of the copies that still iterate."""
        self._note()
        accepted = self.energy.read() <= self.plain_energy.read() if iteration else np.ones(len(active), dtype=bool)
        products = self.products.read().reshape(len(active), 4, -1)
        self.coefficients.write(np.where(active[:, None], self.method.propose(iteration, products, accepted), 0.0))

    def _launch_note(self):
        stepper, model = self.stepper, self.stepper.model
        given = [self.slot, stepper._gradient, stepper._w]
        self._launch("note_change", model.count, given, [self.last_gradient, self.last_w, self.y, self.z])
        given = [self.slot, stepper._gradient, self.s, self.y, self.z, model.per_copy]
        self._launch("partial_products", self.partial.shape, given, [self.partial])
        self._launch("finish_products", self.products.array.shape, [self.partial], [self.products.array])

    def launch_move(self):
        """d = the better of the plain and the accelerated step."""
        stepper, model = self.stepper, self.stepper.model
        N, n, d = model.count, model.per_copy, stepper.correction
        stepper.launch_plain_step(self.plain)
        given = [self.coefficients.array, n, d, stepper._w, self.s, self.z]
        self._launch("combine", N, given, [self.accelerated])
        self._launch_energy(self.plain, self.plain_energy.array)
        self._launch_energy(self.accelerated, self.energy.array)
        self._launch("next_slot", 1, [self.slot, self.method.window], [])
        given = [self.slot, n, self.plain, self.accelerated, self.plain_energy.array, self.energy.array]
        self._launch("choose", N, given, [d, self.s])

    def _launch_energy(self, d, out):
        """out (B,) = φ(d)."""
        stepper, model = self.stepper, self.stepper.model
        stepper.launch_inertia(d, self.unused)
        stepper._sums.sum(stepper._work, model.per_copy, out)
        self.energy_of.add(stepper.state.x, out, d)

    def _launch(self, name, dim, inputs, outputs):
        self.stepper.model.launch(self.kernels[name], dim, inputs, outputs)
