"""Explicit steps of cloth with self-contact."""

import warp as wp

from ..core.gradient import Gradient
from ..kernels.loop import count_down


class TouchingSteps:
    """Takes plain steps, each after the forces of self-contact at its start; the filter ends them.

    Args:
        steps: The plain steps, with a ``gradient`` to which contact adds before a step.
        pairs: :class:`warpcloth.contact.self_steps.SelfSteps`.

    Attributes:
        residual, record: Those of the plain steps.
    """

    residual = None

    def __init__(self, steps, pairs):
        self._plain, self._pairs, self.record, model = steps, pairs, steps.record, pairs.model
        self._dynamic = Gradient(model, terms=(), dynamic=pairs.forces.terms)
        self._left, self._count_down = wp.zeros(1, dtype=wp.int32, device=model.device), model.kernel(count_down)

    def launch(self, steps, end):
        """Launches a number of steps, and ``end`` (x, v) after each."""
        if steps == 1:
            self._launch_step(end)
            return
        self._left.fill_(steps)
        wp.capture_while(self._left, self._launch_one, end=end)

    def _launch_one(self, end):
        self._launch_step(end)
        self._pairs.model.launch(self._count_down, 1, [], [self._left])

    def _launch_step(self, end):
        x, _v = self._plain.state
        self._pairs.launch_begin(x)
        self._dynamic.add(x, self._plain.gradient)
        self._plain.launch(1, end)
