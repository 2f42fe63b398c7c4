"""The loop of the implicit methods, on a method whose residuals are written down."""

from types import SimpleNamespace

import numpy as np

from warpcloth.core.status import Result
from warpcloth.numerics.iterate import GravityScale, iterate


class Written:
    """A method of the residuals (iterations + 1, B), whose copies stall where they say so."""

    def __init__(self, residuals, stalled):
        self.residuals, self.stalled = np.array(residuals), np.array(stalled)
        self.model, self.active = SimpleNamespace(copies=self.residuals.shape[1]), []

    def start(self):
        self.done = 0

    def measure(self):
        return self.residuals[self.done], {Result.STALLED: self.stalled[self.done]}

    def iterate(self, active):
        self.active.append(active.tolist())
        self.done += 1


def test_each_copy_ends_in_its_own_way_and_keeps_its_residual():
    """It converges, stalls, diverges or uses the iterations up; what its residual is later does not count."""
    residuals = [[9.0, 9.0, 9.0, 9.0], [0.5, 8.0, np.nan, 7.0], [np.nan, 0.1, 0.1, 5.0], [3.0, 3.0, 3.0, 4.0]]
    stalled = [[False] * 4, [False, True, True, False], [True] * 3 + [False], [False] * 4]
    method = Written(residuals, stalled)
    ended = iterate(method, tolerance=1.0, iterations=3)
    assert ended.results == [Result.CONVERGED, Result.STALLED, Result.DIVERGED, Result.ITERATIONS_USED_UP]
    assert np.array_equal(ended.residual, [0.5, 8.0, np.nan, 4.0], equal_nan=True) and ended.iterations == 3
    assert method.active == [[True] * 4, [False, False, False, True], [False, False, False, True]]


def test_a_solution_takes_no_iteration():
    method = Written([[0.5], [0.4]], [[True], [True]])
    assert iterate(method, tolerance=1.0, iterations=5) == ([Result.CONVERGED], [0.5], 0) and not method.active


def test_residuals_are_relative_to_gravity_or_to_what_there_is():
    gravity = SimpleNamespace(numpy=lambda: np.array([[0.0, -9.81, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    scale = GravityScale(SimpleNamespace(gravity=gravity))
    assert np.allclose(scale.or_else(np.array([3.0, 4.0, 0.0])), [9.81, 4.0, 1.0], rtol=1e-6)
