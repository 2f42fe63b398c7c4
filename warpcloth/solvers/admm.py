"""ADMM: implicit Euler split into element problems and a vertex problem, coupled by multipliers."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import warp as wp

from ..base.checks import ranged
from ..core.capture import Mirror, Segment
from ..core.constant_matrix import constant_matrices
from ..core.gradient import Gradient
from ..core.status import Residual
from ..core.sums import Sums
from ..core.transpose import Transpose
from ..kernels import admm as kernels
from ..kernels.accelerate import plain_step
from ..model.model import Model
from ..numerics.contact_system import PairSystem
from ..numerics.inertia import Inertia
from ..numerics.iterate import ResidualScale
from ..numerics.linear import solve_copies
from ..numerics.local_weights import best_weights, curvatures
from ..terms.needs import ELEMENTS, FINITE
from ..terms.refresh import EVALUATION, Moment
from .facts import Benchmark, Facts, grid
from .implicit import ImplicitStepper
from .solver import Stepper
from .step import ImplicitStep

# Maximum number of Newton steps of a local problem.
STEPS = 30


@dataclass(frozen=True)
class ADMM(ImplicitStep):
    """The alternating direction method of multipliers on 1/(2h²)‖x − x̃‖²_M + Σ U(z), z = Dx, from x = x̃, z = Dx̃, u = 0
    (Narain et al. 2016, Overby et al. 2017).

    Dx are the local coordinates y of all elements, with weights W² = r k A. An iteration has three steps:

    - z = argmin U(z) + ½‖W(Dx − z + u)‖². For U = ½kA‖z − p(z)‖² that is (p(v) + r v)/(1 + r) with v = Dx + u. Other energies
      have W² = r s k A, s = ‖∂²u/∂y²‖ at rest, and Newton's method finds z.
    - u += Dx − z.
    - (M/h² + DᵀW²D) x = (M/h²) x̃ + DᵀW²(z − u), whose matrix is factorised once.

    Sparse energies and self-contact are not split: their Hessian, or a bound of it, is added to that matrix. The fixed point is
    the x(t+h) of :class:`warpcloth.Newton`.

    An iteration multiplies the error of a mode with s = h²ω² by (1 + r²s)/((1 + rs)(1 + r)), which is smallest for r = 1/√s.
    With a small weight it oscillates, and may not converge for concave energies such as hinges. ``"auto"`` is r = 1/(2hₑω) for
    each element, where ω² is the largest eigenvalue of M⁻¹ s k A DᵀD of the element alone; with n iterations at least min(c/n,
    1), c = 2 for Euler, 4 for BDF2, 20 for midpoint.

    ``residual`` is the larger of the primal and the dual residual, the largest accelerations by the forces max(1, 1/r)·DᵀW²(Dx
    − z) and DᵀW²(z − z before), relative to :class:`warpcloth.numerics.iterate.ResidualScale`.

    Attributes:
        dt, substeps, integrator, error: See :class:`ImplicitStep`.
        iterations: Maximum number of iterations in a step.
        tolerance: Tolerance of both residuals.
        weight: r = W²/(kA) > 0 for all elements, or ``"auto"``.

    Examples:
        >>> import warpcloth as wc
        >>> scene = wc.Scene(wc.Mesh.chain(2), masses=[1, 1], terms=[wc.Spring(stiffness=1e3)], pins=[0])
        >>> wc.simulate(scene, wc.ADMM(substeps=4), frames=10, dtype="float64").status.ok
        True
    """

    name = "admm"
    needs, locks = (ELEMENTS, FINITE), True
    touches_itself = double_on_cpu = True
    residual = Residual("largest primal or dual residual of a vertex (as an acceleration)")
    facts = Facts(
        method="implicit steps by the alternating direction method of multipliers",
        suits="as projective dynamics, also with strong damping of membranes",
        weakness='stalls with too large a weight, oscillates with too small a one; `weight="auto"` is near the best',
        benchmarks=(Benchmark({"substeps": 4, "iterations": 20}, cpu=(16, 32, 64), cuda=(32, 64, 128, 256)),),
        runs=(
            *grid([(16, 2), (32, 2), (48, 2)], integrator="midpoint"),
            *grid([(4, 20), (8, 20)], integrator="bdf2"),
        ),
        one_step=({"tolerance": 1e-14}, {"weight": 1.0, "tolerance": 1e-14}),
        limits=("r = 1/(2hω)", "h² = m/(k(L/l − 1))"),
    )

    iterations: int = ranged(20, whole=True, least=1)
    tolerance: float = ranged(1e-3, above=0.0)
    weight: float | Literal["auto"] = ranged("auto", above=0.0, word="auto")

    def bind(self, model: Model) -> Stepper:
        """Binds the solver to ``model``.

        Raises:
            ValueError: A term has infinite stiffness, or is a :class:`warpcloth.RigidCluster`.
        """
        self.refuse(model)
        return self._on(ADMMStepper, model)


class ADMMStepper(ImplicitStepper):
    """:class:`ADMM` on a model.

    Attributes:
        correction: x − x̃ of the last step, (N,) [m].
        primal, dual: Residuals at the end of the last step, (B,).
    """

    def __init__(self, options, model):
        super().__init__(options, model)
        model = self.model
        self._whole = [elements for elements in model.terms if elements.term.cells]
        self._terms = [elements for elements in model.terms if not elements.term.cells]
        scales = [curvatures(model, elements) for elements in self._terms]
        ratios = [self._ratios_of(*each) for each in zip(self._terms, scales, strict=True)]
        factors = [scale * ratio for scale, ratio in zip(scales, ratios, strict=True)]
        self._inertia, self._sums = Inertia(model, 1.0 / self.he**2), Sums(model)
        weighed = [elements.weighed(factor) for elements, factor in zip(self._terms, factors, strict=True)]
        whole = [
            elements if elements.term.whole.quadratic else elements.weighed(curvatures(model, elements))
            for elements in self._whole
        ]
        self._factors = solve_copies(model, constant_matrices(model.with_terms(weighed + whole), self._inertia.s))
        self._gradient = None
        if self._whole or model.dynamic:
            self._gradient = Gradient(model, corrected=True, terms=self._whole, dynamic=model.dynamic)
        self.factorise_seconds = self._factors.seconds
        self.correction, self._force, self._w, self._gaps, self._changes = (model.vectors() for _ in range(5))
        self._primal, self._dual, self._unbalanced = (Mirror(model.scalars()) for _ in range(3))
        self._active = Mirror(model.scalars(wp.int32))
        self._split = [self._split_of(*each) for each in zip(self._terms, ratios, scales, strict=True)]
        factories = kernels.start_admm, kernels.split
        self._kernels = [
            [model.kernel(factory, elements.term, model.dtype) for factory in factories] for elements in self._terms
        ]
        sums = kernels.scatter_admm, kernels.gather_admm
        self._sums_of = [Transpose(model, elements, *sums, elements.term, model.dtype) for elements in self._terms]
        self._plain_step = model.kernel(plain_step, model.dtype)
        self._scale = ResidualScale(model).acceleration
        self.primal, self.dual = np.zeros(model.copies), np.zeros(model.copies)
        self._pressed = None
        if model.dynamic:
            given = model, self.state.x, self.correction, self._factors, self._force, self._w, self._active.array
            self._pressed = PairSystem(*given, sums=self._sums, pairs=self.pairs)
        self._record()
        self.ready()

    def _record(self):
        device = self.model.device
        self._start = Segment(device, self._launch_start)
        self._local = Segment(device, self._launch_local)
        self._move = Segment(device, self._launch_move)

    def record_again(self):
        self._record()
        self._pressed.record()
        self._record_end()

    def start(self):
        self._start()
        self._iterating = np.ones(self.model.copies, dtype=bool)

    def measure(self):
        self._local()
        self.primal = np.where(self._iterating, self._primal.read() / self._scale, self.primal)
        dual = self._dual.read()
        if self._gradient is not None:
            dual = np.maximum(dual, self._unbalanced.read())
        self.dual = np.where(self._iterating, dual / self._scale, self.dual)
        return np.maximum(self.primal, self.dual), {}  # keeps NaN

    def iterate(self, active):
        self._iterating = active.copy()
        self._active.update(active)
        self._factors.solve(self._force, self._w)
        if self._pressed is not None:
            self._pressed.correct()
        self._move()

    def _ratios_of(self, elements, scale):
        model, weight = self.model, self.options.weight
        if weight != "auto":
            return np.full(elements.count, weight, dtype=model.numpy_dtype)
        least = min(self.integrator.least_weight / self.options.iterations, 1.0)
        return np.maximum(best_weights(model, elements, self.he, scale), least).astype(model.numpy_dtype)

    def _split_of(self, elements, ratio, scale):
        """Returns the struct of z, u, Dx − z and z − z before, all 0."""
        model, kind = self.model, wp.types.matrix((elements.term.rows, 3), self.model.dtype)
        of = kernels.admm_elements(elements.term, model.dtype)()
        of.stiffness, of.ratio, of.scale = elements.stiffness, model.per_element(ratio), model.per_element(scale)
        of.z, of.u, of.gap, of.change = (wp.zeros(elements.count, dtype=kind, device=model.device) for _ in range(4))
        if elements.clear is not None:
            of.clear = elements.clear
        return of

    # What the segments record.

    def _launch_start(self):
        self.launch_prediction()
        self.launch_first(self.correction)
        for elements, of, (start, _split) in self._each():
            self.model.launch(start, elements.count, [elements.stencil, elements.rest, self.state.x], [of])

    def _launch_local(self):
        model = self.model
        sums = [self._gaps, self._changes, self._force]
        for array in sums:
            array.zero_()
        model.refresh(EVALUATION, Moment(self.state.x, self.correction), self._terms)
        for (elements, of, (_start, split)), transpose in zip(self._each(), self._sums_of, strict=True):
            given = [elements.stencil, elements.rest, self.state.x, self.correction, STEPS]
            model.launch(split, elements.count, given, [of])
            transpose.add(of, *sums)
        if self._gradient is not None:
            self._gradient.add(self.state.x, self._force, self.correction)
        self._inertia.add(self.correction, self._force)
        if self._gradient is not None:
            self._sums.largest(model.inverse_mass, self._force, self._unbalanced.array)
        for forces, largest in ((self._gaps, self._primal), (self._changes, self._dual)):
            model.lock(forces)
            self._sums.largest(model.inverse_mass, forces, largest.array)

    def _launch_move(self):
        model = self.model
        given = [self.correction, self._w, self._active.array, model.per_copy]
        model.launch(self._plain_step, model.count, given, [self.correction])
        self.filter.launch_near_trial(self.state.x, self.correction)

    def _each(self):
        return zip(self._terms, self._split, self._kernels, strict=True)
