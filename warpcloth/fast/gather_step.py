"""Explicit steps that gather over the elements of each vertex, for CUDA: one launch per step, or for several."""

import warp as wp

from ..core.explicit_step import StepRecord
from ..kernels.fast import gather_step as kernels
from ..kernels.fast.guard import NoGuard
from ..terms.refresh import EVALUATION, STEP, Moment
from .compensation import packed_unit
from .gather_layout import gathered, lanes_of
from .structs import chained

# Threads of a block that takes a copy. For 1024 vertices, 256 threads take 2.1 times as long, 1024 threads 1.2 times (H200).
THREADS = 512
# Maximum number of vertices of such a copy. 132 copies of 64² vertices take 1.5 times as long as with launches.
VERTICES = 1024


class GatherStep:
    """Explicit steps that gather, see :func:`warpcloth.kernels.fast.gather_step.gather_step`.

    x, the residual and, if a term is damped, v alternate between two arrays; after an odd number of steps they are copied back.
    The residual is packed if :func:`warpcloth.fast.compensation.packed_unit` gives a unit, see
    :mod:`warpcloth.kernels.fast.packed_residual`. If :func:`block_of` gives threads, a block of them takes all steps of a copy
    in one launch.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        state: x and v (N,), which steps update.
        h: Step [s].
        symplectic: Whether x is updated with v after the step.
        compensated: Whether x is updated by compensated summation.
        guard: The :class:`warpcloth.fast.contact_guard.ContactGuard` of a model with colliders.

    Attributes:
        residual: Position residual of compensated summation (N,), vectors [m] or packed; or None.
        record: :class:`warpcloth.core.explicit_step.StepRecord`.
    """

    def __init__(self, model, state, h, symplectic, compensated=False, guard=None):
        model = model if guard is None else model.with_terms(guard.terms)
        self.model, self._guard = model, guard
        self._found = [gathered(model, elements, elements.damping is not None) for elements in model.terms]
        parts = [part for part, _arrays in self._found]
        fast = model.device.is_cuda and model.dtype is wp.float32
        key, contact = (tuple(parts), model.dtype, symplectic, fast), guard and guard.kernels
        unit = packed_unit(model) if compensated else None
        residual_type = None if not compensated else wp.int32 if unit else model.vec3
        self._lanes, self._block = lanes_of(model), 0 if compensated or (guard and guard.moving) else block_of(model, parts)
        self.record = StepRecord(
            "gather",
            lanes=self._lanes,
            block=self._block,
            pairs=tuple(elements.label for elements, part in zip(model.terms, parts, strict=True) if part.rows),
            compensated=compensated,
            packed=unit is not None,
        )
        if self._block:
            self._kernel = model.kernel(kernels.gather_steps_of_copies, *key, self._block, contact)
        else:
            more = model.copies == 1, self._lanes, residual_type, contact, bool(guard and guard.moving)
            self._kernel = model.kernel(kernels.gather_step, *key, *more)
        chain = chained(parts, [arrays for _part, arrays in self._found], model.dtype)
        (x, v), damped = state, any(part.damped for part in parts)
        self.residual, other = (
            wp.zeros(model.count, dtype=residual_type, device=model.device) if compensated else None for _ in range(2)
        )
        self._states = [(x, v, self.residual), (model.vectors(), model.vectors() if damped else v, other)]
        data = guard.data if guard else NoGuard()
        data.per_copy = model.per_copy
        self._given, self._h = [chain, model.inverse_mass, model.gravity, data], h
        self._unit = unit or 1.0

    def launch(self, steps, move_pins):
        """Launches a number of steps, and ``move_pins`` (x, v) after each."""
        model = self.model
        if self._block:  # and nothing has to come between steps
            if self._guard:
                self._guard.launch_start(self._states[0][0])
            dim, states = (model.copies, self._block), [*self._states[0][:2], *self._states[1][:2]]
            model.launch(self._kernel, dim, [*self._given, self._h, steps], states, block_dim=self._block)
            return
        for step in range(steps):
            before, after = self._states[step % 2], self._states[1 - step % 2]
            if self._guard:
                self._guard.launch_start(before[0])
            for when in (STEP, EVALUATION):
                model.refresh(when, Moment(before[0]))
            model.launch(self._kernel, model.count * self._lanes, [*self._given, *before, self._h, self._unit], [*after])
            move_pins(*after[:2])
            if self._guard:
                self._guard.launch_end(after[0])
        if steps % 2:
            for array, last in zip(*self._states, strict=True):
                if array is not last:
                    wp.copy(array, last)


def block_of(model, parts):
    """Number of threads of the block that takes all steps of a small copy in one launch; 0 if each step needs a launch.

    The arrays of a copy then stay in the cache of the multiprocessor: the springs of 132 copies of 32² vertices take 0.53 of
    the time of launches, those of 4096 copies 0.47. A few copies are as fast with several threads per vertex, since blocks
    would leave multiprocessors idle.
    """
    between = model.pins is not None or any(elements.refresh for elements in model.terms)
    if between or lanes_of(model) > 1 or model.per_copy > VERTICES or not all(part.pairs for part in parts):
        return 0
    return min(THREADS, -(-model.per_copy // 32) * 32) if model.device.is_cuda else 1
