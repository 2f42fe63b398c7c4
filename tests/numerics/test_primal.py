"""Multipliers of constraint rows by way of positions: the matrix over vertices, and solutions against dense ones."""

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.matrices import block_matrix
from support.scenes import scene
from warpcloth.kernels import primal as kernels
from warpcloth.numerics.constraints import Constraints
from warpcloth.numerics.primal import PrimalSolver
from warpcloth.solvers import constrained_dynamics

H = 1.0 / 60.0


def linearised(terms, device, copies=2, **given):
    """Rows of a crumpled net with a pin, of unlike copies, at λ for which springs stiffen the masses; and the solver."""
    rng, mesh = np.random.default_rng(3), wc.Mesh.grid(4, 4, pattern="alternating")
    declared = wc.Scene(mesh, masses=rng.uniform(0.5, 1.5, 16), terms=terms, pins=[0], **given)
    model = declared.build(device=device, dtype="float64", copies=copies)
    constraints = Constraints(model, H, True)
    constraints.multipliers.assign(-rng.uniform(0.0, 0.01, constraints.count))
    x = model.positions.numpy() + 0.05 * rng.normal(size=(model.count, 3))
    constraints.launch_linearise(model.array(x, model.vec3), model.vectors())
    return constraints, PrimalSolver(constraints, 1000)


def solved(constraints, solver, b, tolerance):
    """x of all copies in rows, and for each the relative residual in the norm of its diagonal."""
    model, x = constraints.model, wp.zeros(constraints.count, dtype=wp.float64, device=constraints.model.device)
    solver.tolerance.fill_(tolerance)
    solver.solve(model.array(b, wp.float64), x, wp.ones(model.copies, dtype=wp.int32, device=model.device))
    found, left = x.numpy().reshape(model.copies, -1), []
    for A, side, own in zip(constraints.matrices(), b.reshape(found.shape), found, strict=True):
        r, D = side - A @ own, np.where(A.diagonal() > 0.0, 1.0 / A.diagonal(), 0.0)
        left.append(np.sqrt((D * r * r).sum() / (D * side * side).sum()))
    return found, np.array(left)


SOFT = {
    "scalar": [wc.Spring(pairs=("structural", "shear"), stiffness=500.0), wc.DihedralBending(stiffness=1e-2)],
    "projected": [wc.CorotatedMembrane(stiffness=500.0), wc.Attachment(vertices=[5, 9], stiffness=30.0)],
}


@pytest.mark.slow
@pytest.mark.parametrize("terms", SOFT.values(), ids=SOFT)
@pytest.mark.parametrize("locked", [False, True])
def test_both_the_matrix_and_the_solution(terms, locked, device):
    """M + JᵀDJ over free coordinates by J on the host; x to a tolerance that one pass does not reach."""
    free_axes = np.ones((16, 3), dtype=bool)
    free_axes[[5, 6, 7], [0, 1, 2]] = False
    constraints, solver = linearised(terms, device, free_axes=free_axes if locked else None)
    b = np.random.default_rng(0).normal(size=constraints.count)
    found, left = solved(constraints, solver, b, 1e-11)
    assert (left < 1.1e-11).all() and solver._passes.count.numpy()[0] > 1 and not solver._passes.finish.numpy()[0]
    for A, side, own in zip(constraints.matrices(), b.reshape(found.shape), found, strict=True):
        exact = np.linalg.solve(A.toarray(), side)
        # The smallest eigenvalue of the scaled matrix is that of α̃ times D, above 1e-4 here.
        assert np.abs(own - exact).max() < 1e-6 * np.abs(exact).max()
    model, D = constraints.model, np.zeros(constraints.count)
    weights = constraints.inverse.numpy() > 0.0
    D[weights] = 1.0 / constraints.compliance.numpy()[weights]
    values, rows, columns = (np.concatenate(each) for each in zip(*(part.entries() for part in constraints.parts), strict=True))
    J = np.zeros((constraints.count, 3 * model.count))
    np.add.at(J, (rows, columns), values)
    free = model.coordinate_mobility() > 0.0
    expected = J.T @ (D[:, None] * J) + np.diag(np.repeat(model.mass.numpy(), 3))
    whole, n = block_matrix(solver._matrix), 3 * model.per_copy
    assert np.abs((whole - expected)[np.ix_(free, free)]).max() < 1e-12 * np.abs(expected).max()
    assert not whole[np.ix_(free, ~free)].any() and whole[:n, :n].any()


def test_hard_rows_that_are_redundant(device):
    """Springs along all edges and diagonals, doubled: b in the range of J takes passes, any other b rows as well."""
    double = [wc.Spring(pairs=("structural", "shear"), stiffness=np.inf, name=name) for name in ("one", "two")]
    constraints, solver = linearised(double, device, copies=1)
    (A,), rng = constraints.matrices(), np.random.default_rng(1)
    possible = (A @ (A @ rng.normal(size=constraints.count))) / A.diagonal().max()
    _, left = solved(constraints, solver, possible, 1e-6)
    assert left[0] < 1e-6 and solver._passes.softened.numpy()[0] == 1 and not solver._passes.finish.numpy()[0]
    _, left = solved(constraints, solver, possible + 1e-3 * np.abs(possible).max() * rng.normal(size=constraints.count), 1e-6)
    assert left[0] < 1e-5 and solver._passes.finish.numpy()[0] == 1
    assert solver._passes.count.numpy()[0] < kernels.PASSES


def test_steps_of_large_meshes_end_where_those_of_rows_do(device, monkeypatch):
    """Two frames of ``hanging`` with 15² vertices; a run by conjugate gradients over rows ends there too."""
    declared, found = scene("hanging", n=15), []
    for least in (constrained_dynamics.MIN_VERTICES, 10**9):
        monkeypatch.setattr(constrained_dynamics, "MIN_VERTICES", least)
        stepper = wc.ConstrainedDynamics(substeps=2, tolerance=1e-9, iterations=100).bind(
            declared.build(device=device, dtype="float64")
        )
        assert isinstance(stepper._linear, PrimalSolver) == (least < 10**9)
        for _ in range(2):
            stepper.frame()
        found.append(stepper.state.x.numpy())
    assert np.abs(found[0] - found[1]).max() < 1e-9 and np.abs(found[0] - declared.positions).max() > 1e-3
