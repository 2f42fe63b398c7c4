"""The base of methods that iterate towards the minimiser of implicit Euler."""

import numpy as np

from ..core.capture import Segment
from ..numerics.iterate import iterate
from .solver import Stepper


class ImplicitStepper(Stepper):
    """A method with tolerance that iterates on the correction d = x − x̃.

    A subclass has ``correction`` (N,) [m] and the functions ``start``, ``measure`` and ``iterate`` of
    :func:`warpcloth.numerics.iterate.iterate`; ``start`` includes the prediction. Its constructor ends with :meth:`ready`.
    """

    def __init__(self, options, model):
        super().__init__(options, model, options.integrator)
        self.iterations = 0

    def ready(self):
        """Records the end of a step; then the integrator may step."""
        self._finish = Segment(self.model.device, lambda: self.launch_finish(self.correction))
        self.integrator.start()

    def step(self):
        ended = iterate(self, self.options.tolerance, self.options.iterations)
        self.iterations = ended.iterations
        self._finish()
        self.note(ended.results, ended.residual)

    def note(self, results, residual):
        """Takes down how a step ended, for each copy."""
        self.results = [before.worse(now) for before, now in zip(self.results, results, strict=True)]
        self.residual = np.maximum(self.residual, residual)  # keeps NaN
