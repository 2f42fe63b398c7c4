"""Cycles of multigrid with constant matrices: bounds of what they leave, copies, locks, and the minimisers of two solvers."""

import numpy as np
import pytest
import scipy.sparse

import warpcloth as wc
from support.continuum import flat
from support.steps import after_steps, swinging
from warpcloth.core.constant_matrix import constant_matrices
from warpcloth.core.status import Result
from warpcloth.numerics import constant_multigrid
from warpcloth.numerics.constant_multigrid import LEFT, CopyCycles
from warpcloth.numerics.linear import AxisSolves, CopyFactors
from warpcloth.solvers import admm, projective_dynamics

# The pieces have no level of fewer vertices than pieces.
MESHES = {
    "grid": wc.Mesh.grid(9, 8, size=1.0, pattern="alternating"),
    "irregular": flat(9),
    "pieces": wc.Mesh.join({f"piece_{k}": wc.Mesh.grid(2, 2, size=1.0) for k in range(20)}),
}


@pytest.fixture
def small(monkeypatch):
    """Sheets of some vertices have levels too."""
    monkeypatch.setattr(constant_multigrid, "DENSE", 12)


def model_of(mesh, device, stiffness=(1e2, 1e5, 1e2), **more):
    declared = wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=1.0)], pins=[0, 5], **more)
    return declared.build(device=device, dtype="float64", copies=len(stiffness), vary={"Spring.stiffness": list(stiffness)})


def operators(model, solver):
    """B of each copy along each axis, (3, B, n, n), from x = B b of all unit vectors."""
    n, found = model.per_copy, []
    x, b = model.vectors(), np.zeros((model.copies, n, 3))
    for j in range(n):
        b[:] = 0.0
        b[:, j] = 1.0
        solver.solve(model.array(b.reshape(-1, 3), model.vec3), x)
        found.append(x.numpy().reshape(model.copies, n, 3).copy())
    return np.stack(found, axis=2).transpose(3, 0, 1, 2)


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)
def test_cycles_are_a_symmetric_bound_of_the_inverse(mesh, small, device):
    """(1 − ε)A⁻¹ ≤ B ≤ A⁻¹, so B A has eigenvalues from 1 − ε to 1; ε is of power iteration, from below. Pins keep b."""
    # The condition number of A is 1e7, so that rounding is up to 2e-9.
    model = model_of(mesh, device)
    matrices = constant_matrices(model, 100.0)
    solver = CopyCycles(model, matrices)
    assert len(solver.sizes) > 1 and (solver.error <= LEFT).all()
    for B, matrix, error in zip(operators(model, solver)[0], matrices, solver.error, strict=True):
        A = matrix.toarray()
        assert np.abs(B - B.T).max() < 1e-8 * np.abs(B).max()
        half = np.linalg.cholesky(A)
        eigenvalues = np.linalg.eigvalsh(half.T @ B @ half)
        assert 1.0 - 1.3 * error - 1e-8 < eigenvalues[0] and eigenvalues[-1] < 1.0 + 1e-8
        assert (B[[0, 5]] == np.eye(len(A))[[0, 5]]).all()


def test_a_copy_does_not_depend_on_others(small, device):
    """To the bit, though the other copy needs another number of cycles; equal copies share their values."""
    rng, alone = np.random.default_rng(0), []
    b = rng.normal(size=(72, 3))
    stiffness = (1e-3, 1e5, 1e-3)
    together = model_of(MESHES["grid"], device, stiffness)
    for model in (*(model_of(MESHES["grid"], device, (k,)) for k in stiffness), together):
        solver, x = CopyCycles(model, constant_matrices(model, 100.0)), model.vectors()
        solver.solve(model.array(np.tile(b, (model.copies, 1)), model.vec3), x)
        alone.append((solver.cycles, x.numpy()))
    assert alone[0][0] != alone[1][0] and (alone[3][1] == np.concatenate([x for _, x in alone[:3]])).all()
    assert len(solver._matrix.values) == 2


def test_locked_coordinates(small, device):
    """Along each axis over the vertices that are free along it: the error is that of cycles, and locked ones keep b."""
    axes = np.ones((72, 3), dtype=bool)
    axes[10:20, 1] = axes[30, :2] = False
    model = model_of(MESHES["grid"], device, free_axes=axes)
    matrices = constant_matrices(model, 100.0)
    cycles, factors = (AxisSolves(model, matrices, solver) for solver in (CopyCycles, CopyFactors))
    b, x, exact = model.array(np.random.default_rng(0).normal(size=(216, 3)), model.vec3), model.vectors(), model.vectors()
    cycles.solve(b, x)
    factors.solve(b, exact)
    free = (model.coordinate_mobility().reshape(3, 72, 3) > 0.0) * 1.0
    found, expected = (array.numpy().reshape(free.shape) for array in (x, exact))
    assert (found == expected)[free == 0.0].all()
    for copy, matrix in enumerate(matrices):
        for axis in range(3):
            one, other = (array[copy, :, axis] * free[copy, :, axis] for array in (found - expected, expected))
            assert one @ (matrix @ one) < cycles.error[copy] ** 2 * (other @ (matrix @ other))


@pytest.mark.slow
@pytest.mark.parametrize(
    "module, solver",
    [
        (projective_dynamics, wc.ProjectiveDynamics(substeps=1, iterations=2000, tolerance=1e-5)),
        (admm, wc.ADMM(substeps=1, iterations=2000, tolerance=1e-5)),
    ],
    ids=["projective-dynamics", "admm"],
)
def test_iterations_end_where_those_with_factors_do(module, solver, small, device, monkeypatch):
    """In at most 1.2 times as many iterations; S⁻¹ is known to 5 %."""
    monkeypatch.setattr(module, "solve_copies", CopyFactors)
    expected, factorised = after_steps(swinging(8), solver, device)
    monkeypatch.setattr(module, "solve_copies", CopyCycles)
    found, stepper = after_steps(swinging(8), solver, device)
    assert stepper.results == factorised.results == [Result.CONVERGED]
    assert stepper.iterations < 1.2 * factorised.iterations and np.abs(found - expected).max() < 1e-7


@pytest.mark.parametrize("dense", [12, 300])
def test_matrices_that_are_not_positive_are_refused(dense, device, monkeypatch):
    """Also one with a positive diagonal, whose coarser ones are indefinite."""
    monkeypatch.setattr(constant_multigrid, "DENSE", dense)
    model = model_of(MESHES["grid"], device, (1e3,))
    (matrix,) = constant_matrices(model, 100.0)
    for wrong in (-matrix, (matrix - scipy.sparse.diags(0.5 * matrix.diagonal())).tocsr()):
        with pytest.raises(ValueError, match="not positive definite"):
            CopyCycles(model, [wrong])
    matrix.data[3] = np.nan
    with pytest.raises(ValueError, match="1 entries that are not finite"):
        CopyCycles(model, [matrix])
