"""Position based dynamics: predict, then move the vertices onto their constraints, and call the move a velocity."""

from dataclasses import dataclass

import numpy as np

from ..capture import Segment
from ..checks import choice, number, whole
from ..kernels import project as kernels
from .solver import Step, Stepper, require_model


@dataclass(frozen=True)
class PBD(Step):
    """Position based dynamics (Müller et al. 2006), Jacobi sweeps.

    A sweep moves the vertices of each constraint, weighted by inverse mass (equal masses: half and half), by
    Δλ = (G W Gᵀ + α̃)⁻¹(p(y) − y) with α̃ = 1/(kAh²): fully onto it for infinite stiffness k, the classical method; with a
    finite one by the part s = w/(w + α̃) that the material would move by itself in a step. As s is spent once a sweep, the
    cloth stiffens with iterations and with 1/h. One hanging mass stretches by g h²(1−s)ⁿ/(1−(1−s)ⁿ) at rest.

    Averaged over its n constraints a vertex goes to (Σx_new + αx)/(n + α), which converges for every α ≥ 0; the plain sum
    with relaxation ω diverges iff ω λ_max(D⁻¹JWJᵀ) > 2. Averaging by vertex does not conserve momentum.

    Attributes:
        dt, substeps: See :class:`Step`.
        iterations: Sweeps a step.
        sweep: ``"jacobi"``.
        averaging: ``"vertex"`` or ``"none"``.
        alpha: α ≥ 0, weight of the old place when averaging.
        relaxation: ω > 0, a factor of every move.

    Raises:
        ValueError: If an option breaks a rule.
    """

    iterations: int = 20
    sweep: str = "jacobi"
    averaging: str = "vertex"
    alpha: float = 0.0
    relaxation: float = 1.0

    def __post_init__(self):
        super().__post_init__()
        whole("iterations", self.iterations, 1)
        choice("sweep", self.sweep, ("jacobi",))
        choice("averaging", self.averaging, ("vertex", "none"))
        number("alpha", self.alpha, least=0.0)
        number("relaxation", self.relaxation, above=0.0)
        if self.averaging == "none" and self.alpha != 0.0:
            raise ValueError(f"alpha is {self.alpha:g}; it belongs to averaging='vertex' and must be 0 without")

    def bind(self, model):
        """The solver on ``model``, all scratch allocated.

        Raises:
            ValueError: If a term has nothing to project on.
        """
        require_model(model)
        for elements in model.terms:
            if elements.term.project is None and elements.term.constraint is None:
                raise ValueError(
                    f"PBD cannot project {elements.label}, whose energy is no distance to a constraint; Newton or Explicit can"
                )
        return PBDStepper(self, model)


class PBDStepper(Stepper):
    """:class:`PBD` on a model.

    Attributes:
        correction: x − x̃ of the last step, (N,) [m].
    """

    def __init__(self, options, model):
        super().__init__(options, model)
        self.correction, self._total = model.vectors(), model.vectors()
        self._scale = model.array(self._scales(), model.dtype)
        cuda = model.device.is_cuda
        factory = kernels.gather_correction if cuda else kernels.scatter_correction
        self._project = [
            (model.kernel(factory, elements.term, model.dtype), elements, elements.incidences if cuda else ())
            for elements in model.terms
        ]
        self._apply = model.kernel(kernels.apply_correction, model.dtype)
        self._start = Segment(model.device, self._launch_start)
        self._sweep = Segment(model.device, self._launch_sweep)
        self._finish = Segment(model.device, lambda: self.launch_finish(self.correction))

    def _scales(self):
        """ω, or ω/(n + α) for a vertex of n constraints."""
        options, constraints = self.options, np.zeros(self.model.count)
        if options.averaging == "none":
            return np.full(self.model.count, options.relaxation)
        for elements in self.model.terms:
            constraints += np.bincount(elements.stencil.numpy().ravel(), minlength=self.model.count)
        return options.relaxation / np.maximum(constraints + options.alpha, np.finfo(np.float32).tiny)

    def _launch_start(self):
        self.launch_prediction()
        self.correction.zero_()
        self._total.zero_()

    def _launch_sweep(self):
        model = self.model
        for kernel, elements, incidences in self._project:
            dim = len(incidences[0]) - 1 if incidences else elements.count
            given = [*incidences, *elements.arguments, model.inverse_mass, self.state.x, self.correction, self.h]
            model.launch(kernel, dim, given, [self._total])
        model.launch(self._apply, model.count, [self._scale], [self._total, self.correction])

    def step(self):
        self._start()
        for _ in range(self.options.iterations):
            self._sweep()
        self._finish()
