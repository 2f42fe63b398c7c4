"""Extended position based dynamics."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..base.checks import ranged
from ..core.capture import Mirror
from ..core.status import UNBALANCED, Residual, Result
from ..core.sums import Sums
from ..core.transpose import Transpose
from ..fast.plan import plan
from ..kernels import work
from ..kernels.project import add_momentum
from ..kernels.reduce import keep_largest
from ..model.model import Model
from ..numerics.integrators import INTEGRATORS
from ..numerics.iterate import ResidualScale
from ..numerics.sweeps import IN_PLACE, GaussSeidelSweep, JacobiSweep
from ..terms.needs import CLOSED_STEP, LOCAL_STEP, MERGED_DAMPING
from .facts import Benchmark, Facts, grid
from .solver import LaunchedStepper, Stepper
from .step import ImplicitStep


@dataclass(frozen=True)
class XPBD(ImplicitStep):
    """Extended position based dynamics (Macklin et al. 2016, *XPBD*), from x = x̃ and λ = 0 in each step.

    With form ``"vector"`` the constraint of an element is p(y) − y, with the constant Jacobian G:

        Δλ = (G W Gᵀ + α̃)⁻¹(p(y) − y − α̃λ), λ += Δλ, x += W Gᵀ Δλ, α̃ = 1/(kAh²)

    As M(x − x̃) = Gᵀλ holds throughout, its fixed point for finite stiffness is the x(t+h) of :class:`warpcloth.Newton`. Form
    ``"scalar"`` is the published one on C = ‖y − p(y)‖, Δλ = −(C + α̃λ)/(Σw‖∇C‖² + α̃): its fixed point misses implicit Euler
    because ∇C changes within the step. Dihedral bending has the scalar form only, quadratic bending and attachments the vector
    form. Energies with neither, such as :class:`warpcloth.OrthotropicMembrane`, take a step of Newton's method in each element,
    with the fixed point of the vector form.

    With few iterations cloth is too soft, and finer cloth is softer; more substeps help more than more iterations (Macklin et
    al. 2019, *Small steps*). Constraints of infinite stiffness are met, but not at the positions nearest to x̃. With midpoint,
    Gauss–Seidel sweeps go forward and backward in turn, because one order would add energy.

    ``residual`` is the largest unbalanced acceleration ‖∇ᵢ‖/mᵢ at the end of a step, relative to
    :class:`warpcloth.numerics.iterate.ResidualScale`. With infinite stiffness it is the largest move of the last sweep, divided
    by h².

    Attributes:
        dt, substeps, integrator, error: See :class:`ImplicitStep`.
        iterations: Sweeps a step; with midpoint an even number for Gauss–Seidel.
        sweep: Gauss–Seidel ``"coloured"`` or ``"sequential"``, elements in the order of the scene, by one thread; or Jacobi
            ``"constraint-averaged"``, which divides each Δλ by the largest number of constraints at any of its vertices and
            needs many more sweeps.
        form: ``"vector"`` or ``"scalar"``.
        relaxation: ω > 0, a factor on every Δλ.

    Raises:
        ValueError: An option is not allowed.

    Examples:
        >>> import warpcloth as wc
        >>> scene = wc.Scene(wc.Mesh.chain(2), masses=[1, 1], terms=[wc.Spring(stiffness=1e3)], pins=[0])
        >>> stepper = wc.XPBD(substeps=10, iterations=1).bind(scene.build(dtype="float64"))
        >>> for _ in range(600):
        ...     stepper.frame()
        >>> round(float(-1 - stepper.state.x.numpy()[1, 1]), 6)  # the weight over the stiffness
        0.00981
    """

    name = "xpbd"
    needs, locks = (MERGED_DAMPING, LOCAL_STEP, CLOSED_STEP), True
    touches_itself = double_on_cpu = True
    residual, multipliers = Residual(UNBALANCED), True  # λ adds up over the sweeps of a step
    facts = Facts(
        method="PBD with compliance; converges to an implicit step with more sweeps",
        suits="stiff cloth and hard constraints by many small steps",
        weakness=(
            "too soft with few sweeps, more so on finer meshes: 26 % strain where converged sweeps leave 2.6 % (n = 32, 4 "
            "substeps of 20)"
        ),
        benchmarks=(Benchmark({"substeps": 4, "iterations": 20}, cpu=(16, 32, 64, 128), cuda=(64, 128, 256, 512, 1024)),),
        runs=(
            *grid([(10, 4), (20, 2), (20, 4), (40, 1), (80, 1), (160, 1)], integrator="bdf2"),
            *grid([(40, 2)], integrator="midpoint"),
            *grid([(80, 1), (160, 1)]),
        ),
        one_step=({}, {"sweep": "constraint-averaged"}),
        limits=("ω λ_max = 2", "Gauss–Seidel, |z| = 1", "a ring an iteration", "h² = m/(k(L/l − 1))"),
    )

    iterations: int = ranged(20, whole=True, least=1)
    sweep: Literal["coloured", "sequential", "constraint-averaged"] = "coloured"
    form: Literal["vector", "scalar"] = "vector"
    relaxation: float = ranged(1.0, above=0.0)

    def __post_init__(self):
        super().__post_init__()
        if INTEGRATORS[self.integrator].to_and_fro and self.ordered and self.iterations % 2:
            raise ValueError(
                f'iterations is {self.iterations}; with integrator="{self.integrator}" sweeps go forward and backward in turn, '
                "so that it must be even"
            )

    @property
    def ordered(self) -> bool:
        return self.sweep in IN_PLACE

    def residual_on(self, model: Model) -> Residual | None:
        if any(elements.hard for elements in model.terms):
            return self.residual._replace(measure="largest move of a vertex in the last sweep (divided by h²)")
        return self.residual

    def bind(self, model: Model) -> Stepper:
        """Binds the solver to ``model``.

        Raises:
            ValueError: A term has infinite stiffness, and neither projection, scalar constraint nor ``prox``, or an integrator
                other than Euler.
        """
        self.refuse(model)
        self.refuse_hard(model)
        return self._on(XPBDStepper, model)


class XPBDStepper(LaunchedStepper):
    """:class:`XPBD` on a model.

    Attributes:
        sweep: The sweep of :mod:`warpcloth.numerics.sweeps`, with x − x̃ and λ of the last step.
    """

    def __init__(self, options, model):
        super().__init__(options, model, options.integrator)
        self.iterations = options.iterations
        model = self.model
        self._sums, self._force = Sums(model), model.vectors()
        soft = not any(elements.hard for elements in model.terms)
        self._gradient = plan(model).gradient(corrected=True) if soft else None
        self._add_momentum = model.kernel(add_momentum, model.dtype)
        self._acceleration = model.scalars()
        self._largest = Mirror(self.state.add("largest acceleration", model.scalars()))
        self._keep_largest = model.kernel(keep_largest)
        self._scale = ResidualScale(model).acceleration
        sweeps = self.sweep.parts(options.iterations - (not soft))
        if self.integrator.to_and_fro and options.ordered:
            sweeps = [(self._launch_to_and_fro, options.iterations // 2)]
        self.record((self._launch_start, 1), *sweeps, (self._launch_last, 1))
        self.integrator.start()

    def arranged(self, model):
        options = self.options
        kind = GaussSeidelSweep if options.ordered else JacobiSweep
        more = {"scalar": options.form == "scalar", "multipliers": True}
        self.sweep = kind(model, self.state.x, self.he, options.sweep, options.relaxation, **more)
        return model.with_terms(self.sweep.elements)

    def _launch_start(self):
        self.launch_prediction()
        self.sweep.launch_start()

    def _launch_to_and_fro(self):
        self.sweep.launch()
        self.sweep.launch(backward=True)

    def _launch_last(self):
        model, d = self.model, self.sweep.correction
        self._force.zero_()
        if self._gradient is None:
            self._launch_momentum(-1.0)
            self.sweep.launch()
        else:
            self._gradient.add(self.state.x, self._force, d)
        self._launch_momentum(1.0)
        model.lock(self._force)
        self._sums.largest(model.inverse_mass, self._force, self._acceleration)
        model.launch(self._keep_largest, model.copies, [self._acceleration], [self._largest.array])
        self.launch_finish(d)

    def _launch_momentum(self, sign):
        given = [self.model.mass, self.sweep.correction, sign / self.he**2]
        self.model.launch(self._add_momentum, self.model.count, given, [self._force])

    def constraint_forces(self, collider=None):
        """See :meth:`Stepper.constraint_forces`: adds −Gᵀλ/hₑ²."""
        model, pulls = self.model, []
        for elements, values, key in self.sweep.with_multipliers():
            if not elements.hard or collider not in (None, elements.collider):
                continue
            if elements.cells:
                raise ValueError(
                    f"XPBD has no multipliers of {elements.label} at pinned vertices, so that what pins bear is not known; "
                    "ConstrainedDynamics has them"
                )
            data = work.multiplier_pull(*key).data()
            data.stencil, data.values, data.x, data.factor = elements.stencil, values, self.state.x, -1.0 / self.he**2
            factories = work.scatter_multipliers, work.gather_multipliers
            pulls.append((Transpose(model, elements, *factories, *key), data))

        def launch(out):
            for transpose, data in pulls:
                transpose.add(data, out)

        return launch

    def note(self):
        self.residual = self._largest.read() / self._scale
        for copy in np.flatnonzero(~np.isfinite(self.residual)):
            self.results[copy] = Result.DIVERGED
