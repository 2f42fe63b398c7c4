"""How a step and a run end; silence is not among the ways."""

from enum import Enum
from typing import NamedTuple

import numpy as np


class Result(Enum):
    """How a step or a run ended, from good to bad; the value is what is shown."""

    COMPLETED = "completed"
    CONVERGED = "converged"
    ROUNDED = "converged as far as rounding allows"
    ITERATIONS_USED_UP = "iterations used up"
    STALLED = "no step lowers the energy"
    SADDLE = "in balance, but not where the energy is least"
    CONTRADICTED = "constraints contradict one another"
    DIVERGED = "diverged"

    def worse(self, other):
        """The worse of two results."""
        order = list(Result)
        return max(self, other, key=order.index)


class Status(NamedTuple):
    """How a run ended.

    Attributes:
        result: The worst of any step and copy.
        frame: The last frame in which a copy is good.
        residual: The largest relative residual of any step and copy; 0 of methods that have none.
        message: One sentence.
        good: The last good frame of each copy, (B,).
    """

    result: Result
    frame: int = 0
    residual: float = 0.0
    message: str = ""
    good: np.ndarray | None = None

    @property
    def ok(self):
        """False if a copy diverged."""
        return self.result is not Result.DIVERGED
