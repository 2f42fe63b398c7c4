"""Projective dynamics and ADMM: the minimiser they share with Newton, rates, accelerations, residuals, what is refused."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.rows import table
from support.steps import METHODS, after_frames, after_steps, newton_step, objective, swinging, unbalanced
from warpcloth.core.constant_matrix import constant_matrices
from warpcloth.core.hessian import Hessian
from warpcloth.core.status import Result, digits, millimetres
from warpcloth.core.sums import Lanes
from warpcloth.kernels import accelerate
from warpcloth.numerics import linear
from warpcloth.numerics.acceleration import LBFGS, Anderson, Chebyshev
from warpcloth.numerics.linear import CopyFactors
from warpcloth.numerics.local_weights import best_weights
from warpcloth.solvers.projective_dynamics import ACCELERATIONS

EPS = np.finfo(np.float64).eps


STRETCHES = {
    "membrane": lambda: [wc.CorotatedMembrane(stiffness=1e3), wc.QuadraticBending(stiffness=1e-5)],
    "strain limit": lambda: [wc.Spring(stiffness=1e2), wc.StrainLimit(least=0.9, most=1.05, stiffness=1e3)],
    "spring limit": lambda: [wc.Spring(stiffness=1e2), wc.SpringLimit(most=1.05, stiffness=1e3)],
}


@pytest.mark.host
@pytest.mark.parametrize(
    "solver", [wc.ProjectiveDynamics(substeps=1, iterations=3000, tolerance=1e-9), wc.XPBD(substeps=1, iterations=3000)]
)
@table("stretch", list(STRETCHES)[:1], STRETCHES)
def test_membranes_and_limits_meet_at_the_minimiser(stretch, solver, device):
    """Written without these solvers in mind: after three frames of a fall they are where Newton is."""
    mesh = wc.Mesh.grid(6, 6, pattern="alternating")
    declared = wc.Scene(mesh, density=0.1, terms=STRETCHES[stretch](), pins="corners and z == 0", duration=0.05)
    expected = wc.simulate(declared, wc.Newton(substeps=1, tolerance=1e-10), device=device, dtype="float64").points[-1]
    found = wc.simulate(declared, solver, device=device, dtype="float64").points[-1]
    assert np.abs(found - expected).max() < 1e-8


# --- the matrix


def test_matrix_is_the_hessian_of_fixed_projections(device):
    """Of quadratic terms alone M/h² + Σ k A GᵀG is the Hessian of the objective, three times over; pins are the identity."""
    mesh = wc.Mesh.grid(6, 5, pattern="alternating")
    terms = [wc.QuadraticBending(stiffness=0.3), wc.Attachment(vertices=[7, 9], stiffness=[2.0, 5.0])]
    declared = wc.Scene(mesh, density=0.1, terms=terms, pins=[0, 12])
    model = declared.build(device=device, dtype="float64", copies=2, vary={"density": [0.1, 0.4]})
    hessian = Hessian(model)
    hessian.assemble(model.positions, 50.0)
    for matrix, expected in zip(constant_matrices(model, 50.0), hessian.matrices(), strict=True):
        assert np.abs(np.kron(matrix.toarray(), np.eye(3)) - expected.toarray()).max() < 1e-12


def test_equal_copies_share_their_factors(device):
    declared = swinging(8)
    for vary, count in (({}, 1), ({"Spring.stiffness": [1e3, 1e3, 2e3]}, 2)):
        model = declared.build(device=device, copies=3, vary=vary)
        factors = CopyFactors(model, constant_matrices(model, 1.0))
        assert len({id(each) for each in factors.factors}) == count


# --- the minimiser


def objectives(declared, solver, counts, device):
    """After each of some numbers of iterations [J]."""
    solvers = [replace(solver, iterations=count, tolerance=1e-300) for count in counts]
    return np.array([objective(declared, after_steps(declared, each, device)[0], device) for each in solvers])


@pytest.mark.host
def test_the_objective_never_rises(device):
    declared, h, counts = swinging(8), 1 / swinging(8).fps, [1, 2, 3, 5, 10, 20, 50, 100, 200, 500]
    predicted = declared.positions + h * declared.velocities + h**2 * declared.gravity
    predicted[declared.pins.vertices] = declared.positions[declared.pins.vertices]
    plain = objectives(declared, METHODS["none"], counts, device)
    assert (np.diff([objective(declared, predicted, device), *plain]) < 0.0).all()
    for name in ACCELERATIONS[1:]:
        values = objectives(declared, METHODS[name], counts, device)
        assert (values <= plain * (1 + 8 * EPS)).all() and values[-1] < plain[-1]
        assert (np.diff(values) <= 8 * EPS * values[:-1]).all()


def test_the_objective_never_rises_without_the_matrix(device):
    """As its row sums are above it; twice its diagonal, enough for springs, is not where bending has weights of both signs."""
    declared = replace(swinging(8), terms=[wc.QuadraticBending(stiffness=1.0)])
    solver = wc.ProjectiveDynamics(substeps=1, acceleration="none", linear="jacobi")
    assert (np.diff(objectives(declared, solver, (1, 2, 3, 5, 10, 20, 50, 100), device)) < 0.0).all()


def test_a_bad_proposal_is_dropped(device):
    """With coefficients that lead nowhere every step is the plain one, to the bit."""
    declared = swinging(8)
    plain, _ = after_steps(declared, replace(METHODS["none"], iterations=30), device)

    def nonsense(iteration, products, accepted):
        assert iteration == 0 or not accepted.any()
        wrong = np.full((len(products), 1 + 2 * products.shape[2]), [1e3, np.nan][iteration % 2])
        wrong[:, 1:] *= iteration > 0
        return wrong

    stepper = replace(METHODS["anderson"], iterations=30).bind(declared.build(device=device, dtype="float64"))
    stepper._accelerated.method.propose = nonsense
    stepper.step()
    assert np.array_equal(stepper.state.x.numpy(), plain)


def textbook(name, H, A, b, window, rho, count):
    """Iterates of ½dᵀHd − bᵀd from 0 as the papers write them."""
    iterates, omega = [np.zeros(len(b))], 1.0
    for k in range(count):
        d, gradients = iterates[-1], [H @ each - b for each in iterates]
        steps = [each - np.linalg.solve(A, g) for each, g in zip(iterates, gradients, strict=True)]  # G(d)
        first = max(0, k - window)
        if name == "chebyshev":
            omega = 1.0 if k < 10 else 2 / (2 - rho**2) if k == 10 else 4 / (4 - rho**2 * omega)
            new = omega * (steps[-1] - iterates[max(k - 1, 0)]) + iterates[max(k - 1, 0)]
        elif name == "anderson":
            F, root = [G - each for G, each in zip(steps, iterates, strict=True)], np.linalg.cholesky(A).T
            new = steps[-1]
            if k:
                changes = np.stack([F[j + 1] - F[j] for j in range(first, k)], axis=1)
                theta = np.linalg.lstsq(root @ changes, root @ F[-1])[0]
                new = new - np.stack([steps[j + 1] - steps[j] for j in range(first, k)], axis=1) @ theta
        else:
            pairs = [(iterates[j + 1] - iterates[j], gradients[j + 1] - gradients[j]) for j in range(first, k)]
            q, alphas = gradients[-1], []
            for s, y in reversed(pairs):
                alphas.append(s @ q / (s @ y))
                q = q - alphas[-1] * y
            r = np.linalg.solve(A, q)
            for (s, y), alpha in zip(pairs, reversed(alphas), strict=True):
                r = r + s * (alpha - y @ r / (s @ y))
            new = d - r
        iterates.append(new)
    return np.array(iterates)


def iterates(method, H, A, b):
    """Iterates of ½dᵀHd − bᵀd from 0 with the proposals of a method."""
    m = method.window
    s, y, z = np.zeros((3, m, len(b)))
    d, last = np.zeros(len(b)), None
    method.start()
    for k in itertools.count():
        yield d
        gradient = H @ d - b
        w, slot = np.linalg.solve(A, gradient), k % m
        if k:
            y[slot], z[slot] = gradient - last[0], w - last[1]
        last = gradient, w
        products = np.stack([s @ gradient, z @ gradient, s @ y[slot], z @ y[slot]])[None]
        (c,) = method.propose(k, products, np.array([True]))
        new = d - c[0] * w + c[1 : 1 + m] @ s + c[1 + m :] @ z
        s[(k + 1) % m] = new - d
        d = new


@pytest.mark.parametrize("method", [Chebyshev(1, 0.9), Anderson(1, 3, EPS), LBFGS(1, 3, EPS)], ids=ACCELERATIONS[1:])
def test_proposals_are_those_of_the_papers(method, request):
    """Coefficients of a history give the iterates of the textbook, on a quadratic objective below its matrix."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(12, 12))
    H = root @ root.T + np.eye(12)
    A, b = H + np.diag(rng.uniform(1.0, 20.0, size=12)), rng.normal(size=12)
    found = np.array(list(itertools.islice(iterates(method, H, A, b), 15 if isinstance(method, Chebyshev) else 8)))
    expected = textbook(request.node.callspec.id, H, A, b, method.window, 0.9, len(found) - 1)
    assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("method", [Anderson(1, 5, EPS), LBFGS(1, 5, EPS)], ids=ACCELERATIONS[2:])
def test_accelerations_do_not_stall(method):
    """They take at most 1.5 times the bound ½√κ ln(2√κ/ε) of conjugate gradients, here 284; without plain steps 600 to 1800."""
    H, b = np.diag(np.geomspace(1e-3, 1.0, 60)), np.random.default_rng(0).normal(size=60)
    most = int(1.5 * 0.5 * np.sqrt(1e3) * np.log(2e6 * np.sqrt(1e3)))
    left = [np.linalg.norm(H @ d - b) / np.linalg.norm(b) for d in itertools.islice(iterates(method, H, np.eye(60), b), most)]
    assert min(left) < 1e-6


@pytest.mark.parametrize("name", METHODS)
def test_a_step_starts_afresh(name, device):
    """From the same state the same bits, whatever step came before; 7 iterations end within a window of 5."""
    declared = swinging(8)
    first, stepper = after_steps(declared, replace(METHODS[name], iterations=7), device)
    stepper.state.x.assign(declared.positions)
    stepper.state.v.assign(declared.velocities)
    stepper.step()
    assert np.array_equal(stepper.state.x.numpy(), first)


# --- ADMM


def test_residuals_of_admm(device):
    """The forces of y − z and of what z moved by, the largest of any vertex that moves; both end at 0."""
    declared, solver = swinging(8), wc.ADMM(substeps=1, iterations=7, weight=1.0)
    before, last = (after_steps(declared, replace(solver, iterations=count), device)[1] for count in (6, 7))
    model = last.model
    primal, dual = np.zeros((model.count, 3)), np.zeros((model.count, 3))
    (springs, hinges), x = model.terms, last.state.x.numpy()
    for elements, mine, old in zip((springs, hinges), last._split, before._split, strict=True):
        stencil, rest, k = elements.stencil.numpy(), elements.rest.numpy(), elements.stiffness.numpy()
        if elements is springs:
            G = np.tile([-1.0, 1.0], (len(stencil), 1))
        else:
            G, k = rest[:, :4], k * rest[:, 4]
        y = np.einsum("ei,eic->ec", G, x[stencil])
        z, z_before = mine.z.numpy().reshape(-1, 3), old.z.numpy().reshape(-1, 3)
        for sums, rows in ((primal, y - z), (dual, z - z_before)):
            np.add.at(sums, stencil, (k[:, None] * G)[:, :, None] * rows[:, None])
    for found, forces in ((last.primal, primal), (last.dual, dual)):
        expected = np.linalg.norm(model.inverse_mass.numpy()[:, None] * forces, axis=1).max() / 9.81
        assert found[0] == pytest.approx(expected, rel=1e-9) and expected > 1e-3
    assert last.residual[0] == max(last.primal[0], last.dual[0]) and last.results == [Result.ITERATIONS_USED_UP]
    _, stepper = after_steps(declared, wc.ADMM(substeps=1, iterations=20_000, tolerance=1e-6), device)
    assert max(stepper.primal[0], stepper.dual[0]) <= 1e-6 and stepper.results == [Result.CONVERGED]


# --- residual, copies, status


@pytest.mark.parametrize("solver", [wc.ProjectiveDynamics(substeps=1, iterations=10), wc.XPBD(substeps=1, iterations=10)])
def test_residual_is_that_of_implicit_euler(solver, device):
    """‖(x − x̃)/h² + ∇U/m‖ over g, the largest of any vertex that moves."""
    declared = swinging(16 if isinstance(solver, wc.XPBD) else 8)
    x, stepper = after_steps(declared, solver, device)
    expected = unbalanced(declared, x, device)
    assert stepper.residual[0] == pytest.approx(expected, rel=1e-9)
    assert expected > (1.0 if isinstance(solver, wc.XPBD) else 0.1)


@pytest.mark.parametrize("weight", [1e-12, 1e-5, 1e-2, 1.0, 1e3])
def test_residual_of_admm_hides_nothing(weight, device):
    """As ∇U(z) = W²u, unbalanced are the dual forces and ∇U(Dx) − ∇U(z), of which kA‖Dx − z‖ is the most."""
    declared = swinging(8)
    x, stepper = after_steps(declared, wc.ADMM(substeps=1, weight=weight), device)
    expected = unbalanced(declared, x, device)
    assert expected > 1e-3 and stepper.results == [Result.ITERATIONS_USED_UP]
    assert expected <= 2.0 * stepper.residual[0]


@pytest.mark.parametrize("n", [13, 600])
def test_products_of_past_corrections(n, device):
    """sⱼ·∇φ, zⱼ·∇φ, and sⱼ·y and zⱼ·y with the y of a slot, of each copy: one lane on the CPU, blocks of them on a GPU."""
    random, copies, m, slot = np.random.default_rng(6), 2, 3, 1
    lanes = Lanes(SimpleNamespace(device=wp.get_device(device), copies=copies), n)
    s, y, z = random.normal(size=(3, m, copies * n, 3))
    gradient = random.normal(size=(copies * n, 3))
    histories = (wp.array(each, dtype=wp.vec3d, device=device) for each in (s, y, z))
    slots = wp.array([slot], dtype=wp.int32, device=device)
    given = [wp.array(gradient, dtype=wp.vec3d, device=device), *histories, slots, n, lanes.count]
    parts, out = lanes.parts(4 * m), wp.zeros((copies, 4 * m), dtype=wp.float64, device=device)
    products, finish = accelerate.partial_products(wp.float64, lanes.block), accelerate.finish_products(lanes.block)
    wp.launch(products, (copies, 4 * m, lanes.count), given, [parts], device=device)
    wp.launch(finish, (copies, 4 * m, lanes.of_block[1]), [parts], [out], device=device)
    pairs = [(a, b) for b in (gradient, y[slot]) for a in (s, z)]
    exact = [(a * b).reshape(m, copies, -1).sum(axis=2) for a, b in pairs]
    np.testing.assert_allclose(out.numpy(), np.vstack(exact).T, atol=3 * n * 8 * np.finfo(float).eps)


def test_the_best_weight_of_a_spring(device):
    """1/(2hω) of a spring of two free masses, ω² = 2k/m; each spring has its own."""
    k, m, h = np.array([50.0, 200.0]), 0.2, 0.01
    mesh = wc.Mesh([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1, 0], [1.0, 1, 0]], edges=[[0, 1], [2, 3]])
    model = wc.Scene(mesh, masses=np.full(4, m), terms=[wc.Spring(stiffness=k)]).build(device=device, dtype="float64")
    np.testing.assert_allclose(best_weights(model, model.terms[0], h), 0.5 / (h * np.sqrt(2.0 * k / m)), rtol=1e-12)


@table("name", ("anderson", "admm"), METHODS)
def test_copies_converge_as_if_alone(name, device):
    """Copies of other stiffness need other numbers of iterations; none goes on when it is done, or notices the rest."""
    declared, stiffness = swinging(8), [30.0, 1e3, 100.0]
    solver = replace(METHODS[name], iterations=400, tolerance=1e-3)
    x, together = after_steps(declared, solver, device, copies=3, vary={"Spring.stiffness": stiffness})
    alone, counts = [], []
    for copy, k in enumerate(stiffness):
        one = replace(declared, terms=[replace(declared.terms[0], stiffness=k), *declared.terms[1:]])
        points, stepper = after_steps(one, solver, device)
        alone.append(points)
        counts.append(stepper.iterations)
        assert stepper.results[0] is together.results[copy] and stepper.residual[0] == together.residual[copy]
    assert np.array_equal(x.reshape(3, -1, 3), alone)
    assert len(set(counts)) > 1 and together.iterations == max(counts)


OTHERS = {"xpbd": wc.XPBD(substeps=1)}
OTHERS |= {linear: wc.ConstrainedDynamics(substeps=1, linear=linear) for linear in ("cg", "factorised")}


@pytest.mark.filterwarnings("ignore:overflow encountered")
@table("name", ("anderson", "admm", *OTHERS), METHODS | OTHERS)
def test_what_is_not_finite_has_diverged(name, device):
    """And no other copy with it."""
    declared, solver = swinging(8), (METHODS | OTHERS)[name]
    velocities = np.tile(declared.velocities, (2, 1, 1))
    velocities[1, 40] = 1e200
    x, stepper = after_steps(declared, solver, device, copies=2, vary={"velocities": velocities})
    good, alone = after_steps(declared, solver, device)
    assert stepper.results == [alone.results[0], Result.DIVERGED]
    assert name in OTHERS or (alone.results == [Result.ITERATIONS_USED_UP] and alone.residual[0] > 1e-3)
    assert not np.isfinite(stepper.residual[1]) and np.array_equal(x[:64], good)
    status = wc.simulate(replace(declared, velocities=velocities[1]), solver, device=device, dtype="float64", frames=3).status
    assert not status.ok and "diverged in frame 1" in status.message


def test_status_of_a_run_that_used_up_its_iterations(device):
    status = wc.simulate(swinging(8), wc.ProjectiveDynamics(substeps=1, iterations=3), device=device, frames=2).status
    assert status.ok and status.result is Result.ITERATIONS_USED_UP
    figure = f"largest unbalanced acceleration of a vertex {digits(status.residual)} times gravity (tolerance 0.001)"
    of = "of the solution of the last step of each frame (errors of steps add up)"
    within = f"completed within {millimetres(status.distance)} {of}"
    assert status.message == f"{within}, iterations used up in one or more steps: {figure}"
    easy = replace(swinging(8), terms=[wc.QuadraticBending(stiffness=1e-5)])
    status = wc.simulate(easy, wc.ProjectiveDynamics(substeps=1), device=device, dtype="float64", frames=2).status
    assert status.result is Result.CONVERGED


@pytest.mark.host
def test_one_factorisation_serves_all_steps(monkeypatch, device):
    """One factorisation of the CPU for ten steps of any integrator; another when a solver is bound."""
    built, factor = [], linear.constant_factor
    monkeypatch.setattr(linear, "constant_factor", lambda *given: built.append(1) or factor(*given))
    declared = swinging(8)
    for count, integrator in enumerate(("euler", "midpoint", "bdf2"), 1):
        for solver in (wc.ProjectiveDynamics(substeps=1, integrator=integrator), wc.ADMM(substeps=1, integrator=integrator)):
            after_frames(declared, solver, steps=10, device=device)
        assert len(built) == 2 * count
    wc.ProjectiveDynamics(substeps=1, linear="jacobi").bind(declared.build(device=device)).step()
    assert len(built) == 6


@pytest.mark.parametrize("acceleration", ["none", "anderson"])
def test_steps_are_shorter_where_the_matrix_is_no_bound(acceleration, device):
    """A membrane at 2.5 times its size is curved (3σ² − 1)/2 = 9 times as strongly as at rest, where the matrix is from."""
    mesh = wc.Mesh.grid(4, 4, pattern="alternating")
    scene = wc.Scene(mesh, density=1.0, positions=2.5 * mesh.points, terms=[wc.StVKMembrane(stiffness=1e3)], pins="corners")
    newton = newton_step(scene, device)
    solver = wc.ProjectiveDynamics(substeps=1, iterations=500, tolerance=1e-9, acceleration=acceleration)
    x, _ = after_steps(scene, solver, device)
    assert np.abs(x - newton).max() < 1e-4 and np.abs(x - scene.positions).max() > 0.1


LOCAL = {
    "StVKMembrane": [wc.StVKMembrane(stiffness=30.0, poisson_ratio=0.3)],
    "NeoHookeanMembrane": [wc.NeoHookeanMembrane(stiffness=30.0, poisson_ratio=0.3)],
    "DihedralBending": [wc.Spring(stiffness=30.0), wc.DihedralBending(stiffness=1e-3)],
    "damped": [wc.NeoHookeanMembrane(stiffness=30.0, poisson_ratio=0.3, damping=0.3)],
}


@pytest.mark.slow
@pytest.mark.host
@pytest.mark.parametrize("name", LOCAL)
def test_admm_solves_local_problems_by_newton(name, device):
    """Energies that are no squared distance: after three steps of a thrown cloth ADMM is where Newton is."""
    mesh = wc.Mesh.grid(5, 5, pattern="alternating")
    given = {"positions": 1.05 * mesh.points, "velocities": 0.3 * np.random.default_rng(0).normal(size=(25, 3))}
    scene = wc.Scene(mesh, density=1.0, terms=LOCAL[name], pins="corners", fps=120.0, **given)
    weight = 1.0 if name == "DihedralBending" else 0.1  # an angle is concave beyond its inflection: a small weight oscillates
    both = name in ("NeoHookeanMembrane", "DihedralBending")  # float32 for one membrane and for hinges
    solver = wc.ADMM(substeps=1, tolerance=1e-9, iterations=1000, weight=weight)
    for dtype, bound in (("float64", 1e-8), ("float32", 1e-4))[: 1 + both]:
        newton, _ = after_steps(scene, wc.Newton(substeps=1, tolerance=1e-11), device, dtype, steps=3)
        x, stepper = after_steps(scene, solver, device, dtype, steps=3)
        assert np.abs(x - newton).max() < bound
        assert dtype == "float32" or stepper.results == [Result.CONVERGED]


@pytest.mark.filterwarnings("ignore:overflow encountered")
@table("name", ["DihedralBending"], LOCAL)
def test_forces_beyond_all_numbers_have_diverged(name, device):
    """Newton's method on an element finds no step there, which is not to pass for its minimum."""
    velocities = np.where(np.arange(9)[:, None] == 4, 1e300, np.zeros(3))
    scene = wc.Scene(wc.Mesh.grid(3, 3), density=1.0, velocities=velocities, terms=LOCAL[name][-1:])
    _, stepper = after_steps(scene, wc.ADMM(substeps=1), device)
    if name == "DihedralBending" and device != "cpu":
        return  # fused products make its normals infinite, no NaN, and its force, 1 over their length, is truly 0
    assert stepper.results == [Result.DIVERGED]


def test_a_hinge_without_curvature_at_rest_counts(device):
    """A triangle 5e-7 as high as it is long has no normal; opened it has, and ADMM moves what Newton moves."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 5e-7, 0.0], [0.5, -1.0, 0.0]])
    opened, terms = np.array([*points[:2], [0.5, 0.5, 0.5], points[3]]), [wc.DihedralBending(stiffness=1.0)]
    mesh = wc.Mesh(points, [[0, 1, 2], [1, 0, 3]])
    scene = wc.Scene(mesh, masses=np.ones(4), positions=opened, terms=terms, gravity=(0.0, 0.0, 0.0))
    for solver in (wc.Newton(substeps=1), wc.ADMM(substeps=1)):
        x, _ = after_steps(scene, solver, device)
        assert np.abs(x - opened).max() > 1e-4


@pytest.mark.host
@table("dtype", [], ["float32", "float64"])
def test_admm_takes_a_crushed_membrane(dtype, device):
    """From all vertices but the pins on a line, and all at one position: no NaN, and the cloth comes back to its size."""
    mesh, terms = wc.Mesh.grid(5, 5, pattern="alternating"), LOCAL["NeoHookeanMembrane"]
    for scale in ([1.0, 0.0, 0.0], [0.0, 0.0, 0.0]):
        start = scale * mesh.points + 1e-3 * np.random.default_rng(0).normal(size=mesh.points.shape)
        scene = wc.Scene(mesh, density=1.0, positions=start, terms=terms, gravity=(0.0, 0.0, 0.0), fps=60.0)
        points, _ = after_steps(scene, wc.ADMM(substeps=4, iterations=30), device, dtype, steps=60)
        assert np.isfinite(points).all()
        lengths = np.linalg.norm(np.diff(points[mesh.edges], axis=1)[:, 0], axis=1) / mesh.edge_lengths
        assert 0.5 < np.median(lengths) < 1.5


@pytest.mark.parametrize("speed", [0.06, 1.2], ids=lambda speed: f"{speed} m/s")
def test_contact_pushes_out_at_once(speed, device):
    """A sheet whose x̃ is inside the floor takes 3 iterations. Newton steps, which at most double a distance, take 11."""
    sheet, h, r = wc.Mesh.grid(3, 3, size=0.1), 1.0 / 120.0, 1e-3
    contact, velocities = wc.Contact(distance=r, stiffness=1e5), np.tile([0.0, -speed, 0.0], (9, 1))
    fields = {"colliders": [wc.Plane(friction=0.3)], "contact": contact, "velocities": velocities}
    positions, terms = sheet.points + np.array([0.0, r, 0.0]), [wc.Spring(stiffness=30.0)]
    scene = wc.Scene(sheet, density=0.15, terms=terms, positions=positions, **fields)
    solver = wc.ProjectiveDynamics(substeps=2, tolerance=1e-6)
    x, stepper = after_steps(scene, solver, device)
    assert stepper.results == [Result.CONVERGED] and stepper.iterations <= 4
    # m/h² (d − d of x̃) = −kAφ′(d), with the same mass per area everywhere
    gap, predicted = x[:, 1], r - speed * h - 9.81 * h**2
    force = contact.stiffness * np.where(gap < 0.5 * r, 0.25 * r**2 / gap, r - gap)
    np.testing.assert_allclose(0.15 / h**2 * (gap - predicted), force, rtol=1e-5)
