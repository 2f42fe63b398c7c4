"""The plain explicit step: the gradient, then v += h(g − M⁻¹∇U) and x += h v. Tests compare faster backends with it."""

from typing import NamedTuple

from ..kernels import explicit_step as kernels
from ..model.damping import dissipations
from ..terms.refresh import STEP, Moment
from .gradient import Gradient


class StepRecord(NamedTuple):
    """How explicit steps are taken.

    Attributes:
        backend: ``"core"``, ``"blocks"`` or ``"gather"``.
        lanes: GPU threads per vertex.
        block: Threads of a block that takes several steps of one copy in one launch, or 0.
        pairs: Labels of the quadratic terms whose forces are computed from the entries of their matrix.
        compensated: Whether x is updated by compensated summation.
        packed: Whether the position residual is packed into four bytes.
    """

    backend: str
    lanes: int = 1
    block: int = 0
    pairs: tuple[str, ...] = ()
    compensated: bool = False
    packed: bool = False


class ExplicitStep:
    """Explicit steps of several launches, on any device.

    The gradient of the dissipation is evaluated at x + h v, see :class:`warpcloth.kernels.term.Dissipation`. With compensated
    positions, forces are evaluated at x + residual.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        state: x and v (N,), which the steps update.
        h: Step [s].
        symplectic: Whether x is updated with v after the step.
        compensated: Whether x is updated by compensated summation.
        count: Number of steps that moving pins have made (B,) int32, or None.

    Attributes:
        gradient: ∂U/∂x (N,) [N]. Callers may add other forces before a step; it is 0 after each step.
        residual: Position residual of compensated summation (N,) [m], or None.
        record: :class:`StepRecord`.
    """

    def __init__(self, model, state, h, symplectic, compensated=False, count=None):
        self.model, self.state, self.record = model, state, StepRecord("core", compensated=compensated)
        self.residual = model.vectors() if compensated else None
        self.gradient, self._elastic = model.vectors(), Gradient(model, corrected=compensated)
        self._damped = dissipations(model, h)
        self._dissipative = Gradient(model, corrected=True, terms=self._damped)
        self._ahead = model.vectors() if self._damped else None
        self._move_ahead = model.kernel(kernels.move_ahead, model.dtype)
        self._step = model.kernel(kernels.explicit_step, model.dtype, symplectic, compensated)
        self._given = [model.inverse_mass, *model.free_gravity, h]
        self._time = {"steps": count, "per_frame": round(1.0 / (model.scene.fps * h)), "he": h}

    def launch(self, steps, move_pins):
        """Launches this number of steps, and calls ``move_pins(x, v)`` after each."""
        model, (x, v) = self.model, self.state
        for _ in range(steps):
            model.refresh(STEP, Moment(x, v=v, explicit=True, **self._time))
            model.refresh(STEP, Moment(x), self._damped)
            self._elastic.add(x, self.gradient, self.residual)
            if self._damped:
                model.launch(self._move_ahead, model.count, [v, self._given[-1]], [self._ahead])
                self._dissipative.add(x, self.gradient, self._ahead)
            model.lock(self.gradient)
            model.launch(self._step, model.count, self._given, [self.gradient, x, v, self.residual])
            move_pins(x, v)
