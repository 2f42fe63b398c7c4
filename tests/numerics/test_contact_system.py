"""Systems of a constant matrix and contact: their solutions, whatever solves with that matrix, and the line search."""

import numpy as np
import pytest
import scipy.linalg
import warp as wp

import warpcloth as wc
from warpcloth.core.constant_matrix import constant_matrices
from warpcloth.kernels.search import LineSearch, check_quadratic
from warpcloth.numerics.constant_multigrid import CopyCycles
from warpcloth.numerics.contact_system import TOLERANCE
from warpcloth.numerics.linear import CopyFactors
from warpcloth.scenes import drape
from warpcloth.solvers import projective_dynamics


def on_the_ball(device, copies=2, first=0):
    """A stepper whose cloths lie on a ball, with b = ∇φ in ``gradient`` and A⁻¹ b in ``w``, within a step."""
    vary = {"Spring.stiffness": [30.0, 300.0][first : first + copies]}
    model = drape.scene(n=12).build(device=device, dtype="float64", copies=copies, vary=vary)
    stepper = wc.ProjectiveDynamics(substeps=1).bind(model)
    for _ in range(14):
        stepper.frame()
    stepper.start()
    for _ in range(6):
        stepper.iterate(np.ones(copies, dtype=bool))
    stepper._linear.solve(stepper.gradient, stepper.w)
    return stepper


def solved(stepper, accurate):
    stepper._contact._marks.write(int(accurate))
    stepper._contact._solve()
    return stepper.w.numpy().reshape(stepper.model.copies, -1)


@pytest.mark.parametrize("solver", [CopyFactors, CopyCycles])
def test_solutions_have_the_residual_of_the_tolerance(solver, device, monkeypatch):
    """(A + D) w = b to 1e-3 in the norm of A⁻¹ if accurate; rough solves lower the quadratic model by half of the most."""
    monkeypatch.setattr(projective_dynamics, "solve_copies", solver)
    stepper = on_the_ball(device)
    model, start = stepper.model, wp.clone(stepper.w)
    terms = [elements for elements in model.terms if elements.collider is None]
    right, counts = stepper.gradient.numpy().reshape(model.copies, -1), []
    for accurate in (True, False):
        wp.copy(stepper.w, start)
        found = solved(stepper, accurate)
        counts.append(stepper._contact.iteration.numpy().copy())
        for A, D, b, w in zip(
            constant_matrices(model.with_terms(terms), stepper.inertia.s),
            stepper._contact.matrix.matrices(),
            right,
            found,
            strict=True,
        ):
            A, D = np.kron(A.toarray(), np.eye(3)), D.toarray()
            rest = b - A @ w - D @ w
            if accurate:
                assert rest @ np.linalg.solve(A, rest) < 1.001 * TOLERANCE**2 * b @ np.linalg.solve(A, b)
            best = b @ scipy.linalg.solve(A + D, b)
            assert 2.0 * b @ w - w @ (A + D) @ w > (0.999 if accurate else 0.5) * best
    assert (counts[0] > 1).all() and (counts[1] < counts[0]).all()


def test_copies_are_solved_as_alone(device):
    together = solved(on_the_ball(device), False)
    for copy, found in enumerate(together):
        assert np.array_equal(solved(on_the_ball(device, 1, copy), False)[0], found)


@pytest.mark.parametrize(("c", "trials"), [(0.5, 1), (1.0, 2), (8.0, 5), (-1.0, 1)])
def test_steps_are_halved_until_the_objective_falls(c, trials, device):
    """φ(t) = t²/4 − t + U with U = c t² falls up to t = 1/(c + 1/4); along a rise the step is kept."""
    state, one = LineSearch(), {"device": device, "dtype": wp.float64}
    slope = -1.0 if c > 0.0 else 1.0
    for name, value in {"energy": 0.0, "other": 0.0, "slope": slope, "step": 1.0, "trial_slope": 0.0, "square": 2.0}.items():
        setattr(state, name, wp.full(1, value, **one))
    state.searching, state.trials, state.proceed = (wp.full(1, value, dtype=wp.int32, device=device) for value in (1, 0, 1))
    pull, fraction, done = wp.zeros(1, **one), wp.full(1, 0.5, **one), 0
    while state.proceed.numpy()[0]:
        done, step = done + 1, state.step.numpy()[0]
        state.trials.fill_(done)
        state.proceed.zero_()
        state.other.fill_(c * step**2)
        wp.launch(check_quadratic, dim=1, inputs=[pull, fraction, 30], outputs=[state], device=device)
    assert done == trials and state.searching.numpy()[0] == 0
    assert state.step.numpy()[0] == 0.5 ** (trials - 1)
