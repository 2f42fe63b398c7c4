"""Explicit steps by blocks of vertices, for the CPU: one launch per step, one thread per copy."""

import warp as wp

import warpcloth.fast as fast

from ..core.explicit_step import StepRecord
from ..core.gradient import Gradient
from ..kernels.fast import block_step as kernels
from ..kernels.fast.guard import NoGuard
from ..kernels.fast.term_facts import TermFacts
from ..terms.refresh import STEP, Moment
from .block_layout import block_layout
from .structs import chained, int32_array


class BlockStep:
    """Explicit steps in one launch, see :func:`warpcloth.kernels.fast.block_step.block_step`.

    Forces of refreshed terms are added before. An undamped quadratic energy is replaced by the pairs of its matrix, see
    :mod:`warpcloth.fast.quadratic_pairs`.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        state: x and v (N,), which steps update.
        h: Step [s].
        symplectic: Whether x is updated with v after the step.
        compensated: Whether x is updated by compensated summation.
        guard: The :class:`warpcloth.fast.contact_guard.ContactGuard` of a model with colliders.

    Attributes:
        gradient: ∂U/∂x (N,) [N] of everything else, to which steps add; 0 after each step.
        residual: Position residual of compensated summation (N,) [m], or None.
        record: :class:`warpcloth.core.explicit_step.StepRecord`.
    """

    def __init__(self, model, state, h, symplectic, compensated=False, guard=None):
        self.model, self.state, self._guard = model, state, guard
        declared = guard.terms if guard else model.terms
        quadratic = [each.term.whole.quadratic and each.damping is None for each in declared]
        terms = [fast.as_pairs(model, each) if now else each for each, now in zip(declared, quadratic, strict=True)]
        pairs = tuple(now.label for now, before in zip(terms, declared, strict=True) if now is not before)
        refreshed, swept = ([each for each in terms if (each.refresh is not None) == apart] for apart in (True, False))
        self._refreshed, self.gradient = Gradient(model, terms=refreshed), wp.zeros_like(state[0])
        self.record = StepRecord("blocks", pairs=pairs, compensated=compensated)
        vertices, swept, arrays, numbers = block_layout(swept, model.per_copy, model.copies)
        damped = [elements.damping is not None for elements in swept]
        parts = [TermFacts(each.term, own, 0 in each.stiffness.strides) for each, own in zip(swept, damped, strict=True)]
        # Fused multiply–add, as on CUDA: springs then take 0.8 of the time.
        flags = f"{wp.config.cpu_compiler_flags or ''} -ffp-contract=fast"
        contact = (guard.kernels, guard.moving) if guard else ()
        self._kernel = model.kernel(kernels.block_step, tuple(parts), model.dtype, symplectic, flags, compensated, *contact)
        self.residual = wp.zeros_like(state[0]) if compensated else None
        self._arrays = arrays  # the structs hold no references
        scratch = [
            wp.zeros(size, dtype=model.dtype, device=model.device) for size in (numbers, numbers * (compensated or any(damped)))
        ]
        chain = chained(parts, arrays, model.dtype)
        self._given = [chain, int32_array(vertices, model.device), model.inverse_mass, model.gravity]
        self._given += [guard.data if guard else NoGuard(), h, *scratch]

    def launch(self, steps, move_pins):
        """Launches a number of steps, and ``move_pins`` (x, v) after each."""
        model, (x, v) = self.model, self.state
        for _ in range(steps):
            if self._guard:
                self._guard.launch_start(x)
            model.refresh(STEP, Moment(x), self._refreshed.terms)
            self._refreshed.add(x, self.gradient)
            model.launch(self._kernel, model.copies, self._given, [self.gradient, x, v, self.residual])
            move_pins(x, v)
            if self._guard:
                self._guard.launch_end(x)
