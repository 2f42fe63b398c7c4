"""The one door to code for speed alone: each backend does the work of the core, with the same results but for rounding.

- ``core``, the readable one: gradients and corrections term by term, then an update of the vertices.
- ``blocks``, for the CPU: an explicit step is one launch over blocks of vertices, and of several threads each has a subdomain;
  Jacobi sweeps scatter corrections while they compute them; gradients are those of the core.
- ``gather``, for CUDA: gradients, Jacobi sweeps and explicit steps are one launch for all terms, or one for several steps.

Tests run each backend by its name and compare it with the core.
"""

from ..base.checks import choice
from ..core.explicit_step import ExplicitStep
from ..core.gradient import Gradient
from ..core.jacobi_sweeps import JacobiSweeps
from .block_step import BlockStep
from .compensation import needs_compensation
from .gather_corrections import GatherSweeps
from .gather_gradient import GatherGradient
from .gather_step import GatherStep
from .scatter_corrections import ScatterSweeps
from .step_record import StepRecord
from .subdomains import SubdomainSteps

BACKENDS = ("auto", "core", "blocks", "gather")


class Plan:
    """How the work of a model is done.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        backend: One of ``"core"``, ``"blocks"`` and ``"gather"``.

    Attributes:
        model, backend: As given.
        record: :class:`warpcloth.fast.step_record.StepRecord` of the explicit steps, once they are made; else None.
    """

    def __init__(self, model, backend):
        self.model, self.backend, self.record = model, backend, None

    def gradient(self, corrected=False, terms=None):
        """Returns a :class:`warpcloth.core.gradient.Gradient`, or a faster one of the same methods."""
        return (GatherGradient if self.backend == "gather" else Gradient)(self.model, corrected, terms)

    def explicit_step(self, state, h, symplectic, count, pool):
        """Returns explicit steps, see :class:`warpcloth.core.explicit_step.ExplicitStep`.

        Args:
            state: x and v (N,), which steps move on.
            h: Step [s].
            symplectic: Whether x moves on by the v after the step.
            count: Steps that moved pins have made (B,) int32, or None.
            pool: The :class:`warpcloth.core.thread_pool.ThreadPool` that shares them.

        Raises:
            ValueError: If threads cannot share them, naming the term.
        """
        given = self.model, state, h, symplectic, count, needs_compensation(self.model)
        if self.model.mobility is not None and pool.threads == 1:
            return ExplicitStep(*given)
        if pool.threads > 1:
            _refuse_undivided(self.model, self.backend, pool.threads)
            steps = SubdomainSteps(*given, pool)
        elif self.backend == "core":
            self.record = StepRecord("core", compensated=given[-1])
            return ExplicitStep(*given)
        else:
            steps = {"blocks": BlockStep, "gather": GatherStep}[self.backend](*given)
        self.record = steps.record
        return steps

    def jacobi_sweeps(self, *given):
        """Returns Jacobi sweeps, see :class:`warpcloth.core.jacobi_sweeps.JacobiSweeps`, whose arguments they have."""
        if self.model.mobility is not None:
            return JacobiSweeps(self.model, *given)
        return {"core": JacobiSweeps, "blocks": ScatterSweeps, "gather": GatherSweeps}[self.backend](self.model, *given)


def plan(model, backend="auto"):
    """Returns the :class:`Plan` of a model.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        backend: One of :data:`BACKENDS`; ``"auto"`` is that of the device.

    Raises:
        ValueError: If there is no such backend, or the device cannot have it.
    """
    choice("backend", backend, BACKENDS)
    if backend == "auto":
        backend = "gather" if model.device.is_cuda else "blocks"
    if backend == "blocks" and model.device.is_cuda:
        raise ValueError(f"backend is 'blocks' on {model.device}; it is for the CPU")
    return Plan(model, backend)


def _refuse_undivided(model, backend, threads):
    """Refuses one cloth with terms that subdomains do not have, and backends without subdomains.

    Raises:
        ValueError: Naming the term or the backend.
    """
    if backend != "blocks":
        raise ValueError(f"threads is {threads} with backend {backend!r}; more than 1 is for 'blocks'")
    if model.mobility is not None:
        raise ValueError(
            f"threads is {threads} with one copy that has free_axes, whose steps Explicit cannot divide; threads=1 can, and "
            "copies are shared out with every solver"
        )
    for elements in model.terms:
        if elements.refresh:
            raise ValueError(
                f"threads is {threads} with one copy, whose {elements.label} Explicit cannot divide; threads=1 can, or PBD "
                "and XPBD, and copies are shared out with every solver"
            )
