"""Multigrid as a preconditioner: its levels, its cycle against matrices on the host, and what Newton's method gains by it."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import warp as wp
from scipy.linalg import block_diag

import warpcloth as wc
from support.continuum import flat, hill, jittered
from support.matrices import block_matrix
from support.rows import table
from support.scenes import scene
from support.steps import after_frames
from warpcloth.core.hessian import Hessian
from warpcloth.kernels.linear import turn_and_multiply
from warpcloth.kernels.multigrid import OMEGA
from warpcloth.kernels.term import HessianPolicy
from warpcloth.numerics.additive_multigrid import AdditiveMultigrid, multigrid_of
from warpcloth.numerics.interpolation import interpolations, neighbours
from warpcloth.numerics.linear import ConjugateGradients
from warpcloth.numerics.multigrid import COARSEST
from warpcloth.numerics.preconditioner_choice import PreconditionerChoice
from warpcloth.numerics.v_cycle import VCycle

FAN = wc.Mesh([[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, -1, 0], [0.5, 0, 1]], [[0, 1, 2], [0, 1, 3], [0, 1, 4]])
MESHES = {
    "grid": wc.Mesh.grid(12, 9, size=1.0, pattern="alternating"),
    "jittered": flat(12),
    "curved": jittered(12, lift=hill),
    "chain": wc.Mesh.chain(60),
    "pieces": wc.Mesh.join({"one": wc.Mesh.grid(6, 6, size=1.0), "other": flat(7)}),
    "three triangles on an edge": FAN,
}


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)
def test_levels_interpolate_affine_functions(mesh):
    """Weights sum to 1, kept vertices keep values, and flat meshes interpolate positions but for the added moments, 1e-4."""
    # A vertex of a curved mesh lies off the plane of its parents by about κL²/2.
    free = np.ones(len(mesh.points), dtype=bool)
    free[3] = False
    found = interpolations(mesh.points, neighbours(mesh), free, 4)
    assert len(found) >= (2 if len(mesh.points) > 5 else 0)
    at = mesh.points
    for k, P in enumerate(found):
        moving = free if k == 0 else np.ones(P.shape[0], dtype=bool)
        np.testing.assert_allclose(P.sum(axis=1), moving.astype(float), atol=1e-12)
        kept = np.flatnonzero((np.diff(P.indptr) == 1) & moving)
        owners = P.indices[P.indptr[kept]]
        _, first = np.unique(owners, return_index=True)
        assert len(first) == P.shape[1]  # each coarse vertex is a fine one
        coarse = np.zeros((P.shape[1], 3))
        for vertex, owner in zip(kept, owners, strict=True):
            coarse[owner] = at[vertex]
        if k == 0:
            size = np.linalg.norm(np.ptp(mesh.points, axis=0))
            error = np.linalg.norm(P @ coarse - at, axis=1)[moving].max() / size
            assert error < (0.05 if mesh is MESHES["curved"] else 2e-3)
        at = coarse


def compressed(device, copies=2):
    """A Hessian of springs in compression, of unlike copies; it is indefinite."""
    mesh, terms = flat(12), [wc.Spring(stiffness=1e3), wc.QuadraticBending(stiffness=1e-4)]
    positions = 0.9 * mesh.points + 0.01 * np.random.default_rng(0).normal(size=mesh.points.shape)
    declared = wc.Scene(mesh, density=0.1, terms=terms, positions=positions, pins=[0, 5])
    model = declared.build(device=device, dtype="float64", copies=copies, vary={"Spring.stiffness": np.logspace(2, 4, copies)})
    hessian = Hessian(model, HessianPolicy.RAW)
    hessian.assemble(model.positions, 1e3)
    return hessian


def applied(multigrid, count, copies):
    """The matrix of the cycle in each copy, (B, 3n, 3n)."""
    model = multigrid.model
    active, r, z = wp.ones(copies, dtype=wp.int32, device=model.device), model.vectors(), model.vectors()
    sweeps = multigrid.sweep.numpy().reshape(copies, count, 3, 3)
    found = np.zeros((copies, 3 * count, 3 * count))
    for k in range(3 * count):
        right = np.zeros((copies, 3 * count))
        right[:, k] = 1.0
        r.assign(right.reshape(-1, 3))
        z.assign(np.einsum("bnij,bnj->bni", sweeps, right.reshape(copies, count, 3)).reshape(-1, 3))
        multigrid.refine(r, z, active)
        found[:, :, k] = z.numpy().reshape(copies, -1)
    return found


def transfers_of(hessian):
    """P of each level, over coordinates."""
    model = hessian.model
    free = model.inverse_mass.numpy()[: hessian.per_copy] > 0.0
    found = interpolations(model.rest_points, neighbours(model.scene.mesh), free, COARSEST)
    return [np.kron(P.toarray(), np.eye(3)) for P in found]


def sweeps(level, n, copy):
    return block_diag(*level.sweep.numpy()[copy * n : (copy + 1) * n])


def v_cycle(multigrid, copy, A, M, transfers):
    """M but for what is no x ← x + S(b − Ax), coarse correction P(PᵀAP)⁻¹Pᵀ, sweep; and its relative error."""
    # The coarse part C of M = 2S − SAS + (I − SA) P C Pᵀ (I − AS) is the cycle of PᵀAP.
    S, P = sweeps(multigrid, len(A) // 3, copy), transfers[0]
    E, smooth = np.eye(len(A)) - S @ A, 2.0 * S - S @ A @ S
    C = np.linalg.pinv(E @ P) @ (M - smooth) @ np.linalg.pinv(E @ P).T
    return smooth + E @ P @ C @ P.T @ E.T, 1e-6 * np.abs(M - smooth).max()


def additive(multigrid, copy, A, M, transfers):
    """S + P̄ M_c P̄ᵀ with P̄ = P − S A P, and the inverse on the last level; and its error."""
    expected, to_finest, last = np.zeros_like(A), np.eye(len(A)), multigrid.levels[-1]
    for level, P in zip(multigrid.levels, transfers, strict=False):
        S = sweeps(level, level.n, copy)
        expected += to_finest @ S @ to_finest.T
        A, to_finest = P.T @ A @ P, to_finest @ (P - S @ A @ P)
    inverse = last.values.numpy().reshape(2, last.n, last.n, 3, 3)[copy].swapaxes(1, 2).reshape(3 * last.n, -1)
    return expected + to_finest @ inverse @ to_finest.T, 1e-10 * np.abs(M).max()


@pytest.mark.parametrize(("kind", "by_levels"), [(VCycle, v_cycle), (AdditiveMultigrid, additive)])
def test_a_cycle_is_symmetric_positive_definite_and_that_of_its_levels(kind, by_levels, device):
    """By dense matrices; A has negative eigenvalues."""
    hessian = compressed(device)
    multigrid, n, transfers = kind(hessian), hessian.per_copy, transfers_of(hessian)
    multigrid.update()
    cycles = applied(multigrid, n, 2)
    assert multigrid.sizes == [n, *(P.shape[1] // 3 for P in transfers)] and len(transfers) > 1
    for copy, (A, M) in enumerate(zip(hessian.matrices(), cycles, strict=True)):
        A, root = A.toarray(), np.linalg.cholesky(sweeps(multigrid, n, copy))
        assert np.linalg.eigvalsh(A)[0] < 0.0
        # No eigenvalue of S A is above ω.
        assert np.linalg.eigvalsh(root.T @ A @ root)[-1] <= OMEGA * (1.0 + 1e-9)
        np.testing.assert_allclose(M, M.T, atol=1e-9 * np.abs(M).max())
        assert np.linalg.eigvalsh(0.5 * (M + M.T))[0] > 0.0
        expected, error = by_levels(multigrid, copy, A, M, transfers)
        np.testing.assert_allclose(M, expected, atol=error)


def test_coarse_matrices_are_products_with_the_interpolation(device):
    """PᵀAP of each copy, and on the coarsest level its inverse, in float64."""
    hessian = compressed(device)
    multigrid = multigrid_of(hessian)
    multigrid.update()
    for copy, A in enumerate(hessian.matrices()):
        A = A.toarray()
        for k, P in enumerate(transfers_of(hessian)):
            A, level = P.T @ A @ P, multigrid.levels[k + 1]
            n, own = level.n, slice(3 * copy * level.n, 3 * (copy + 1) * level.n)
            dense = block_matrix(level)[own, own]
            if level is multigrid.levels[-1] and np.linalg.eigvalsh(A)[0] > 0.0:
                np.testing.assert_allclose(dense @ A, np.eye(3 * n), atol=1e-8)
            elif level is not multigrid.levels[-1]:
                np.testing.assert_allclose(dense, A, atol=1e-10 * np.abs(A).max())


def set_choice(choice, blocks, gained, wait=1 << 30):
    """Sets whether the next solve uses diagonal blocks, what these and multigrid gained for a cost of 1, and the next trial."""
    present, past = choice.kept.values()
    present.assign([[blocks, 0, 0, wait]])
    past.assign([[*gained, 1.0, 1.0]])


def weighed(n, stiffness, device, make):
    """Conjugate gradients after a solve to 1e-3 for the weight, at the start of ``hanging``; ``make`` makes them."""
    declared = scene("hanging", n=n, stiffness=stiffness)
    bent = declared.mesh.points + np.outer(np.sin(np.pi * declared.mesh.points[:, 0]), [0.0, 0.1, 0.0])
    model = replace(declared, positions=bent).build(device=device, dtype="float64")
    hessian = Hessian(model, HessianPolicy.CLAMP)
    hessian.assemble(model.positions, 240.0**2)
    solver = make(hessian)
    solver.tolerance.fill_(1e-3)
    b, x = model.vectors(), model.vectors()
    b.assign(model.mass.numpy()[:, None] * [0.0, -9.81, 0.0] * (model.inverse_mass.numpy() > 0.0)[:, None])
    solver.solve(b, x, wp.ones(1, dtype=wp.int32, device=device))
    return solver


def chosen(hessian):
    """Conjugate gradients that choose their preconditioner."""
    multigrid = multigrid_of(hessian)
    return ConjugateGradients(hessian, 10_000, multigrid, PreconditionerChoice(multigrid, 10_000))


def iterations(n, stiffness, device, used):
    """Of such a solve by multigrid if ``used``, or else with diagonal blocks."""
    make = partial(ConjugateGradients, iterations=10_000)
    solver = weighed(n, stiffness, device, lambda hessian: make(hessian, multigrid=multigrid_of(hessian) if used else None))
    return int(solver.iteration.numpy()[0])


@pytest.mark.parametrize("stiffness, most", [(1e3, 40), (1e5, 120)])
def test_iterations_hardly_depend_on_resolution(device, stiffness, most):
    """With diagonal blocks they grow as the number of vertices per side until inertia limits them."""
    fine = {used: iterations(48, stiffness, device, used) for used in (True, False)}
    coarse = {used: iterations(16, stiffness, device, used) for used in (True, False)}
    assert fine[True] <= most and fine[True] <= 1.5 * coarse[True] + 2
    assert fine[False] >= 1.8 * coarse[False] and fine[True] <= fine[False] / 5


def locked():
    """``hanging`` with a line of vertices that slide along the vertical."""
    declared, axes = scene("hanging", n=15), np.ones((225, 3), dtype=bool)
    axes[105:120, [0, 2]] = False
    return replace(declared, free_axes=axes)


SCENES = {
    "hanging": (scene("hanging", n=16, stiffness=1e4), {}),
    "copies": (scene("hanging", n=15), {"copies": 2, "vary": {"Spring.stiffness": [1e2, 1e5]}}),
    "locked": (locked(), {}),
    "layers in contact": (scene("folded_sheet", n=15, gap=2e-3, distance=1.9e-3), {}),
    "colliders": (scene("drape", n=15), {}),
}


@table("name", ["hanging", "locked", "copies"], SCENES)
def test_the_minimiser_does_not_depend_on_the_preconditioner(device, name):
    """After three frames, to the tolerance of Newton's iteration."""
    declared, build = SCENES[name]
    found = []
    for blocks in (0, 1):
        stepper = wc.Newton(substeps=2, tolerance=1e-9).bind(declared.build(device=device, dtype="float64", **build))
        present, past = stepper.minimiser.kept.values()
        present.assign([[blocks, 0, 0, 1 << 30]] * len(present))
        past.assign([[blocks, 1.0 - blocks, 1.0, 1.0]] * len(past))
        for _ in range(3):
            stepper.frame()
        assert (present.numpy()[:, 0] == blocks).all()
        found.append(stepper.state.x.numpy())
    np.testing.assert_allclose(*found, atol=1e-8)


def test_each_copy_chooses_what_costs_less(device):
    """Soft cloth in short steps needs few iterations with diagonal blocks; stiff cloth needs many. Bits are those of one."""
    declared, stiffness = scene("hanging", n=24), [1.0, 1e5]

    def ends(**build):
        stepper = after_frames(declared, wc.Newton(substeps=8), 2, device=device, dtype="float64", **build)
        first = stepper.state.x.numpy()
        stepper.reset()
        for _ in range(2):
            stepper.frame()
        assert (stepper.state.x.numpy() == first).all()
        blocks = [bool(now[0]) for now in stepper.minimiser.kept["preconditioner"].numpy()]
        return blocks, first.reshape(len(blocks), -1, 3)

    blocks, both = ends(copies=2, vary={"Spring.stiffness": stiffness})
    assert blocks == [True, False]
    for k, one in enumerate(stiffness):
        assert (ends(copies=1, vary={"Spring.stiffness": [one]})[1][0] == both[k]).all()


@pytest.mark.parametrize("blocks, cycles", [(500, 5), (20, 40), (4000, 200)])
def test_trials_cost_little(device, blocks, cycles):
    """Most of the gain of a solve comes early, so that a trial that is cut off looks good; it may not win."""
    solver = chosen(Hessian(scene("hanging", n=3).build(device=device), HessianPolicy.CLAMP))
    solves, cycle = solver._solves, 4
    solver.multigrid.cycle = cycle
    choice = PreconditionerChoice(solver.multigrid, 10_000)
    solves.first.fill_(1.0)
    solves.tolerance.fill_(1e-3)
    wanted = wp.ones(1, dtype=wp.int32, device=device)
    total, count = 0, 300
    for _ in range(count):
        choice.launch_begin(solves, wanted)
        multigrid = bool(choice.by_cycles.numpy()[0])
        needed = cycles if multigrid else blocks
        taken = min(needed, int(solves.most.numpy()[0]))
        solves.iteration.fill_(taken)
        solves.next_rz.fill_(10.0 ** (-3.0 * np.sqrt(taken / needed)))
        total += cycle * (taken + 1) if multigrid else taken + 1
        choice.launch_end(solves, wanted)
    best = min(blocks + 1, cycle * (cycles + 1))
    assert total <= 1.1 * count * best


def test_diagonal_blocks_stop_where_multigrid_costs_less(device):
    """Three decades cost multigrid 30 iterations with diagonal blocks; these may take half as many more, and lose."""

    def make(hessian):
        solver = chosen(hessian)
        set_choice(solver.choice, 1, [1.0, 0.1])
        return solver

    assert iterations(16, 1e5, device, False) > 60
    solver = weighed(16, 1e5, device, make)
    assert int(solver.iteration.numpy()[0]) == 45 and solver.choice.kept["preconditioner"].numpy()[0, 0] == 0


def test_a_negative_curvature_changes_no_choice(device):
    """A solve that it ends early has no rate."""
    hessian = compressed(device, copies=1)
    model = hessian.model
    hessian.assemble(model.positions, 7e5)
    solver = chosen(hessian)
    solver.tolerance.fill_(1e-6)
    b, x = (model.array(np.random.default_rng(k).normal(size=(model.count, 3)), model.vec3) for k in range(2))
    for blocks in (0, 1):
        set_choice(solver.choice, blocks, [1e-3, 1e-3], wait=1)
        before = [array.numpy().tolist() for array in solver.choice.kept.values()]
        solver.solve(b, x, wp.ones(1, dtype=wp.int32, device=device))
        assert solver.negative.numpy()[0] == 1
        assert [array.numpy().tolist() for array in solver.choice.kept.values()] == before


def test_kernels_of_both_devices_build_for_the_cpu():
    """A module has those of all numbers of threads, in a process that uses both devices."""
    kernels = [turn_and_multiply(wp.float64, block) for block in (0, 256)]
    assert kernels[0].module is kernels[1].module
    wp.load_module(kernels[0].module, device="cpu")
