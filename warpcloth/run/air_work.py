"""Work of the air on the cloth, summed over steps."""

import warp as wp

from ..fast.plan import plan
from ..kernels import work as kernels
from ..kernels.terms.air import AIR


class AirWork:
    """Sums the work −∇U·Δx of the air over the steps of one stepper, from the forces that its steps used.

    ∇U is that of the elements that the step froze, where the step takes its forces: at the end of implicit Euler and BDF2, in
    the middle of midpoint, at the start of explicit steps.
    """

    def __init__(self, stepper):
        self._x, self._model, model = stepper.state.x, stepper.model, stepper.model
        self._against = wp.zeros(model.count, dtype=wp.float64, device=model.device)
        self._before, self._pull = model.vectors(), model.vectors()
        parts = 0 if stepper.integrator is None else stepper.integrator.parts
        self._at = {0: [self._before], 1: [self._x], 2: [self._before, self._x]}[parts]
        self._gradient = plan(model).gradient(terms=tuple(each for each in model.terms if each.term is AIR))
        self._add = model.kernel(kernels.add_rubbing_work, model.dtype)

    def begin(self):
        """Begins from the present state."""
        wp.copy(self._before, self._x)

    def launch(self):
        """Launches the sums after a step."""
        self._pull.zero_()
        for x in self._at:
            self._gradient.add(x, self._pull)
        self._model.launch(self._add, self._model.count, [self._pull, self._before, self._x], [self._against])
        wp.copy(self._before, self._x)

    def sums(self):
        """Returns the work on each copy since the last call, (B,) [J]."""
        against = self._against.numpy().reshape(self._model.copies, -1).sum(axis=1) / len(self._at)
        self._against.zero_()
        return -against
