"""Takes steps without self-contact while no pair of the cloth comes near."""

import warp as wp

from ..kernels.contact.far_step import find_far, find_near
from ..kernels.step import count_step
from .clear_steps import TwinSteps


class FarSteps(TwinSteps):
    """Lets a twin of a stepper, without self-contact, take the steps in which no pair is listed and none can come near.

    Before a step, the list and the displacement h v of each vertex decide. The tests are those of
    :class:`warpcloth.fast.quiet_steps.QuietSteps`.
    """

    def __init__(self, stepper, twin):
        super().__init__(stepper, twin)
        model, pairs = stepper.model, stepper.pairs
        self._others = [name for name in self._kept if name not in ("x", "v")]
        self._limits, self._dim = pairs.far_limits()
        self._find_near, self._find_far = (model.kernel(each, model.dtype) for each in (find_near, find_far))
        self._count = model.kernel(count_step)

    @staticmethod
    def serve(stepper):
        """Returns whether a stepper can use it: each copy is one piece, and nothing else moves it."""
        pairs, model = stepper.pairs, stepper.model
        one = len(pairs.proximity.drift) == model.copies
        return one and stepper.count is None and model.colliders is None

    def _launch_look(self):
        """Launches the test before a step, and saves the state."""
        stepper, pairs, kept = self.stepper, self.stepper.pairs, self._kept
        near, (x, v) = pairs.proximity, stepper.state
        wp.copy(self.near, pairs.listed)
        for name in self._others:
            wp.copy(kept[name], self.twin.state.arrays[name])
        near.launch_drift(x)
        given = [near.drift, near.found, near.listed, x, v, self._limits]
        stepper.model.launch(self._find_near, self._dim, given, [kept["x"], kept["v"], self.near])

    def _launch_check(self):
        """Launches the test after a step."""
        near = self.stepper.pairs.proximity
        given = [near.drift, near.found, near.listed, self._kept["x"], self.stepper.state.x, self._limits]
        self.stepper.model.launch(self._find_far, self._dim, given, [self.near])

    def _launch_count(self):
        pairs, model = self.stepper.pairs, self.stepper.model
        model.launch(self._count, model.copies, [], [pairs.steps])
        if pairs.friction is not None:
            pairs.friction.launch_release()
