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


class Grade(Enum):
    """How far the result of a run can be used, from best to worst; the value is the text that users see."""

    CONVERGED = "converged"
    COMPLETED = "completed"
    NOT_USABLE = "not usable"


UNBALANCED = "largest unbalanced acceleration of a vertex"


class Residual(NamedTuple):
    """The quantity that a solver reports as its residual.

    Attributes:
        measure: Name of the quantity. A run reports the largest value of any step, divided by an acceleration of the scene.
    """

    measure: str


class Status(NamedTuple):
    """How a run ended, and whether its result can be used. As a condition it is :attr:`ok`.

    Attributes:
        result: The worst result of any step and copy; the cause.
        frame: The last frame in which a copy is good.
        residual: The largest residual of any step; with B > 1 copies one per copy, (B,). 0 for methods without a residual.
        message: The grade, the distance, the result, and the residual with its unit and tolerance.
        good: The last good frame of each copy, (B,).
        measure: The quantity that the residual measures, or None for methods without a residual.
        unit: The unit of the residual, that of the worst copy if there are several; or None.
        grade: The worst :class:`Grade` of any copy.
        distance: The largest distance of a vertex from the solution of the last step of a frame [m], or a bound of it; with B >
            1 copies one per copy, (B,). NaN where it is not known.
        grades: The grade of each copy, a tuple of B.
    """

    result: Result
    frame: int = 0
    residual: float | np.ndarray = 0.0
    message: str = ""
    good: np.ndarray | None = None
    measure: str | None = None
    unit: str | None = None
    grade: Grade = Grade.COMPLETED
    distance: float | np.ndarray = np.nan
    grades: tuple = ()

    @property
    def ok(self):
        """Whether the result can be used, in all copies."""
        return self.grade is not Grade.NOT_USABLE

    def __bool__(self):
        return self.ok

    @property
    def complete(self):
        """Whether no copy diverged and the run was not stopped, so that every frame was computed."""
        return self.result not in (Result.DIVERGED, Result.STOPPED)


def sentence(
    result,
    grade,
    distance=np.nan,
    residual=None,
    measure=None,
    unit=None,
    tolerance=None,
    copy=None,
    why="",
    of="the last step of each frame (errors of steps add up)",
):
    """Returns a message: whether a result can be used, how it ended, and the residual with its unit and tolerance.

    Args:
        result: The worst :class:`Result` of any step.
        grade: The worst :class:`Grade`.
        distance: The largest distance from the solution of a step [m], NaN if it is not known.
        residual: The largest residual.
        measure: The quantity that it measures, or None for methods without a residual.
        unit: Its unit.
        tolerance: The tolerance it was compared with, or None for methods that do not check it.
        copy: The copy whose residual it is, or None if there is one copy.
        why: Why the result is not usable, and what to do.
        of: That of which ``distance`` is from the solution.
    """
    ended, figure = result.value + (" in one or more steps" if result in _OF_STEPS else ""), ""
    if measure is not None:
        compared = "this solver has no tolerance" if tolerance is None else f"tolerance {tolerance:g}"
        whose = "" if copy is None else f", in copy {copy}"
        figure = f"{measure} {digits(residual)} {unit}{whose} ({compared})"
    if grade is Grade.NOT_USABLE:
        ended = "" if result is Result.COMPLETED else ended
        return "; ".join(filter(None, (f"{grade.value}: {why}", ": ".join(filter(None, (ended, figure))))))
    text = ended if ended.startswith(grade.value) else grade.value + (f", {ended}" if result is not Result.COMPLETED else "")
    if grade is Grade.COMPLETED:
        near = "at an unknown distance from" if np.isnan(distance) else f"within {millimetres(distance)} of"
        text = text.replace(grade.value, f"{grade.value} {near} the solution of {of}", 1)
    return text + (f": {figure}" if figure else "")


_OF_STEPS = (Result.ITERATIONS_USED_UP, Result.STALLED, Result.INACCURATE, Result.SADDLE, Result.CONTRADICTED)


def millimetres(value):
    """Formats a length [m] in millimetres with two significant digits."""
    return f"{digits(1e3 * value)} mm"


def digits(value):
    """Formats a number with two significant digits, below a million without an exponent."""
    rounded = float(f"{value:.2g}")
    return f"{rounded:.0f}" if 100.0 <= rounded < 1e6 else f"{rounded:.2g}"
