"""The entry to code that only increases speed. Each backend computes the same as the core, up to rounding.

- ``core``: gradients and corrections term by term, then an update of the vertices.
- ``blocks``, for the CPU: an explicit step is one launch over blocks of vertices. Jacobi sweeps scatter corrections while they
  compute them. Gradients are those of the core.
- ``gather``, for CUDA: a gradient, a Jacobi sweep or an explicit step is one launch for all terms. One launch may do several
  explicit steps.

Tests compare each backend with the core.
"""

from functools import partial

import warpcloth.fast as fast

from ..base.checks import choice
from ..core.explicit_step import ExplicitStep
from ..core.gradient import Gradient
from ..core.jacobi_sweeps import JacobiSweeps
from .compensation import needs_compensation

BACKENDS = ("auto", "core", "blocks", "gather")


class Plan:
    """The backend of a model: it makes the gradients, explicit steps and Jacobi sweeps that solvers ask for.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        backend: One of ``"core"``, ``"blocks"`` and ``"gather"``.

    Attributes:
        model, backend: As given.
        record: The :class:`warpcloth.core.explicit_step.StepRecord` of the explicit steps, or None before they are made.
        guard: The :class:`warpcloth.fast.contact_guard.ContactGuard` by which they take contact themselves, or None.
    """

    def __init__(self, model, backend):
        self.model, self.backend, self.record, self.guard = model, backend, None, None

    def gradient(self, corrected=False, terms=None, dynamic=()):
        """Returns a :class:`warpcloth.core.gradient.Gradient`, or a faster class with the same methods."""
        made = fast.GatherGradient if self.backend == "gather" else Gradient
        return made(self.model, corrected, terms, dynamic)

    def explicit_step(self, state, h, symplectic, count, colliders=None, pairs=None):
        """Returns a :class:`warpcloth.core.explicit_step.ExplicitStep`, or a faster class with the same methods.

        Args:
            state: x and v (N,), which the steps update.
            h: Step [s].
            symplectic: Whether x is updated with v after the step.
            count: Number of steps of the moved pins (B,) int32, or None.
            colliders: The :class:`warpcloth.contact.collider_steps.ColliderSteps`, with which faster classes handle contact
                themselves. None: the terms and the end of each step handle it.
            pairs: The :class:`warpcloth.contact.self_steps.SelfSteps` of self-contact and mesh colliders, or None.
        """
        core, given = partial(ExplicitStep, count=count), (state, h, symplectic)
        if self.model.dynamic:
            blocks = self.backend == "blocks" and self.model.uniform and colliders is None
            plain = (fast.BlockStep if blocks else core)(self.model.with_dynamic(()), *given)
            steps = fast.TouchingSteps(plain, pairs)
        else:
            backend = self.backend if self.model.uniform else "core"
            if colliders is not None and not self.model.colliders.plain:
                backend = "core"
            given = *given, needs_compensation(self.model)
            if colliders is not None and backend != "core":
                self.guard = fast.ContactGuard(self.model, colliders)
                given = *given, self.guard
            made = core if backend == "core" else fast.BlockStep if backend == "blocks" else fast.GatherStep
            steps = made(self.model, *given)
        self.record = steps.record
        return steps

    def jacobi_sweeps(self, *given):
        """Returns a :class:`warpcloth.core.jacobi_sweeps.JacobiSweeps`, or a faster class with the same interface."""
        if self.model.mobility is not None or self.backend == "core":
            return JacobiSweeps(self.model, *given)
        return (fast.ScatterSweeps if self.backend == "blocks" else fast.GatherSweeps)(self.model, *given)


def plan(model, backend="auto"):
    """Returns the :class:`Plan` of a model.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        backend: One of :data:`BACKENDS`; ``"auto"`` is ``"gather"`` on CUDA and ``"blocks"`` on the CPU.

    Raises:
        ValueError: There is no such backend, or the device does not support it.
    """
    choice("backend", backend, BACKENDS)
    if backend == "auto":
        backend = "gather" if model.device.is_cuda else "blocks"
    if backend == "blocks" and model.device.is_cuda:
        raise ValueError(f"backend is 'blocks' on {model.device}; it is for the CPU")
    return Plan(model, backend)
