"""The largest eigenvalue of a large matrix, which is only multiplied, against all eigenvalues of a small one."""

import numpy as np
import pytest

import warpcloth as wc
from warpcloth.numerics import eigenvalues
from warpcloth.solvers.explicit import step_limits


@pytest.mark.parametrize("damping", [None, 0.02])
def test_a_large_matrix_has_the_limit_of_a_small_one(damping, device, monkeypatch):
    """The eigenvalue is too large by its residual, at most 1 %, so that the step is too small by at most 1 %."""
    terms = [wc.Spring(stiffness=1e3, damping=damping), wc.QuadraticBending(stiffness=1e-4)]
    mesh, free = wc.Mesh.grid(8, 8, pattern="alternating"), np.ones((64, 3), dtype=bool)
    free[5, 0] = False
    model = wc.Scene(mesh, density=0.1, terms=terms, pins="corners", free_axes=free).build(device=device)
    x = model.array(model.rest_points, model.vec3)
    exact = np.linalg.eigvalsh(eigenvalues.over_mass(model, model.terms, x).toarray())[-1]
    rest, motion = step_limits(model)
    monkeypatch.setattr(eigenvalues, "LARGE", 0)
    assert exact * (1.0 - 1e-6) <= eigenvalues.largest(eigenvalues.over_mass(model, model.terms, x))[0] <= 1.01 * exact
    assert 0.99 * rest <= step_limits(model)[0] <= rest * (1.0 + 1e-4)  # to which the eigenvalue of the small one is found
    assert step_limits(model)[1] == motion < 0.99 * rest
