"""The base class of solvers that iterate towards the minimiser of a step and stop at a tolerance."""

import numpy as np

from ..core.capture import Segment
from ..numerics.iterate import iterate
from .solver import Stepper


class ImplicitStepper(Stepper):
    """A solver that iterates on the correction d = x − x̃ until its residual is below a tolerance.

    A subclass has ``correction`` (N,) [m] and the methods ``start`` (with the prediction), ``measure`` and ``iterate`` of
    :func:`warpcloth.numerics.iterate.iterate`, or its own :meth:`minimise`. Its constructor ends with :meth:`ready`.
    """

    def __init__(self, options, model):
        super().__init__(options, model, options.integrator)
        self.iterations = 0

    def ready(self):
        """Captures the end of a step, and starts the integrator, which may step."""
        self._record_end()
        self.integrator.start()

    def _record_end(self):
        self._finish = Segment(self.model.device, self._launch_end)

    def _launch_end(self):
        self.filter.launch_trial(self.state.x, self.correction)  # there the filter starts
        self.launch_finish(self.correction)

    def follow_contact(self):
        super().follow_contact()
        self._record_end()

    def step(self):
        self.take(self._iterate)

    def _iterate(self):
        ended = self.minimise()
        self.iterations = ended.iterations
        self._finish()
        self.note(ended.results, ended.residual)

    def minimise(self):
        """Predicts and iterates; returns :class:`warpcloth.numerics.iterate.Ended`."""
        return iterate(self, self.options.tolerance, self.options.iterations)

    def note(self, results, residual):
        """Notes how a step ended, for each copy."""
        self.results = [before.worse(now) for before, now in zip(self.results, results, strict=True)]
        self.residual = np.maximum(self.residual, residual)  # keeps NaN
