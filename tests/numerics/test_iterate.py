"""The loop of the methods that iterate: how copies end, each by itself."""

from types import SimpleNamespace

import numpy as np
import pytest

from warpcloth.core.status import Result
from warpcloth.numerics.iterate import iterate

NAN, INF = np.nan, np.inf
STUCK = 0.3  # of which the method below says so
# Residuals of a copy, one a call; how it ends, with which of them, and after how many iterations.
COPIES = {
    "converges": ([1.0, 0.5, 0.1, 0.05, 7.0], Result.CONVERGED, 0.1, 2),  # at the tolerance; what comes after is not its own
    "has converged": ([0.1, 7.0], Result.CONVERGED, 0.1, 0),
    "diverges": ([1.0, NAN, 0.0], Result.DIVERGED, NAN, 1),
    "overflows": ([1.0, 2.0, INF, 0.0], Result.DIVERGED, INF, 2),
    "sticks": ([1.0, STUCK, 0.0], Result.STALLED, STUCK, 1),
    "takes too long": ([1.0, 0.9, 0.8, 0.7, 0.6], Result.ITERATIONS_USED_UP, 0.6, 4),
}


class Scripted:
    """A method whose copies have the residuals that are written down."""

    def __init__(self, names):
        self.rows, self.active = [COPIES[name][0] for name in names], []
        self.model, self.calls = SimpleNamespace(copies=len(names)), 0

    def start(self):
        self.calls = 0

    def measure(self):
        now = np.array([row[min(self.calls, len(row) - 1)] for row in self.rows])
        return now, {Result.STALLED: now == STUCK}

    def iterate(self, active):
        self.active.append(active.copy())
        self.calls += 1


@pytest.mark.parametrize("names", [*([name] for name in COPIES), list(COPIES)], ids=lambda names: " and ".join(names)[:20])
def test_each_copy_ends_in_its_own_way(names):
    method = Scripted(names)
    found = iterate(method, 0.1, 4)
    _, results, residuals, counts = zip(*(COPIES[name] for name in names), strict=True)
    assert found.results == list(results)
    np.testing.assert_array_equal(found.residual, residuals)
    assert found.iterations == max(counts) and len(method.active) == found.iterations
    for done, active in enumerate(method.active):
        assert active.tolist() == [count > done for count in counts], "who has ended takes no part"
