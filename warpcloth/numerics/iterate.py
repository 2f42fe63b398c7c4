"""The loop of iterative methods that minimise, and the scale of their residuals."""

from typing import NamedTuple

import numpy as np

from ..core.status import Result


class Ended(NamedTuple):
    """How the iterations of each copy ended.

    Attributes:
        results: A :class:`Result` of each copy, a list of B.
        residual: The last residual of each copy, (B,).
        iterations: Number of iterations.
    """

    results: list
    residual: np.ndarray
    iterations: int


def iterate(method, tolerance, iterations):
    """Iterates until each copy has converged, diverged or cannot improve, or the iterations are used up.

    Args:
        method: An object with the ``model`` and three functions:

            - ``start()`` sets the first iterate.
            - ``measure()`` returns the residual (B,) of the iterate, not finite in a copy that diverged, and a dict from other
              :class:`Result` values to booleans (B,), which copies end with them.
            - ``iterate(active)`` does one iteration of the active copies, (B,) booleans.

        tolerance: The residual at which a copy has converged.
        iterations: Maximum number of iterations.

    Returns:
        :class:`Ended`. A copy that has ended keeps its residual and its result.
    """
    method.start()
    copies = method.model.copies
    active, residual = np.ones(copies, dtype=bool), np.zeros(copies)
    results = [Result.ITERATIONS_USED_UP] * copies
    done = 0
    while True:
        now, others = method.measure()
        residual = np.where(active, now, residual)
        ways = {Result.DIVERGED: ~np.isfinite(residual), Result.CONVERGED: residual <= tolerance, **others}
        for result, ended in ways.items():
            for copy in np.flatnonzero(active & ended):
                results[copy] = result
            active &= ~ended
        if not active.any() or done == iterations:
            return Ended(results, residual, done)
        method.iterate(active)
        done += 1


class GravityScale:
    """The acceleration by which the residuals of each copy are divided: gravity, if there is any.

    Args:
        model: The :class:`warpcloth.model.model.Model`.

    Attributes:
        gravity: Magnitude of gravity (B,) [m/s²].
    """

    def __init__(self, model):
        self.gravity = np.linalg.norm(model.gravity.numpy().astype(np.float64), axis=1)

    def or_else(self, acceleration):
        """Returns gravity (B,) [m/s²]; ``acceleration`` (B,) where gravity is 0, and 1 m/s² where both are."""
        scale = np.where(self.gravity > 0.0, self.gravity, acceleration)
        return np.where(scale != 0.0, scale, 1.0)
