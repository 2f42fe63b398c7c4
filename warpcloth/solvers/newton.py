"""Implicit Euler by Newton's method."""

from dataclasses import dataclass
from typing import Literal

from ..base.checks import ranged
from ..core.capture import Segment
from ..core.status import UNBALANCED, Residual
from ..model.model import Model
from ..numerics.iterate import Ended, ResidualScale
from ..numerics.minimise import Minimiser
from ..terms.needs import FINITE
from .facts import Benchmark, Facts
from .implicit import ImplicitStepper
from .solver import Stepper
from .step import ImplicitStep


@dataclass(frozen=True)
class Newton(ImplicitStep):
    """Implicit Euler: x(t+h) minimises 1/(2h²)‖x − x̃‖²_M + U(x), x̃ = x + h v + h² g (Baraff and Witkin 1998).

    It stays at a state in exact balance even if that is not a minimum, such as a straight chain under compression. Linear
    momentum is conserved to rounding, whatever the tolerance; angular momentum is not. Without contact and rigid clusters a
    step starts from the last x − x̃ where this lowers the function, else from x̃; in contact from x̃, x(t) or the last x − x̃,
    wherever the function is lowest. From x(t) it takes an iteration at least.

    Attributes:
        dt, substeps, integrator, error: See :class:`ImplicitStep`.
        tolerance: Tolerance of the residual, which is the largest unbalanced acceleration of any vertex, ‖∇ᵢ‖/mᵢ, divided by
            gravity and what loads and wind add to it; without these by the radius of the cloth over the square of the duration
            (:class:`warpcloth.numerics.iterate.ResidualScale`). If rounding leaves a larger residual, a step ends when no
            progress is possible, and its result says so.
        iterations: Maximum number of Newton iterations in a step. If cloth snaps from one fold to another, a step may take more
            than 100.
        hessian: Treatment of an indefinite Hessian (Choi and Ko 2002 for springs). ``"clamp"`` and ``"absolute"`` make the
            block of each element semi-definite; ``"adaptive"`` reduces its negative part by quarters, only as far as the matrix
            needs to be definite; ``"raw"`` changes nothing.
        linear: ``"cg"`` solves by conjugate gradients, with multigrid as preconditioner on meshes of 200 vertices and more
            where this takes less work. ``"factorised"`` factorises on the host, which is slower, but takes any stiffness.

    Examples:
        >>> import warpcloth as wc
        >>> scene = wc.Scene(wc.Mesh.chain(2), masses=[1, 1], terms=[wc.Spring(stiffness=1e3)], pins=[0])
        >>> stepper = wc.Newton(substeps=4).bind(scene.build(dtype="float64"))
        >>> stepper.frame()
        >>> stepper.results[0].value
        'converged'
    """

    name = "newton"
    needs = (FINITE,)
    residual, locks = Residual(UNBALANCED), True
    touches_itself = double_on_cpu = True
    facts = Facts(
        method="implicit steps by Newton's method with a line search",
        suits="convergence studies, equilibria, small stiff cloth; the reference for the others",
        weakness='slow on large meshes; with `hessian="raw"` it fails in compression',
        benchmarks=(Benchmark({"substeps": 4}, cpu=(16, 32, 64), cuda=(32, 64, 128)),),
        runs=(
            *({"substeps": substeps} for substeps in (1, 4, 16)),
            *({"substeps": substeps, "integrator": "bdf2"} for substeps in (1, 2, 4, 8)),
            # Stiff cloth: at 100 kN/m, 1000 times gravity is a force of 1e-5 m.
            *({"substeps": s, "integrator": "bdf2", "tolerance": tolerance} for s in (1, 2, 4) for tolerance in (1e2, 1e3)),
            *({"substeps": substeps, "integrator": "midpoint"} for substeps in (4, 8)),
            *({"error": error} for error in (1e-3, 1e-4)),
        ),
        one_step=({"tolerance": 1e-14},),
        limits=("h² = m/(k(L/l − 1))",),
    )

    tolerance: float = ranged(1e-3, above=0.0)
    iterations: int = ranged(300, whole=True, least=1)
    hessian: Literal["adaptive", "raw", "clamp", "absolute"] = "adaptive"
    linear: Literal["cg", "factorised"] = "cg"

    def bind(self, model: Model) -> Stepper:
        """Binds the solver to ``model``.

        Raises:
            ValueError: A term has infinite stiffness.
        """
        self.refuse(model)
        return self._on(NewtonStepper, model)


class NewtonStepper(ImplicitStepper):
    """:class:`Newton` on a model.

    Attributes:
        minimiser: The :class:`warpcloth.numerics.minimise.Minimiser`.
    """

    def __init__(self, options, model):
        super().__init__(options, model)
        model = self.model
        last = self.state.add("correction", model.vectors())
        given = {"s": 1.0 / self.he**2, "pairs": self.pairs, "last": last, "colliders": self.colliders}
        self.minimiser = Minimiser(model, self.state.x, options.hessian, options.linear, **given)
        for name, array in self.minimiser.kept.items():
            self.state.add(name, array)
        self.correction, self._scale = self.minimiser.correction, ResidualScale(model).acceleration
        self._predict = Segment(model.device, self.launch_prediction)
        self.ready()
        self.correction.zero_()  # that of the first steps of BDF2

    def record_again(self):
        self._predict = Segment(self.model.device, self.launch_prediction)
        self.minimiser.record()
        self._record_end()

    def minimise(self):
        self._predict()
        results = self.minimiser.minimise(self.options.tolerance, self.options.iterations, self._scale)
        return Ended(results, self.minimiser.residual, self.minimiser.iterations)
