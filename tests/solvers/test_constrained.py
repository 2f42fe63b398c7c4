"""Constrained dynamics: the published step, the minimiser, hard constraints, redundant ones and those that contradict."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import warp as wp
from scipy.integrate import solve_ivp

import warpcloth as wc
from support.rows import slow_but, table
from support.scenes import scene
from support.steps import after_steps, hanging_mass, strains, swinging, unbalanced
from warpcloth.core.status import Result
from warpcloth.kernels.terms.dihedral_bending import DIHEDRAL_BENDING
from warpcloth.kernels.terms.spring import SPRING
from warpcloth.terms import TERMS

EPS = np.finfo(np.float64).eps
SAFEGUARDS = ("geometric-stiffness", "line-search")
each_linear = pytest.mark.parametrize("linear", slow_but(["cg"], ["cg", "factorised"]))


def constrained(**options):
    return wc.ConstrainedDynamics(**{"substeps": 1, "tolerance": 1e-10, "iterations": 100, **options})


# --- the published step


@each_linear
def test_one_iteration_is_the_published_formula(linear, device):
    """[M, −Jᵀ; J, α̃][Δx; Δλ] = −[0; C] at x̃ and λ = 0, by a dense solve over the free vertices."""
    rng, mesh = np.random.default_rng(0), wc.Mesh.grid(3, 3)
    terms = [wc.Spring(pairs="structural", stiffness=np.r_[np.full(6, np.inf), np.full(6, 200.0)])]
    terms.append(wc.Attachment(vertices=[4], targets=[[0.1, 0.2, 0.3]], stiffness=50.0))
    given = {"masses": rng.uniform(0.5, 1.5, size=9), "positions": mesh.points + 0.05 * rng.normal(size=(9, 3))}
    declared = wc.Scene(mesh, velocities=rng.normal(size=(9, 3)), terms=terms, pins=[0], fps=20.0, **given)
    solver = constrained(iterations=1, stabilisation="none", tolerance=1e-14, linear=linear)
    x, stepper = after_steps(declared, solver, device)
    h, n = stepper.h, 9
    predicted = declared.positions + h * declared.velocities + h**2 * declared.gravity
    predicted[0] = declared.positions[0]
    pairs = declared.terms[0].stencil(mesh)
    y = predicted[pairs[:, 1]] - predicted[pairs[:, 0]]
    length = np.linalg.norm(y, axis=1)
    J, E = np.zeros((15, n, 3)), np.arange(12)
    J[E, pairs[:, 0]], J[E, pairs[:, 1]] = -y / length[:, None], y / length[:, None]
    J[[12, 13, 14], 4, [0, 1, 2]] = 1.0
    J = J[:, 1:].reshape(15, -1)
    C = np.r_[length - np.linalg.norm(np.diff(mesh.points[pairs], axis=1)[:, 0], axis=1), predicted[4] - [0.1, 0.2, 0.3]]
    compliance = 1.0 / (h**2 * np.r_[declared.terms[0].stiffness, np.full(3, 50.0)])
    M = np.diag(np.repeat(declared.vertex_masses[1:], 3))
    system = np.block([[M, -J.T], [J, np.diag(compliance)]])
    move = np.linalg.solve(system, -np.r_[np.zeros(24), C])[:24].reshape(-1, 3)
    assert np.abs(move).max() > 0.01
    # Roundings of about a hundred operations, and of a tolerance of a tenth of 1e-14 of what is above 1000 g h² here.
    assert np.abs(x[1:] - predicted[1:] - move).max() < 1e-11


# --- the minimiser


@each_linear
@pytest.mark.parametrize("stabilisation", SAFEGUARDS)
def test_it_ends_where_newton_does(stabilisation, linear, device):
    """From ``hanging`` at 0.3 s: 1e-8 m, and ‖∇φ‖ at rounding, some times k ε l/(m g) = 1e3·2e-16·0.07/(4e-4·9.8) = 4e-12."""
    # With the line search at 1e-6 of the residual, near √ε, for it compares values of φ; a vertex has eight springs and more.
    declared = swinging(8)
    newton, _ = after_steps(declared, wc.Newton(substeps=1, tolerance=1e-12, linear="factorised"), device)
    searching = stabilisation == "line-search"
    tolerance = 1e-6 if searching else 1e-12
    solver = constrained(stabilisation=stabilisation, tolerance=tolerance, iterations=200, linear=linear)
    x, stepper = after_steps(declared, solver, device)
    assert stepper.results[0] in (Result.CONVERGED, Result.ROUNDED) and np.abs(x - newton).max() < 1e-8
    assert unbalanced(declared, x, device) < (1e-4 if searching else 1e-9)
    x, stepper = after_steps(declared, replace(solver, tolerance=1e-3), device, "float32")
    assert np.abs(x - newton).max() < 1e-4


def test_unsafe_iterations_do_not_converge_and_safe_ones_do(device):
    """Without −λ∂²C more iterations overshoot across springs in tension; each safeguard takes 2 to 3 % of the iterations."""
    declared = swinging(8)
    _, stepper = after_steps(declared, constrained(stabilisation="none", iterations=100, tolerance=1e-3), device)
    assert stepper.results == [Result.ITERATIONS_USED_UP] and stepper.residual[0] > 1.0
    for stabilisation in SAFEGUARDS:
        _, stepper = after_steps(declared, constrained(stabilisation=stabilisation, tolerance=1e-3), device)
        assert stepper.results == [Result.CONVERGED] and stepper.iterations < 60


ENDING = [
    wc.SpringLimit(stiffness=500.0, most=1.02),
    wc.QuadraticBending(stiffness=1e-2),
    wc.Spring(pairs=("structural", "shear"), stiffness=500.0),
    wc.CorotatedMembrane(stiffness=500.0),
    wc.StrainLimit(stiffness=500.0, least=0.97, most=1.02),
    wc.DihedralBending(stiffness=1e-2),
    wc.Attachment(vertices="x > 0.4", stiffness=30.0),
]


@table("stabilisation", SAFEGUARDS[:1], SAFEGUARDS)
@pytest.mark.parametrize("term", slow_but(ENDING[:2], ENDING), ids=lambda term: term.label)
def test_every_term_ends_at_the_minimiser(term, stabilisation, device):
    """A crumpled net with springs and the term: the end of Newton, of a step in which the objective is convex."""
    rng, mesh = np.random.default_rng(4), wc.Mesh.grid(4, 4, pattern="alternating")
    positions, velocities = 1.03 * mesh.points + 0.01 * rng.normal(size=(16, 3)), 0.3 * rng.normal(size=(16, 3))
    fields = {"terms": [wc.Spring(pairs="structural", stiffness=20.0), term], "pins": "corners", "fps": 240.0}
    declared = wc.Scene(mesh, density=1.0, positions=positions, velocities=velocities, **fields)
    expected, newton = after_steps(declared, wc.Newton(substeps=1, tolerance=1e-12, linear="factorised"), device)
    x, stepper = after_steps(declared, constrained(stabilisation=stabilisation, iterations=1000, tolerance=1e-11), device)
    assert stepper.results[0] in (Result.CONVERGED, Result.ROUNDED) and newton.results[0] is not Result.ITERATIONS_USED_UP
    assert np.abs(x - expected).max() < 1e-8


# --- what stiffens


CURVED = [energy.term for energy in TERMS.values() if energy.term.stiffening is not None]


@pytest.mark.parametrize("tension", [0.7, -0.3])
@pytest.mark.parametrize("term", CURVED, ids=lambda term: term.name)
def test_stiffening_is_the_positive_half_of_the_curvature(term, tension, device):
    """BᵀB ⪰ tension·∂²C, semi-definite by form; of springs equal to its positive half, of hinges to what ``hessian`` clamps."""
    M, N = term.rows, term.stiffening_rows
    y_type, out_type = wp.types.matrix((M, 3), wp.float64), wp.types.matrix((N, 3 * M), wp.float64)
    rest_type, square = wp.types.vector(term.parameters, wp.float64), wp.types.matrix((3 * M, 3 * M), wp.float64)
    stiffening, curvature = term.stiffening, term.constraint_hessian

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(y: wp.array(dtype=y_type), t: wp.float64, B: wp.array(dtype=out_type), H: wp.array(dtype=square)):
        i = wp.tid()
        rest = rest_type(wp.float64(0.5))
        B[i] = stiffening(y[i], rest, t)
        H[i] = curvature(y[i], rest)

    y = np.random.default_rng(0).normal(size=(20, M, 3))
    B, H = (wp.zeros(20, dtype=kind, device=device) for kind in (out_type, square))
    wp.launch(evaluate, 20, [wp.array(y, dtype=y_type, device=device), tension], [B, H], device=device)
    B, H = B.numpy(), tension * H.numpy()
    found = np.swapaxes(B, 1, 2) @ B
    assert np.linalg.eigvalsh(found - H).min() > -1e-12 * np.abs(H).max()
    if term is SPRING:
        w, v = np.linalg.eigh(H)
        assert np.abs(found - (v * np.maximum(w, 0.0)[:, None]) @ np.swapaxes(v, 1, 2)).max() < 1e-14
    else:
        assert term is DIHEDRAL_BENDING and np.abs(found).max() > 0.1 and np.linalg.matrix_rank(found).max() <= 4


# --- hard constraints


@each_linear
def test_chain_of_hard_links(linear, device):
    """20 links of a pendulum that starts level: each keeps its length to the tolerance, tol·g h² of 0.05 m."""
    chain = scene("chain", stiffness=np.inf)
    level = chain.mesh.points[:, [1, 0, 2]] * [-1.0, 1.0, 1.0]
    solver = constrained(linear=linear, tolerance=1e-6, substeps=2, iterations=200)
    x, stepper = after_steps(replace(chain, positions=level), solver, device, steps=40)
    assert stepper.results == [Result.CONVERGED]
    assert np.abs(strains(chain, x)).max() < 2.0 * 1e-6 * 9.81 * stepper.h**2 / 0.05 + 10 * EPS
    assert x[-1, 1] < -0.3, "it has swung"


@pytest.mark.host
def test_a_hard_pendulum_is_of_first_order(device):
    """Against θ″ = −(g/l) sin θ; and with m(x − x̃) = Jᵀλ the string's pull is along the string where the step ends."""
    exact = solve_ivp(lambda t, s: [s[1], -9.81 * np.sin(s[0])], (0, 0.5), [1.0, 0.0], rtol=1e-11, atol=1e-12).y[0, -1]
    errors = []
    for substeps in (2, 4, 8, 16):
        bob = [[0.0, 0.0, 0.0], [np.sin(1.0), -np.cos(1.0), 0.0]]
        declared = replace(hanging_mass(np.inf, 1.0, 0.0), positions=bob)
        x, stepper = after_steps(declared, constrained(substeps=substeps), device, steps=30 * substeps)
        assert abs(np.linalg.norm(x[1]) - 1.0) < 1e-10
        pull = stepper.correction.numpy()[1]
        assert np.abs(np.cross(pull, x[1])).max() < 1e-9 * np.linalg.norm(pull)
        errors.append(abs(np.arctan2(x[1, 0], -x[1, 1]) - exact))
    assert np.log2(errors[-2] / errors[-1]) == pytest.approx(1.0, abs=0.15)


def tetrahedron(pairs=None, lengths=None, stiffness=np.inf, moved=0.05, **fields):
    """Four vertices, all six edges and more, moved off their positions."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    edges, start = list(combinations(range(4), 2)), points + moved * np.random.default_rng(2).normal(size=(4, 3))
    terms = [wc.Spring(pairs=edges if pairs is None else pairs, rest_lengths=lengths, stiffness=stiffness)]
    return wc.Scene(wc.Mesh(points, edges=edges), masses=np.arange(1.0, 5.0), positions=start, terms=terms, **fields)


@pytest.mark.parametrize("stiffness", [np.inf, 1e12])
@pytest.mark.parametrize("stabilisation", ["none", "geometric-stiffness"])
@each_linear
def test_redundant_constraints_agree(linear, stabilisation, stiffness, device):
    """Doubled springs, and five vertices with all ten edges, whose lengths have nine degrees of freedom."""
    edges, solver = list(combinations(range(4), 2)), constrained(linear=linear, stabilisation=stabilisation)
    x1, single = after_steps(tetrahedron(stiffness=stiffness), solver, device)
    x2, doubled = after_steps(tetrahedron(edges * 2, stiffness=stiffness), solver, device)
    assert single.results == doubled.results == [Result.CONVERGED]
    # A doubled spring is one of twice the stiffness: strains of 1e-9 at most.
    assert np.abs(x1 - x2).max() < 1e-8
    points, complete = np.vstack([np.zeros(3), np.eye(3), [[0.6, 0.7, 0.8]]]), list(combinations(range(5), 2))
    start = points + 0.02 * np.random.default_rng(5).normal(size=(5, 3))
    terms = [wc.Spring(stiffness=stiffness)]
    declared = wc.Scene(wc.Mesh(points, edges=complete), masses=np.ones(5), positions=start, terms=terms)
    x, stepper = after_steps(declared, solver, device)
    assert stepper.results == [Result.CONVERGED] and np.abs(strains(declared, x)).max() < 1e-8


@each_linear
def test_contradicting_constraints_are_reported(linear, device):
    """Two hard springs of 1 and 1.5 m between the same vertices; a net of rods smaller than the frame that holds it."""
    # They meet half-way. With gravity the iterations for the net wander, as rods that sag a little seem to shorten by rising.
    doubled = [wc.Spring(pairs=[[0, 1], [0, 1]], rest_lengths=[1.0, 1.5], stiffness=np.inf)]
    two = replace(hanging_mass(1.0, 1.0, 0.0), terms=doubled, pins=[])
    mesh, hard = wc.Mesh.grid(4, 4), [wc.Spring(pairs="structural", stiffness=np.inf)]
    fields = {"pins": "boundary", "gravity": (0.0, 0.0, 0.0)}
    net = wc.Scene(mesh, density=1.0, positions=1.1 * mesh.points, terms=hard, **fields)
    for declared in (two, net):
        x, stepper = after_steps(declared, constrained(linear=linear, iterations=20), device)
        assert stepper.results == [Result.CONTRADICTED]
        assert 0.05 < np.abs(strains(declared, x)).max() < 0.3 and stepper.residual[0] > 0.5
    x, stepper = after_steps(replace(net, gravity=(0.0, -9.81, 0.0)), constrained(linear=linear, iterations=20), device)
    assert stepper.results[0] in (Result.ITERATIONS_USED_UP, Result.CONTRADICTED) and stepper.residual[0] > 1.0
    animation = wc.simulate(two, constrained(linear=linear, iterations=10), device=device, frames=2)
    assert ", constraints contradict one another in one or more steps: " in animation.status.message


@each_linear
def test_rows_of_every_kind_contradict(linear, device):
    """A hard body between pins that are too far apart, and a vertex hung hard from two positions: nothing else is hard."""
    chain = wc.Mesh([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]], edges=[[0, 1], [1, 2]])
    given = {"masses": np.ones(3), "fps": 60.0}
    hung = [wc.Attachment(vertices=[0], targets=[[x, 0.0, 0.0]], stiffness=np.inf, name=str(x)) for x in (0.0, 0.5)]
    for declared in (
        wc.Scene(chain, positions=1.3 * chain.points, terms=[wc.RigidCluster(vertices=[0, 1, 2])], pins=[0, 2], **given),
        wc.Scene(chain, terms=hung, **given),
    ):
        _, stepper = after_steps(declared, constrained(linear=linear), device)
        assert stepper.results == [Result.CONTRADICTED] and stepper.residual[0] > 1.0


@each_linear
def test_rounding_is_no_contradiction(linear, device):
    """A turned body with three pins, and a turned net with four: in float32 their shapes contradict the pins by some ε."""
    # In steps of 1/6000 s what gravity moves is 3e-7 m, near the rounding of positions of 1 m.
    mesh = wc.Mesh.grid(5, 5)
    c, s = np.cos(0.7), np.sin(0.7)
    turned = mesh.points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + [1.0, 0.0, 0.0]
    body = [wc.RigidCluster(vertices=[0, 1, 5, 6])], [0, 1, 5]
    for terms, pins in (body, ([wc.Spring(stiffness=np.inf)], [0, 4, 20, 24])):
        declared = wc.Scene(mesh, density=0.2, positions=turned, terms=terms, pins=pins, fps=60.0)
        _, stepper = after_steps(declared, constrained(substeps=100, tolerance=1e-3, linear=linear), device, "float32", steps=3)
        assert stepper.results[0] in (Result.CONVERGED, Result.ROUNDED)


@each_linear
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_what_the_least_compliance_leaves_open_is_no_contradiction(dtype, linear, device):
    """Of n hard links at rest the first carries n masses: α̃λ = 2ε^0.7/m · nmgh², at any tolerance."""
    fields = {"terms": [wc.Spring(stiffness=np.inf)], "pins": [0], "fps": 60.0}
    declared, eps = wc.Scene(wc.Mesh.chain(21), masses=np.full(21, 0.1), **fields), float(np.finfo(dtype).eps)
    x, stepper = after_steps(declared, constrained(tolerance=eps, linear=linear), device, dtype)
    assert stepper.results[0] in (Result.ROUNDED, Result.ITERATIONS_USED_UP)
    assert 0.0 < -1.0 - x[-1, 1] < 20 * 2.0 * 20 * eps**0.7 * 9.81 / 60.0**2 + 20 * eps


@each_linear
def test_soft_constraints_keep_their_stiffness_in_float32(linear, device):
    """1 kg hangs from a mass of 0.1 g, and α̃ = 1/(kh²) is 4e-7 of the diagonal: each spring stretches by mg/k = 10 µm."""
    # The least compliance of hard rows is 40 times as much. Positions of 1 m round by 1.2e-7 m.
    terms = [wc.Spring(stiffness=1e6)]
    declared = wc.Scene(wc.Mesh.chain(3), masses=[1.0, 1e-4, 1.0], terms=terms, pins=[0], fps=60.0)
    x, stepper = after_steps(declared, constrained(tolerance=1e-3, linear=linear), device, "float32", steps=10)
    assert stepper.results[0] in (Result.CONVERGED, Result.ROUNDED)
    assert -1.0 - x[-1, 1] == pytest.approx(2.0 * 9.81e-6, abs=1e-6)


# --- statics and edges of what is allowed


@each_linear
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_stiffness_from_1_to_1e12(dtype, linear, device):
    """A chain with both: soft links stretch by what hangs on them over k after long, stiff ones by nothing."""
    k, tolerance = np.array([1e12, 1e2, 1e12, 1e6, 1e3, 1e9]), 1e-4 if dtype == "float32" else 1e-10
    mesh, terms = wc.Mesh.chain(7), [wc.Spring(stiffness=k)]
    declared = wc.Scene(mesh, masses=np.full(7, 0.1), terms=terms, pins=[0], fps=5.0)
    x, stepper = after_steps(declared, constrained(linear=linear, tolerance=tolerance), device, dtype, steps=200)
    assert stepper.results[0] in (Result.CONVERGED, Result.ROUNDED)
    load, rest = 9.81 * 0.1 * np.arange(6, 0, -1), mesh.edge_lengths
    # What the step and the least compliance, 2ε^0.7 of the move by a load of six masses, leave open.
    open_by = (tolerance + 12.0 * np.finfo(dtype).eps ** 0.7) * 9.81 * stepper.h**2
    assert np.allclose(strains(declared, x) * rest, load / k, rtol=1e-4, atol=open_by)
    pull = -stepper.constraints.multipliers.numpy().reshape(6, -1)[:, 0] / stepper.h**2
    assert np.allclose(pull, load, rtol=10.0 * tolerance)


@each_linear
@pytest.mark.parametrize("stiffness", [1e3, np.inf])
def test_springs_without_direction(stiffness, linear, device):
    """Springs of no length pull their ends together; a collapsed one has no direction, and a hard one then stays open."""
    zero = replace(tetrahedron(lengths=0.0, stiffness=stiffness, moved=0.0), gravity=(0.0, 0.0, 0.0))
    x, stepper = after_steps(zero, constrained(linear=linear, iterations=1), device)
    assert np.isfinite(x).all()
    collapsed = replace(hanging_mass(stiffness, 1.0, 0.0), positions=np.ones((2, 3)), pins=[])
    x, stepper = after_steps(collapsed, constrained(linear=linear), device)
    assert np.allclose(x, [1.0, 1.0 - 9.81 / 3600, 1.0])
    assert stepper.results == [Result.CONVERGED if np.isfinite(stiffness) else Result.ITERATIONS_USED_UP]
