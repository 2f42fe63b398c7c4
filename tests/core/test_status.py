"""How steps and runs end."""

from itertools import product

import pytest

from warpcloth.core.status import Result

# From good to bad, as a user would take them: what is near enough is better than what cannot be, and nothing is worse than
# numbers that mean nothing.
ORDER = ["COMPLETED", "CONVERGED", "ROUNDED", "ITERATIONS_USED_UP", "STALLED", "SADDLE", "CONTRADICTED", "DIVERGED"]


@pytest.mark.parametrize(("one", "other"), product(ORDER, repeat=2))
def test_the_worse_of_two_results_stays(one, other):
    """So a run whose last step converged says what happened before."""
    worse = max(one, other, key=ORDER.index)
    assert Result[one].worse(Result[other]) is Result[worse]
