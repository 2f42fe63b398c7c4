"""Explicit steps of cloth with self-contact. A step in which no contact is possible is a plain step and one test."""

import warp as wp

from ..core.gradient import Gradient
from ..kernels.contact.far_step import find_far
from ..kernels.loop import count_down
from ..kernels.step import count_step


class QuietSteps:
    """Takes plain steps while no pair is listed, and repeats a step with contact and filter if the test requires it.

    The test is that of the list, by motion relative to the drift of the piece. While the list is valid, no pair can have a
    force. Also, no vertex may move by more than the filter allows in a round. The steps of both kinds are then bitwise equal.
    With several pieces, colliders, moving pins, loads, or a start with intersections, all steps have contact.

    Args:
        steps: The plain steps, with a ``gradient`` to which contact adds before a step.
        pairs: :class:`warpcloth.contact.self_steps.SelfSteps`.
        count: Number of steps of the moved pins (B,) int32, or None.

    Attributes:
        residual, record: Those of the plain steps.
    """

    residual = None

    def __init__(self, steps, pairs, count):
        self._plain, self._pairs, self.record, model = steps, pairs, steps.record, pairs.model
        self._dynamic = Gradient(model, terms=(), dynamic=pairs.forces.terms)
        one = len(pairs.proximity.drift) == model.copies
        self._quiet = one and count is None and not model.scene.colliders
        self._v_before = model.vectors()
        self._left, self._again = (wp.zeros(1, dtype=wp.int32, device=model.device) for _ in range(2))
        self._test = model.kernel(find_far, model.dtype)
        self._limits, self._dim = pairs.far_limits()
        self._count, self._count_down = model.kernel(count_step), model.kernel(count_down)

    def launch(self, steps, end):
        """Launches a number of steps, and ``end`` (pins, keyframes, count, x, v) after each that is not plain."""
        step = self._launch_step if self._quiet else self._launch_full
        if steps == 1:
            step(end)
            return
        self._left.fill_(steps)
        wp.capture_while(self._left, self._launch_one, step=step, end=end)

    def _launch_one(self, step, end):
        step(end)
        self._pairs.model.launch(self._count_down, 1, [], [self._left])

    def _launch_step(self, end):
        wp.capture_if(self._pairs.listed, self._launch_full, self._launch_plain, end=end)

    def _launch_full(self, end):
        pairs, (x, _v) = self._pairs, self._plain.state
        pairs.launch_begin(x)
        self._dynamic.add(x, self._plain.gradient)
        self._plain.launch(1, end)

    def _launch_plain(self, end):
        pairs, (x, v), model = self._pairs, self._plain.state, self._pairs.model
        wp.copy(pairs.x_before, x)
        wp.copy(self._v_before, v)
        self._plain.launch(1, lambda *moved: None)
        self._again.zero_()
        near = pairs.proximity
        near.launch_drift(pairs.x_before)
        given = [near.drift, near.found, near.listed, pairs.x_before, x, self._limits]
        model.launch(self._test, self._dim, given, [self._again])
        wp.capture_if(self._again, self._launch_again, self._launch_count, end=end)

    def _launch_again(self, end):
        x, v = self._plain.state
        wp.copy(x, self._pairs.x_before)
        wp.copy(v, self._v_before)
        self._launch_full(end)

    def _launch_count(self, end):
        model = self._pairs.model
        model.launch(self._count, model.copies, [], [self._pairs.steps])
        if self._pairs.friction is not None:
            self._pairs.friction.launch_release()
