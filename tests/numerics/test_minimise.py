"""The descent that Newton's method and equilibrium share: where it ends for its precision, and which steps it takes."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.optimize import brentq

import warpcloth as wc
from support.layers import layers
from support.steps import swinging
from warpcloth.core import sums
from warpcloth.core.status import Result
from warpcloth.kernels import minimise as kernels
from warpcloth.numerics.minimise import Minimiser

EPS = float(np.finfo(np.float32).eps)
LENGTH = 0.25


def sagging(stiffness, apart):
    """A crumpled sheet, which descends slowly, beside a spring at rest and one between pins, too long by ``apart`` [m]."""
    # The first of these has no force but what its length is rounded by, the other one has a large energy that stays. The
    # corners of the sheet are pinned, for where inertia alone resists it would descend for ever.
    grid = wc.Mesh.grid(5, 5, size=4 * LENGTH)
    corner = LENGTH * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    points = np.concatenate([grid.points, np.add(corner, [3.0, 0.0, 0.0]), np.add(corner, [6.0, 0.0, 0.0])])
    mesh, start = wc.Mesh(points, np.concatenate([grid.triangles, [[25, 26, 27], [28, 29, 30]]])), points.copy()
    start[:25, 1] = 1e-3 * np.random.default_rng(0).normal(size=25)
    start[28, 0] -= apart
    terms = [wc.QuadraticBending(stiffness=1e-3), wc.Spring(pairs=[[25, 26], [28, 29]], stiffness=[stiffness, 1e4])]
    return wc.Scene(mesh, masses=np.full(31, 0.01), positions=start, terms=terms, pins=[0, 4, 20, 24, 28, 29, 30])


def descent(scene, device, iterations=3000, dtype="float32"):
    """By one iteration of conjugate gradients a time, from the positions of a scene, with hardly any inertia."""
    model = scene.build(device=device, dtype=dtype)
    minimiser = Minimiser(model, model.positions, "raw", "cg", s=1e-6, linear_iterations=1)
    return minimiser, minimiser.minimise(1e-30, iterations, np.ones(1))[0]


def energies(scene, corrections, device):
    """The energies of a scene in float64 at its positions + d, for several d (N, 3) [m]."""
    exact, _ = descent(scene, device, 1, "float64")
    found = []
    for d in corrections:
        exact.correction.assign(d)
        exact.search.launch_again()
        found.append(exact.search.energy.numpy()[0])
    return np.array(found)


def test_a_descent_ends_where_it_gains_what_rounding_loses(device):
    """What rounding d loses is measured in float64, by adding roundings of ε|d| to the d of the end and subtracting them."""
    # The mean of both has no part of first order. That part is as large, because the end is not quite the minimum. Roundings
    # are even in ±½ε, and have squares of ε²/12; the spacing of numbers in float32 is ½ε|d| to ε|d|. The estimate adds up worst
    # cases of ε over the N = 13 blocks of a row of bending, multiples of I, by their Frobenius norms: √3·12·N as much, of which
    # the descent takes a tenth.
    scene, random = sagging(1e4, 0.0), np.random.default_rng(0)
    minimiser, result = descent(scene, device)
    assert result is Result.ROUNDED
    before, _ = descent(scene, device, minimiser.iterations - 1)
    last, end = (each.correction.numpy().astype(np.float64) for each in (before, minimiser))
    roundings = EPS * random.uniform(-0.5, 0.5, (20, *end.shape)) * np.abs(end)
    found = energies(scene, [end, last, *(end + roundings), *(end - roundings)], device)
    gain, loss = found[1] - found[0], found[2:].mean() - found[0]
    assert loss < gain < 0.1 * np.sqrt(3.0) * 12.0 * 13.0 * loss


def test_a_descent_goes_on_where_a_large_energy_hides_its_gains(device):
    """Until double precision hides them, 4ε of an energy of 5 kJ, though the positions are in float32."""
    minimiser, result = descent(sagging(10.0, 1.0), device)
    last = minimiser.iterations
    assert result is Result.ROUNDED
    ends = [descent(sagging(10.0, 1.0), device, n)[0].correction.numpy() for n in (last - 8, last - 7, last - 1, last)]
    # Without the spring that has this energy, gains are known. Those of neighbouring iterations differ by up to a half.
    gains = -np.diff(energies(sagging(10.0, 0.0), ends, device))[::2]
    limit = 4.0 * np.finfo(np.float64).eps * 5e3
    assert gains[1] < 1.5 * limit and gains[0] > limit


def test_a_step_that_raises_the_energy_is_shortened(device):
    """Where the slope falls to 0.84 of it, which would do if rounding hid the rise of 1e-5; energies are known to 1e-16."""
    # A spring from a pin 1 m beside the line of the steps has two wells, which an attachment makes unequal.

    def energy(t):
        return 0.5 * (np.hypot(1.0, t) - 1.4) ** 2 + 0.01 * (t + 3.0) ** 2

    start = -2.2
    end = brentq(lambda t: energy(t) - (1.0 + 1e-5) * energy(start), 1.0, 3.0)
    mesh = wc.Mesh(np.array([[0.0, 1.0, 0.0], [start, 0.0, 0.0]]), edges=[[0, 1]])
    hold = wc.Attachment(vertices=[1], targets=[[-3.0, 0.0, 0.0]], stiffness=0.02)
    scene = wc.Scene(mesh, masses=[1.0, 1.0], terms=[wc.Spring(stiffness=1.0, rest_lengths=1.4), hold], pins=[0])
    model = replace(scene, gravity=(0.0, 0.0, 0.0)).build(device=device)
    minimiser = Minimiser(model, model.positions, "raw", "cg", s=0.0)
    minimiser.clear()
    minimiser.active.fill_(1)
    minimiser.search.direction.assign([[0.0, 0.0, 0.0], [end - start, 0.0, 0.0]])
    minimiser.search.launch(minimiser.active)
    step = minimiser.search.step.numpy()[0]
    assert 0.0 < step < 1.0 and energy(start + step * (end - start)) < energy(start)
    np.testing.assert_allclose(minimiser.search.energy.numpy()[0], energy(start + step * (end - start)), rtol=4.0 * EPS)


GRID = wc.Mesh.grid(5, 5)
# Terms, and a bound of the error of a step over ε|x|. Steps with rigid clusters converge slowly, and end a little early.
STIFF = {
    "springs": ([wc.Spring(stiffness=1e7)], 1.2),
    "damped springs": ([wc.Spring(stiffness=1e6, damping=1e3)], 1.2),
    "membrane": ([wc.OrthotropicMembrane(stiffness=1e6)], 1.2),
    "hinges": ([wc.Spring(stiffness=1e3), wc.DihedralBending(stiffness=1e5)], 1.2),
    "plate": ([wc.Spring(stiffness=1e3), wc.PlateBending(stiffness=1e4)], 1.2),
    "shell": ([wc.Spring(stiffness=1e3), wc.ShellBending(stiffness=1e5)], 1.2),
    "rigid cluster": ([wc.Spring(stiffness=1e3), wc.RigidCluster(vertices=[12, 13, 17, 18], stiffness=1e8)], 4.0),
}


@pytest.mark.parametrize("name", STIFF)
def test_steps_of_stiff_cloth_are_exact_to_the_rounding_of_positions(name, device):
    """Steps in float32, each against a converged one in float64 from the same state."""
    # x̃ and x̃ + d are each rounded by up to ½ε|x|; a fifth of their sum is for roundings of d, of the mass and of the rest
    # state.
    terms, bound = STIFF[name]
    scene = wc.Scene(GRID, density=0.15, terms=terms, pins="z == 0")
    found = wc.Newton(substeps=4).bind(scene.build(device=device))
    exact = wc.Newton(substeps=4, tolerance=1e-8, linear="factorised").bind(scene.build(device=device, dtype="float64"))
    for _ in range(24):
        for ours, theirs in zip(exact.state.arrays.values(), found.state.arrays.values(), strict=True):
            ours.assign(theirs.numpy())
        found.step()
        exact.step()
        x = exact.state.x.numpy()
        assert np.abs(found.state.x.numpy() - x).max() <= bound * EPS * np.abs(x).max()


@pytest.mark.parametrize("apart", [1e-4, 1e-3])
def test_a_quadratic_energy_takes_one_whole_step(apart, device):
    """Of copies pulled to two sides, whose energy k(1 + s²) has no digits for s²: its rounding may not halve the step."""
    copies, random, hold = 64, np.random.default_rng(1), {"vertices": [0], "stiffness": 100.0}
    terms = [wc.Attachment(targets=[[side, 0.0, 0.0]], name=f"side {side}", **hold) for side in (1.0, -1.0)]
    mesh = wc.Mesh(np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), edges=[[0, 1]])
    scene = wc.Scene(mesh, masses=[1.0, 1.0], terms=terms, pins=[1])
    start = np.repeat(mesh.points[None], copies, axis=0)
    start[:, 0] = apart * random.uniform(-1.0, 1.0, (copies, 3))
    model = scene.build(device=device, copies=copies, vary={"positions": start})
    minimiser = Minimiser(model, model.positions, "raw", "cg", s=0.0)
    minimiser.minimise(1e-30, 1, np.ones(copies))
    assert (minimiser.search.step.numpy() == 1.0).all()
    found = (model.positions.numpy() + minimiser.correction.numpy()).reshape(copies, 2, 3)[:, 0]
    # Each of two forces of 100 N is rounded by ε of it.
    assert np.abs(found).max() < 2.0 * EPS


@pytest.mark.parametrize("method", ["cg", "factorised"])
def test_each_copy_ends_by_itself(method, device):
    """Crumpled sheets of unlike stiffness beside one in balance and one that is not finite, to the bits of each alone."""
    # The raw Hessian of the crumpled ones has negative curvatures, and they take more iterations than the loop on the device
    # does before the host looks.
    grid = wc.Mesh.grid(5, 5, size=4 * LENGTH)
    crumpled = 0.3 * grid.points + 0.05 * np.random.default_rng(0).normal(size=grid.points.shape)
    start = np.stack([crumpled, grid.points, crumpled, crumpled])
    terms = [wc.Spring(pairs=("structural", "shear"), stiffness=1e3)]
    scene = wc.Scene(grid, density=0.1, terms=terms, pins=[0], gravity=(0.0, 0.0, 0.0))

    def descend(copies, iterations):
        vary = {"positions": start[copies], "Spring.stiffness": np.array([1e2, 1e2, 1e3, 1e2])[copies]}
        model = scene.build(device=device, dtype="float64", copies=len(copies), vary=vary)
        base = model.positions.numpy().reshape(len(copies), -1, 3)
        base[[copy == 3 for copy in copies], 7] = np.nan
        minimiser = Minimiser(model, model.array(base.reshape(-1, 3), model.vec3), "adaptive", method, s=1e3)
        results = minimiser.minimise(1e-8, iterations, np.full(len(copies), 9.81))
        return results, minimiser.residual, minimiser.iterations, minimiser.correction.numpy().reshape(base.shape)

    for iterations, crumpled_end in ((300, Result.CONVERGED), (2, Result.ITERATIONS_USED_UP)):
        results, residual, most, d = descend([0, 1, 2, 3], iterations)
        assert results == [crumpled_end, Result.CONVERGED, crumpled_end, Result.DIVERGED]
        alone = [descend([copy], iterations) for copy in range(4)]
        for copy, (result, own_residual, _, own_d) in enumerate(alone):
            assert result[0] is results[copy]
            np.testing.assert_array_equal(own_residual[0], residual[copy])
            np.testing.assert_array_equal(own_d[0], d[copy])
        counts = [each[2] for each in alone]
        assert counts[1] == counts[3] == 0 and most == max(counts) and (most > 8 or iterations == 2)


def test_steps_start_from_the_last_correction(device):
    """To the minimum of a start from x̃, in fewer iterations; a guess that raises φ changes no bit."""
    declared = swinging(8)
    model = declared.build(device=device, dtype="float64", copies=2)
    warm, cold = (wc.Newton(substeps=4, tolerance=1e-10).bind(model) for _ in range(2))
    iterations = np.zeros(2, dtype=int)
    for _ in range(12):
        cold.state.assign(warm.state)
        cold.correction.zero_()
        for k, stepper in enumerate((warm, cold)):
            stepper.step()
            iterations[k] += stepper.iterations
        assert np.abs(warm.state.x.numpy() - cold.state.x.numpy()).max() < 1e-10
    assert 0 < iterations[0] < 0.9 * iterations[1], iterations
    before, ends = warm.state.copy(), []
    for size in (0.0, 1.0):  # in the second copy
        warm.state.assign(before)
        warm.correction.assign(size * (np.arange(128)[:, None] == 74) * np.ones(3))
        warm.step()
        ends.append(warm.state.x.numpy())
    np.testing.assert_array_equal(*ends)


def test_a_guess_is_ruled_out_without_its_pairs_only_if_it_raises_the_energy(device):
    """Two sheets, a gap of half the contact distance apart. A guess that is where d is lowers nothing either."""
    scene = layers(gap=0.5 * 5e-3)
    stepper = wc.Newton(substeps=1).bind(scene.build(device=device, dtype="float64"))
    search, model = stepper.minimiser.search, stepper.model
    search.launch_start()
    one, hopeful, some = model.scalars(wp.int32), model.scalars(wp.int32), wp.zeros(1, dtype=wp.int32, device=device)
    one.fill_(1)
    found, rng = [], np.random.default_rng(0)
    apart = np.where(np.arange(72)[:, None] < 36, -1.0, 1.0) * [0.0, 1.0, 0.0]
    for p in (0.0 * apart, 1e-4 * apart, -1e-5 * apart, -1e-3 * apart, 1e-2 * rng.normal(size=apart.shape)):
        search.direction.assign(p)
        search.launch_bound(one, hopeful, some)
        assert hopeful.numpy() == some.numpy()
        search.launch_guess(one)
        found.append((int(hopeful.numpy()[0]), int(search.state.moved.numpy()[0])))
        search.launch_start()
    assert found == [(0, 0), (1, 1), (1, 0), (1, 0), (0, 0)]


@pytest.mark.slow
def test_sums_are_shared_by_blocks(device, monkeypatch):
    """Several blocks of each copy end where one block does, but for rounding, with rows of a Hessian and of constraints."""
    solvers = wc.Newton(substeps=1, tolerance=1e-10), wc.ConstrainedDynamics(substeps=1, linear="cg", tolerance=1e-10)
    model = swinging(17).build(device=device, dtype="float64", copies=2, vary={"Spring.stiffness": np.array([1e3, 3e3])})
    ends, found = [], []
    for most, block_of_cpu in (1, 0), (7, 1):
        monkeypatch.setattr(sums, "BLOCKS", {"cuda": 256, "cpu": block_of_cpu})
        monkeypatch.setattr(sums, "MAX_BLOCKS", most)
        for solver in solvers:
            stepper = solver.bind(model)
            stepper.frame()
            ends.append(stepper.state.x.numpy())
            if isinstance(solver, wc.Newton):
                stepper.correction.fill_(1e-3)
                stepper.minimiser.search.launch_again()
                state = stepper.minimiser.search.state
                found.append([array.numpy() for array in (state.energy, state.square, state.acceleration)])
    np.testing.assert_allclose(*found, rtol=1e-9)
    assert np.abs(ends[0] - ends[2]).max() < 1e-12 and np.abs(ends[1] - ends[3]).max() < 1e-12


def test_the_negative_part_is_reduced_as_far_as_needed_and_restored_by_quarters(device):
    """The factors of the matrices of four iterations, in copies whose matrix is definite with ½, all, and none of that part."""

    def scalars(*values, dtype=wp.float64):
        return wp.array(values, dtype=dtype, device=device)

    progress, limits = kernels.DescentState(), kernels.Limits()
    for name in ("active", "iterations"):
        setattr(progress, name, scalars(*[int(name == "active")] * 3, dtype=wp.int32))
    progress.residual, progress.previous = scalars(1.0, 1.0, 1.0), scalars(0.0, 0.0, 0.0)
    progress.proceed, progress.more, unsolved, wanted, outdated = (wp.zeros(3, dtype=wp.int32, device=device) for _ in range(5))
    limits.tolerance, policy, tolerance = scalars(1e-3), scalars(0.0, 0.0, 0.0), scalars(0.0, 0.0, 0.0)
    definite, found = np.array([0.5, 1.0, 0.0]), [[], [], []]
    for iteration in range(4):
        progress.iterations.fill_(iteration)
        outdated.zero_()
        given = [1, limits, progress, policy, tolerance, wanted, unsolved]
        wp.launch(kernels.begin_newton(), 3, inputs=given, device=device)
        while unsolved.numpy()[0]:
            for copy in np.flatnonzero(wanted.numpy()):
                found[copy].append(policy.numpy()[copy])
            negative = scalars(*(policy.numpy() > definite).astype(int).tolist(), dtype=wp.int32)
            unsolved.zero_()
            given = [negative, policy, outdated, wanted, unsolved]
            wp.launch(kernels.find_indefinite(), 3, inputs=given, device=device)
        assert outdated.numpy().tolist() == [1, 0, 1]
    assert found[0] == [1.0] + 4 * [0.75, 0.5] and found[1] == [1.0] * 4
    assert found[2] == [1.0, 0.75, 0.5] + 4 * [0.25, 0.0]
