"""Results of steps and runs, and the message about how a run ended."""

from enum import Enum
from typing import NamedTuple

import numpy as np


class Result(Enum):
    """How a step or a run ended, from best to worst; the value is the text that users see."""

    COMPLETED = "completed"
    CONVERGED = "converged"
    ROUNDED = "converged as far as rounding allows"
    ITERATIONS_USED_UP = "iterations used up"
    INACCURATE = "error above its tolerance with the shortest step"
    STALLED = "no step lowers the energy"
    SADDLE = "in balance, but not where the energy is least"
    CONTRADICTED = "constraints contradict one another"
    DIVERGED = "diverged"
    STOPPED = "stopped"

    def worse(self, other):
        """Returns the worse of two results."""
        order = list(Result)
        return max(self, other, key=order.index)


class Stopped(ValueError):
    """A step cannot be taken, so the run ends before it; the message says why."""


UNBALANCED = "largest unbalanced acceleration of a vertex"

# How a result can be used that is neither clearly good nor clearly bad.
_NEAR = "usable if this is near enough to the solution"


class Residual(NamedTuple):
    """The quantity that a solver reports as its residual.

    Attributes:
        measure: Name of the quantity. A run reports the largest value of any step.
        weightless: Its unit in a scene without gravity.
        unit: Its unit in a scene with gravity.
    """

    measure: str
    weightless: str
    unit: str = "times gravity"


class Status(NamedTuple):
    """How a run ended.

    Attributes:
        result: The worst result of any step and copy.
        frame: The last frame in which a copy is good.
        residual: The largest residual of any step; with B > 1 copies one per copy, (B,). 0 for methods without a residual.
        message: How it ended, whether the result can be used, and the residual with its unit and tolerance.
        good: The last good frame of each copy, (B,).
        measure: The quantity that the residual measures, or None for methods without a residual.
        unit: The unit of the residual, that of the worst copy if there are several; or None.
    """

    result: Result
    frame: int = 0
    residual: float | np.ndarray = 0.0
    message: str = ""
    good: np.ndarray | None = None
    measure: str | None = None
    unit: str | None = None

    @property
    def ok(self):
        """Whether no copy diverged and the run was not stopped."""
        return self.result not in (Result.DIVERGED, Result.STOPPED)


def sentence(result, dtype, residual=None, measure=None, unit=None, tolerance=None, copy=None, use=None, held=0.0):
    """Returns a message: how a run ended, whether its result can be used, and the residual with its unit and tolerance.

    Args:
        result: The worst :class:`Result` of any step.
        dtype: The precision, ``"float32"`` or ``"float64"``.
        residual: The largest residual.
        measure: The quantity that it measures, or None for methods without a residual.
        unit: Its unit.
        tolerance: The tolerance it was compared with, or None for methods that do not check it.
        copy: The copy whose residual it is, or None if there is one copy.
        use: How the result can be used; None for what holds for a run over time.
        held: The largest distance by which cloth held back a pin [m], or 0. The result is then usable only if that may be.
    """
    use = use or {
        Result.COMPLETED: "usable" if measure is None else _NEAR,
        Result.CONVERGED: "usable",
        Result.ROUNDED: f"usable, as near to the solution as {dtype} comes",
    }.get(result, _NEAR)
    where = " in a step or more" if use is _NEAR and result is not Result.COMPLETED else ""
    if held > 0.0:
        rest = use.removeprefix("usable").replace(" if ", " and if ", 1)
        use = f"usable if cloth may hold pins back from their keyframes by up to {digits(held)} m{rest}"
    text = f"{result.value}{where}; {use}"
    if measure is None:
        return text
    compared = "this solver has no tolerance" if tolerance is None else f"tolerance {tolerance:g}"
    whose = "" if copy is None else f", in copy {copy}"
    return f"{text}: {measure} {digits(residual)} {unit}{whose} ({compared})"


def digits(value):
    """Formats a number with two significant digits, below a million without an exponent."""
    return f"{float(f'{value:.2g}'):.0f}" if 100.0 <= value < 1e6 else f"{value:.2g}"
