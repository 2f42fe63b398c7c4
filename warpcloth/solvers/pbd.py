"""Position based dynamics."""

from dataclasses import dataclass
from typing import Literal

from ..base.checks import ranged
from ..model.model import Model
from ..numerics.sweeps import IN_PLACE, GaussSeidelSweep, JacobiSweep
from ..terms.needs import CLOSED_STEP, LOCAL_STEP, MERGED_DAMPING, NO_AIR, NORMAL_FORCE
from .facts import Benchmark, Facts, grid
from .solver import LaunchedStepper, Stepper
from .step import Step


@dataclass(frozen=True)
class PBD(Step):
    """Position based dynamics (Müller et al. 2006).

    A sweep moves the vertices of each constraint by W GᵀΔλ, Δλ = (G W Gᵀ + α̃)⁻¹(p(y) − y), with inverse masses W and α̃ =
    1/(kAh²). For infinite stiffness k they move fully onto the constraint, else by the fraction s = w/(w + α̃), w = G W Gᵀ. If
    every sweep corrects by s, cloth becomes stiffer with more iterations n and smaller h: one hanging mass stretches by g
    h²(1−s)ⁿ/(1−(1−s)ⁿ) at rest. If every sweep corrects by s′ = 1 − (1−s)^(1/n), it stretches by mg/k for any n; where
    constraints share vertices, the result still depends on n.

    Jacobi sweeps add up all corrections and then move the vertices. If they move by ω times the sum, they diverge iff ω
    λ_max(D⁻¹JWJᵀ) > 2. Averaged by vertex, (Σx_new + αx)/(n + α) with the n constraints of the vertex, they converge for every
    α ≥ 0, but do not conserve momentum. Averaged by constraint, with the factor 1/max n for all its vertices, they conserve
    linear momentum. So do Gauss–Seidel sweeps, which converge faster; their order changes the result.

    Attributes:
        dt, substeps: See :class:`Step`.
        iterations: Sweeps a step.
        sweep: Jacobi ``"vertex-averaged"``, ``"constraint-averaged"`` or plain ``"jacobi"``; Gauss–Seidel ``"coloured"``, or
            ``"sequential"``: elements in the order of the scene, by one thread.
        alpha: α ≥ 0, weight of the old position when averaging by vertex.
        relaxation: ω > 0, a factor on every move.
        correction: ``"per-sweep"`` corrects constraints of finite stiffness by s in each sweep, ``"per-step"`` by s in each
            step, which is s′ in each sweep.

    Raises:
        ValueError: An option is not allowed, or ``alpha`` is given without ``"vertex-averaged"``.

    Examples:
        >>> import warpcloth as wc
        >>> scene = wc.Scene(wc.Mesh.chain(2), masses=[1, 1], terms=[wc.Spring(stiffness=float("inf"))], pins=[0])
        >>> stepper = wc.PBD(substeps=4, iterations=1).bind(scene.build(dtype="float64"))
        >>> stepper.frame()
        >>> round(float(stepper.state.x.numpy()[1, 1]), 9)  # the length of the spring
        -1.0
    """

    name = "pbd"
    needs, locks = (MERGED_DAMPING, LOCAL_STEP, CLOSED_STEP, NORMAL_FORCE, NO_AIR), True
    touches_itself = double_on_cpu = True
    closes, multipliers = True, False  # λ does not add up over the sweeps of a step
    facts = Facts(
        method="position based dynamics, by Gauss–Seidel or Jacobi sweeps",
        suits="cloth that only has to look plausible",
        weakness="its stiffness depends on the number of iterations and on the step",
        benchmarks=(
            Benchmark({"substeps": 4, "iterations": 20}, cpu=(16, 32, 64, 128), cuda=(64, 128, 256, 512, 1024)),
            # Measures Jacobi sweeps alone: so many that other costs of a frame, such as copying points to the host, vanish.
            Benchmark(
                {"substeps": 1, "iterations": 1000, "sweep": "vertex-averaged"},
                cpu=(16, 32, 64, 128),
                cuda=(256, 512, 1024, 2048),
                scene="net",
            ),
        ),
        runs=grid([(30, 1), (60, 1), (120, 1), (240, 1)], correction="per-step"),
        limits=("ω λ_max = 2", "Gauss–Seidel, |z| = 1", "a ring an iteration"),
    )

    iterations: int = ranged(20, whole=True, least=1)
    sweep: Literal["vertex-averaged", "constraint-averaged", "jacobi", "coloured", "sequential"] = "coloured"
    alpha: float = ranged(0.0, least=0.0)
    relaxation: float = ranged(1.0, above=0.0)
    correction: Literal["per-sweep", "per-step"] = "per-sweep"

    def __post_init__(self):
        super().__post_init__()
        if self.sweep != "vertex-averaged" and self.alpha != 0.0:
            raise ValueError(f"alpha is {self.alpha:g}; it belongs to sweep='vertex-averaged' and must be 0 without")

    @property
    def ordered(self) -> bool:
        return self.sweep in IN_PLACE

    def bind(self, model: Model) -> Stepper:
        """Binds the solver to ``model``.

        Raises:
            ValueError: A term has infinite stiffness and neither projection, scalar constraint nor ``prox``.
        """
        self.refuse(model)
        return self._on(PBDStepper, model)


class PBDStepper(LaunchedStepper):
    """:class:`PBD` on a model.

    Attributes:
        sweep: The sweep of :mod:`warpcloth.numerics.sweeps`, with x − x̃ of the last step.
    """

    hard_pairs = True

    def __init__(self, options, model):
        super().__init__(options, model, "euler")
        self.iterations = options.iterations
        self.record((self._launch_start, 1), *self.sweep.parts(options.iterations), (self._launch_last, 1))

    def arranged(self, model):
        options = self.options
        # With one sweep, both kinds of correction are equal.
        spread = options.iterations if options.correction == "per-step" and options.iterations > 1 else None
        given = model, self.state.x, self.h, options.sweep, options.relaxation
        if options.ordered:
            self.sweep = GaussSeidelSweep(*given, spread=spread)
        else:
            self.sweep = JacobiSweep(*given, alpha=options.alpha, spread=spread)
        return model.with_terms(self.sweep.elements)

    def _launch_start(self):
        self.launch_prediction()
        self.sweep.launch_start()

    def _launch_last(self):
        self.launch_finish(self.sweep.correction)
