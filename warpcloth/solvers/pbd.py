"""Position based dynamics: predict, then move the vertices onto their constraints, and call the move a velocity."""

from dataclasses import dataclass
from typing import Literal

from ..base.checks import number, whole
from ..base.renamed import renamed
from ..model.model import Model
from ..numerics.sweeps import IN_PLACE, GaussSeidelSweep, JacobiSweep
from ..terms.needs import LOCAL_STEP, MERGED_DAMPING
from .facts import Benchmark, Facts, grid
from .solver import LaunchedStepper, Stepper
from .step import Step


@renamed(stiffness="correction")
@dataclass(frozen=True)
class PBD(Step):
    """Position based dynamics (Müller et al. 2006).

    A sweep moves the vertices of each constraint, weighted by inverse mass (equal masses: half and half), by
    Δλ = (G W Gᵀ + α̃)⁻¹(p(y) − y) with α̃ = 1/(kAh²): fully onto it for infinite stiffness k, the classical method; with a
    finite one by the part s = w/(w + α̃) that the material would move by itself in a step. Corrected by s in every sweep, cloth
    becomes stiffer with iterations and with 1/h: one hanging mass stretches by g h²(1−s)ⁿ/(1−(1−s)ⁿ) at rest, n the iterations.
    Corrected by s in a step, which is s′ = 1 − (1−s)^(1/n) in each sweep, it stretches by g h²(1−s)/s whatever n is, which with
    this s is mg/k; where constraints meet, the result still depends on n.

    Jacobi sweeps move by the sum of all corrections at once. Times ω it diverges iff ω λ_max(D⁻¹JWJᵀ) > 2. Averaged by vertex
    (Σx_new + αx)/(n + α), n its constraints, it converges for every α ≥ 0, but momentum is not conserved; averaged by
    constraint, with 1/max n of its vertices for all of them, linear momentum is. Gauss–Seidel sweeps conserve linear
    momentum too and converge in fewer sweeps; their order changes the result.

    Attributes:
        dt, substeps: See :class:`Step`.
        iterations: Sweeps a step.
        sweep: Jacobi ``"vertex-averaged"``, ``"constraint-averaged"`` or plain ``"jacobi"``; Gauss–Seidel ``"coloured"``, or
            ``"sequential"``: elements in the order of the scene, by one thread, which on a GPU is for small scenes.
        alpha: α ≥ 0, weight of the old position when averaging by vertex.
        relaxation: ω > 0, a factor of every move.
        correction: Whether a constraint of finite stiffness is corrected by the part s ``"per-sweep"``, or ``"per-step"``, with
            s′ in each sweep.

    Raises:
        ValueError: If an option breaks a rule.

    Examples:
        >>> import warpcloth as wc
        >>> scene = wc.Scene(wc.Mesh.chain(2), masses=[1, 1], terms=[wc.Spring(stiffness=float("inf"))], pins=[0])
        >>> stepper = wc.PBD(substeps=4, iterations=1).bind(scene.build(dtype="float64"))
        >>> stepper.frame()
        >>> round(float(stepper.state.x.numpy()[1, 1]), 9)  # the length of the spring
        -1.0
    """

    name = "pbd"
    needs, locks = (MERGED_DAMPING, LOCAL_STEP), True
    closes, multipliers = True, False  # λ does not add up over the sweeps of a step
    facts = Facts(
        method="position based dynamics: Gauss–Seidel sweeps by colour or in order, Jacobi ones averaged or relaxed",
        benchmarks=(
            Benchmark({"substeps": 4, "iterations": 20}, cpu=(16, 32, 64, 128), cuda=(64, 128, 256, 512, 1024)),
            # Jacobi sweeps alone: so many that what a frame takes besides, its points on the host above all, does not count.
            Benchmark(
                {"substeps": 1, "iterations": 1000, "sweep": "vertex-averaged"},
                cpu=(16, 32, 64, 128),
                cuda=(256, 512, 1024, 2048),
                scene="net",
            ),
        ),
        runs=grid([(30, 1), (60, 1), (120, 1), (240, 1)], correction="per-step"),
        limits=("ω λ_max = 2", "Gauss–Seidel, |z| = 1", "a ring an iteration"),
        style=("tab:pink", "D"),
    )

    iterations: int = 20
    sweep: Literal["vertex-averaged", "constraint-averaged", "jacobi", "coloured", "sequential"] = "coloured"
    alpha: float = 0.0
    relaxation: float = 1.0
    correction: Literal["per-sweep", "per-step"] = "per-sweep"

    def __post_init__(self):
        super().__post_init__()
        whole("iterations", self.iterations, 1)
        number("alpha", self.alpha, least=0.0)
        number("relaxation", self.relaxation, above=0.0)
        if self.sweep != "vertex-averaged" and self.alpha != 0.0:
            raise ValueError(f"alpha is {self.alpha:g}; it belongs to sweep='vertex-averaged' and must be 0 without")

    @property
    def ordered(self) -> bool:
        return self.sweep in IN_PLACE

    @property
    def divides(self) -> bool:
        return self.sweep == "coloured"

    def bind(self, model: Model) -> Stepper:
        """The solver on ``model``, all scratch allocated.

        Raises:
            ValueError: If a term has nothing to project on.
        """
        self.refuse(model)
        return self._on(PBDStepper, model)


class PBDStepper(LaunchedStepper):
    """:class:`PBD` on a model.

    Attributes:
        sweep: The sweep of :mod:`warpcloth.numerics.sweeps`, with x − x̃ of the last step.
    """

    def __init__(self, options, model):
        super().__init__(options, model, "euler")
        self.iterations = options.iterations
        model = self.model
        # Spread over one sweep it is what it is.
        spread = options.iterations if options.correction == "per-step" and options.iterations > 1 else None
        given = model, self.state.x, self.h, options.sweep, options.relaxation
        if options.ordered:
            self.sweep = GaussSeidelSweep(*given, spread=spread, pool=self.pool)
        else:
            self.sweep = JacobiSweep(*given, alpha=options.alpha, spread=spread)
        self.model = model.with_terms(self.sweep.elements)
        self.record((self._launch_start, 1), *self.sweep.parts(options.iterations), (self._launch_last, 1))

    def _launch_start(self):
        self.pool.launch_alone(self.model, self.launch_prediction, self.sweep.launch_start)

    def _launch_last(self):
        if self.pool.leads:
            self.launch_finish(self.sweep.correction)
