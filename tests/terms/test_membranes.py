"""Membranes and limits on whole meshes: patch test, tension, recovery from any deformation, what limits keep."""

from dataclasses import replace

import numpy as np
import pytest

import warpcloth as wc
from support.energies import DENSITIES, FEW, energy_and_gradient, eps, every_dtype, material_of, random_rotation
from support.meshes import irregular
from support.rows import table
from support.steps import after_steps
from warpcloth.run.equilibrium import SETTLED
from warpcloth.solvers.explicit import step_limits

STIFFNESS = 50.0
WEIGHTLESS = (0.0, 0.0, 0.0)


def membrane(name, ratio, stiffness=STIFFNESS):
    """A membrane, and its μ and λ [N/m]."""
    given, mu, lam = material_of(name, ratio)
    return wc.terms.TERMS[name](stiffness=stiffness, **given), stiffness * mu, stiffness * lam


def gradients(mesh, x):
    """F (T, 3, 2) of places x (n, 3), in the axes x and z of a flat mesh."""
    sides = [np.stack([p[mesh.triangles[:, i]] - p[mesh.triangles[:, 0]] for i in (1, 2)], axis=-1) for p in (mesh.points, x)]
    return sides[1] @ np.linalg.inv(sides[0][:, [0, 2]])


def stretches(mesh, x):
    """Singular values (T, 2), descending."""
    return np.linalg.svd(gradients(mesh, np.asarray(x, dtype=np.float64)), compute_uv=False)


@every_dtype
@pytest.mark.parametrize("name", DENSITIES)
def test_patch(name, dtype, device):
    """Under x = GX + b inner forces vanish and U = u(G)·area; rotating the whole leaves U and turns the forces."""
    random, mesh = np.random.default_rng(1), irregular()
    inner = np.setdiff1d(np.arange(len(mesh.points)), mesh.boundary)
    assert len(inner) == 20
    for _ in range(5):
        G, b, rotation = random.normal(size=(3, 2)), random.normal(size=3), random_rotation(random)
        x = mesh.points[:, [0, 2]] @ G.T + b
        assert np.allclose(gradients(mesh, x), G, rtol=0.0, atol=1e3 * eps("float64"))
        term, mu, lam = membrane(name, 0.3)
        model = wc.Scene(mesh, density=1.0, terms=[term]).build(device=device, dtype=dtype)
        found = [[each.astype(np.float64) for each in energy_and_gradient(model, at)] for at in (x, x @ rotation.T)]
        ((energy,), force), ((energy_turned,), force_turned) = found
        expected = DENSITIES[name](*np.linalg.svd(G, compute_uv=False), mu, lam) * mesh.triangle_areas.sum()
        # F is rounded by eps|x| over the shortest height, 0.1 m, and forces of STIFFNESS·|F|³·0.2 m a side with it.
        size = np.abs(x).max()
        error = FEW * eps(dtype) * size / 0.1 * STIFFNESS * (1.0 + np.linalg.norm(G)) ** 3
        assert abs(energy - expected) <= error and abs(energy_turned - energy) <= error
        assert np.abs(force[inner]).max() <= error and np.abs(force_turned - force @ rotation.T).max() <= error
        assert np.abs(force[mesh.boundary]).max() > 10.0 * error


PULLED = [(name, ratio) for name in DENSITIES if name != "CorotatedMembrane" for ratio in (0.0, 0.3, 0.49, -0.3)]
PULLED.append(("CorotatedMembrane", 0.0))  # which has no other


@table("name, ratio", [each for each in PULLED if each[1] == 0.3 or each[0] == "CorotatedMembrane"], PULLED)
def test_tension_gives_back_the_moduli(name, ratio, device):
    """An irregular strip that is pulled at both ends by f a width: stretches f/Et and −νf/Et, up to the strain itself."""
    length, width = 2.0, 1.0
    mesh = irregular(9, 5, (length, width))
    ends = mesh.select("x < 0.001 or x > 1.999")
    # Ends of rows take half. Far targets pull with the same force wherever a vertex goes.
    share = np.where(np.isin(mesh.points[ends, 2], (0.0, width)), 0.5, 1.0) * width / 4
    outwards, errors = np.sign(mesh.points[ends, :1] - 1.0) * [1.0, 0.0, 0.0], []
    for strain in (1e-3, 1e-4):
        far = {"stiffness": strain * STIFFNESS * share / 1e4, "targets": mesh.points[ends] + 1e4 * outwards}
        pull = wc.Attachment(vertices=ends, **far)
        scene = wc.Scene(mesh, density=0.1, terms=[membrane(name, ratio)[0], pull], gravity=WEIGHTLESS)
        rest = wc.equilibrium(scene, device=device)
        assert rest.status.result in SETTLED, rest.status
        F = gradients(mesh, rest.points)
        along, across = F[:, 0, 0] - 1.0, F[:, 2, 1] - 1.0
        errors.append(max(np.abs(along / strain - 1.0).max(), np.abs(across / strain + ratio).max()))
    # St. Venant–Kirchhoff: f = Et(e + 3/2 e²); the others are less curved. The targets are 1e-4 strains away from infinity.
    assert errors[0] <= 2.0 * 1e-3 and errors[1] <= 2.0 * 1e-4


@pytest.mark.parametrize("name", DENSITIES)
def test_a_strip_hanging_in_its_plane_is_of_second_order(name, device):
    """Below x₁ = 3 widths its weight ρg lengthens it by ρg(L − x₁)²/(2Et), and at x₁ narrows it by ν times the strain."""
    length, width, density = 6.0, 1.0, 0.1
    ratio = 0.0 if name == "CorotatedMembrane" else 0.3
    stiffness = density * 9.81 * length / 1e-6  # of a strain of 1e-6 at the clamp
    errors = []
    for cells in (4, 8, 16):
        mesh = wc.Mesh.grid(6 * cells + 1, cells + 1, size=(length, width), pattern="alternating")
        # Bending, which costs nothing in the plane, keeps what the clamp presses together from buckling.
        terms = [membrane(name, ratio, stiffness)[0], wc.DihedralBending(stiffness=1e-6 * stiffness)]
        scene = wc.Scene(mesh, density=density, terms=terms, pins="x < 0.001", gravity=(9.81, 0.0, 0.0))
        rest = wc.equilibrium(scene, device=device)
        assert rest.status.result in SETTLED, rest.status
        move = (rest.points - mesh.points)[:, [0, 2]].reshape(cells + 1, -1, 2)  # rows along x
        weight, at = density * 9.81 / stiffness, 3 * cells
        longer = (move[:, -1, 0] - move[:, at, 0]).mean() / (weight * 3.0**2 / 2.0)
        narrower = (move[0, at, 1] - move[-1, at, 1]) / (weight * 3.0 * width)
        errors.append((abs(longer - 1.0), abs(narrower - ratio)))
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert orders[:, 0].min() > 1.7 and errors[-1][0] < 2.5e-5
    # Second order too, down to what the strain, 1e-6, leaves.
    assert max(error for _, error in errors) < 1e-5 and errors[-1][1] < 3e-6


COLLAPSED = {
    "in both directions": lambda mesh, noise: 0.01 * mesh.points + noise,
    "in one direction": lambda mesh, noise: mesh.points * [0.01, 1.0, 1.0] + noise,
    "at random places": lambda mesh, noise: np.random.default_rng(3).uniform(size=mesh.points.shape),
}


FROM = [(start, 0.3) for start in COLLAPSED]


def collapsed(start, ratio, **fields):
    """A membrane in a hundredth of its size, with noise of 1e-3 of an edge."""
    mesh, terms = wc.Mesh.grid(9, 9, pattern="alternating"), [wc.NeoHookeanMembrane(stiffness=100.0, poisson_ratio=ratio)]
    noise = 1e-3 * np.median(mesh.edge_lengths) * np.random.default_rng(0).normal(size=mesh.points.shape)
    given = {"positions": COLLAPSED[start](mesh, noise), "gravity": WEIGHTLESS, **fields}
    return wc.Scene(mesh, density=0.1, terms=terms, **given)


@table("start, ratio", FROM, [*FROM, ("in one direction", 0.0), ("at random places", 0.0), ("in both directions", 0.49)])
def test_neo_hookean_recovers(start, ratio, device):
    """It unfolds to stretches of 1, however its start rounds."""
    declared = collapsed(start, ratio)
    mesh, positions = declared.mesh, declared.positions
    up = np.random.default_rng(1).random((3, *positions.shape)) < 0.5
    for rounded in (positions, *np.nextafter(positions, np.where(up, np.inf, -np.inf))):
        scene = replace(declared, positions=rounded)
        assert np.abs(stretches(mesh, scene.positions) - 1.0).max() > 0.9
        # The tolerance is relative to the forces at the start, those of strains above 10 where vertices are at random places.
        rest = wc.equilibrium(scene, tolerance=1e-9, device=device)
        assert rest.status.result in SETTLED, rest.status
        # Without bending stiffness it ends crumpled, where a stretch differs from 1 by the square of a move.
        assert np.abs(stretches(mesh, rest.points) - 1.0).max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("start", COLLAPSED)
def test_neo_hookean_recovers_in_float32(start, device):
    """Moves that cost nothing, which rounding makes without end, do not use up the iterations of a sheet that is at rest."""
    scene = collapsed(start, 0.49)
    rest = wc.equilibrium(scene, dtype="float32", device=device)
    assert rest.status.result in SETTLED and rest.iterations < 500, rest
    assert np.abs(stretches(scene.mesh, rest.points) - 1.0).max() < 1e-4


def test_neo_hookean_recovers_in_motion(device):
    """Implicit steps of 1/60 s unfold a random heap, and damp it to rest."""
    scene = collapsed("at random places", 0.3, duration=1.0)
    animation = wc.simulate(scene, wc.Newton(dt=1 / 60), device=device, dtype="float64")
    assert animation.status.ok, animation.status
    errors = [np.abs(stretches(scene.mesh, points) - 1.0).max() for points in animation.points]
    assert errors[0] > 1.0 and errors[10] < 0.1 and errors[60] < 0.01


# --- limits

SHEETS = {
    "equilateral": lambda: wc.Mesh.grid(10, 10, pattern="equilateral"),
    "alternating": lambda: wc.Mesh.grid(10, 10, pattern="alternating"),
    "irregular": lambda: irregular(10, 10),
}
BOTH, MOST, LEAST, NO_STRETCH = {"least": 0.95, "most": 1.05}, {"most": 1.05}, {"least": 0.95}, {"most": 1.0}


def measured(limit, mesh, x):
    """The lengths or stretches that a limit limits, at positions x."""
    if isinstance(limit, wc.SpringLimit):
        return np.linalg.norm(x[mesh.edges[:, 1]] - x[mesh.edges[:, 0]], axis=1) / mesh.edge_lengths
    return stretches(mesh, x)


def flung(sheet, limit, seed=0, **scene):
    """A sheet at rest whose vertices fly apart at about 1 m/s, an edge in 0.1 s."""
    mesh = SHEETS[sheet]()
    velocities = np.random.default_rng(seed).normal(size=mesh.points.shape)
    return wc.Scene(mesh, density=0.1, terms=[limit], velocities=velocities, gravity=WEIGHTLESS, **scene)


@table("sheet", list(SHEETS)[:1], SHEETS)
@pytest.mark.parametrize("limits", [BOTH, MOST, LEAST, NO_STRETCH], ids=str)
@pytest.mark.parametrize("kind", [wc.SpringLimit, wc.StrainLimit])
def test_converged_pbd_keeps_limits(kind, limits, sheet, device):
    limit = kind(**limits)
    scene = flung(sheet, limit, fps=60.0)
    x, stepper = after_steps(scene, wc.PBD(substeps=1, iterations=1000), device)
    least, most = limits.get("least", 0.0), limits.get("most", np.inf)

    def beyond(x):
        values = measured(limit, scene.mesh, x)
        return max((least - values).max(), (values - most).max())

    assert beyond(scene.mesh.points + stepper.h * scene.velocities) > 0.03, "without the limit it would be passed"
    # What is left falls linearly with the sweeps, unless least and most meet in one place and it buckles.
    assert beyond(x) < (2e-3 if limits is BOTH else 1e-5)


# The local step moves F straight to its nearest point, which is the nearest in the metric of the masses too where G W Gᵀ is a
# multiple of the identity: for pairs always, for triangles where they are equilateral and of equal masses. Only then it is the
# projection onto a convex set, for which x_new is no farther from x_old than the prediction is.
gains = pytest.mark.xfail(
    raises=AssertionError, reason="on such triangles a projection of F is none in the metric of the masses"
)


KEPT = [*((wc.SpringLimit, sheet) for sheet in SHEETS), (wc.StrainLimit, "equilateral")]


@pytest.mark.parametrize(("kind", "sheet"), [*KEPT, pytest.param(wc.StrainLimit, "irregular", marks=gains)])
@pytest.mark.parametrize("limits", [MOST, NO_STRETCH], ids=str)
def test_limits_of_stretch_alone_add_no_energy(kind, sheet, limits, device):
    """From a feasible state σ_max alone never raises the kinetic energy; sums with ω below 1/valence are projections."""
    scene = flung(sheet, kind(**limits), fps=60.0)
    solver = wc.PBD(substeps=1, iterations=400, sweep="jacobi", relaxation=1 / 8)
    stepper = solver.bind(scene.build(device=device, dtype="float64"))

    def kinetic():
        v = stepper.state.v.numpy()
        return 0.5 * (scene.vertex_masses[:, None] * v * v).sum()

    energies = [kinetic()]
    for _ in range(30):
        stepper.step()
        energies.append(kinetic())
    assert (np.diff(energies) <= 0.0).all()


SERVED = [(kind, wc.Newton(substeps=4)) for kind in (wc.SpringLimit, wc.StrainLimit)]


@table("kind, solver", SERVED, [*SERVED, (wc.SpringLimit, wc.Explicit(substeps=44))])
def test_finite_limits_serve_solvers_that_need_forces(kind, solver, device):
    """A soft membrane that hangs by two corners stretches no further than its limit's own stiffness lets it."""
    mesh, worst = wc.Mesh.grid(9, 9, pattern="alternating"), []
    for limits in ([], [kind(most=1.05, stiffness=2e3)]):
        terms = [wc.NeoHookeanMembrane(stiffness=5.0, poisson_ratio=0.3), *limits]
        scene = wc.Scene(mesh, density=0.1, terms=terms, pins="corners and z == 0", duration=0.4)
        animation = wc.simulate(scene, solver, device=device, dtype="float64")
        assert animation.status.ok, animation.status
        worst.append(measured(kind(most=1.05), mesh, animation.points[-1]).max())
    assert worst[0] > 1.3 and worst[1] < 1.1


@pytest.mark.parametrize(
    ("limit", "material"),
    [
        (wc.SpringLimit(most=1.1, stiffness=100.0), wc.Spring(stiffness=100.0)),
        (wc.StrainLimit(least=0.8, stiffness=100.0), wc.CorotatedMembrane(stiffness=100.0)),
    ],
)
def test_explicit_steps_count_limits_as_reached(limit, material, device):
    """A limit at rest has no stiffness, but the steps must hold when it has: they are those of the material beyond it."""
    models = (flung("irregular", term).build(device=device, dtype="float64", copies=2) for term in (limit, material))
    of_limit, of_material = (step_limits(model) for model in models)
    assert of_limit == pytest.approx(of_material, rel=1e-6) and 0.0 < of_limit[0] < 1.0


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_stiffness_beyond_the_precision_ends_a_run(dtype, device):
    """The part 1/k of the local Hessian that makes it definite is lost in float32; the element must not just stay as it is."""
    sheet = wc.Scene(wc.Mesh.grid(8, 8), density=0.1, terms=[wc.StVKMembrane(stiffness=1e12)], pins=[0, 7])
    run = wc.simulate(sheet, wc.XPBD(substeps=4, iterations=10), frames=1, dtype=dtype, device=device)
    assert run.status.ok == (dtype == "float64")


# --- moduli


@pytest.mark.parametrize("cls", [wc.StVKMembrane, wc.NeoHookeanMembrane])
def test_moduli_of_a_material(cls):
    """μ = Et/(2(1 + ν)) and λ = Eνt/(1 − ν²) give the same term as E, ν and t."""
    E, ratio, thickness = 1e6, 0.3, 1e-3
    term = cls.from_material(E, ratio, thickness, name="rubber")
    assert (term.stiffness, term.poisson_ratio, term.name) == (E * thickness, ratio, "rubber")
    same = cls.from_moduli(E * thickness / (2 * (1 + ratio)), E * ratio * thickness / (1 - ratio**2))
    assert same.stiffness == pytest.approx(term.stiffness, rel=4 * eps("float64"))
    assert same.poisson_ratio == pytest.approx(ratio, rel=4 * eps("float64"))
    assert wc.CorotatedMembrane.from_material(E, thickness).stiffness == E * thickness


def test_a_stiffness_varies_and_the_ratio_stays(device):
    mesh = irregular()
    x, stiffness = mesh.points * [1.2, 1.0, 0.9], [10.0, 20.0, 70.0]
    scene = wc.Scene(mesh, density=0.1, terms=[wc.StVKMembrane(stiffness=1.0, poisson_ratio=0.4)], positions=x)
    model = scene.build(device=device, dtype="float64", copies=3, vary={"StVKMembrane.stiffness": stiffness})
    energy, _ = energy_and_gradient(model)
    assert np.allclose(energy, energy[0] / 10.0 * np.array(stiffness), rtol=FEW * eps("float64")) and energy[0] > 0.0
