"""Tests energies, works and reactions against closed forms, balances of momentum and of energy, and the run without them."""

from dataclasses import replace

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom
from scipy.optimize import brentq

import warpcloth as wc
from support import setups
from support.rows import slow_but
from support.setups import MAIN, square
from support.usd_validation import validate
from warpcloth.run.history import Evaluation
from warpcloth.scenes import hanging
from warpcloth.usd import read_scene, write_scene
from warpcloth.usd.stage import find_prim

BOTH = ("energies", "reactions")
NONE = (0.0, 0.0, 0.0)
SOLVERS = {name: replace(solver, substeps=8) for name, solver in setups.SOLVERS.items()}


def lifted(frames=12, **given):
    """A cloth whose corners rise faster and faster."""
    cloth = square(pins="corners", **given)
    start = cloth.positions[cloth.pins.vertices]
    keyframes = start + 0.01 * np.arange(frames)[:, None, None] ** 1.5 * np.array([0.2, 1.0, 0.0])
    return replace(cloth, pins=wc.Pins("corners", keyframes))


def total(energies):
    """Of a closed system the sum of all energies, less the work that was done on it; constant."""
    return sum(-values if name.startswith("work") else values for name, values in energies.items())


def test_what_hangs_at_rest_pulls_by_its_weight(device):
    """And has no moment about any point; along y alone, to rounding."""
    cloth = square(pins="corners")
    rest = wc.equilibrium(cloth, device=device, tolerance=1e-12, record=BOTH)
    weights = cloth.vertex_masses[:, None] * cloth.gravity
    mg = 9.81 * cloth.vertex_masses.sum()
    np.testing.assert_allclose(rest.reactions.sum(axis=0), [0.0, mg, 0.0], rtol=1e-9, atol=1e-9 * mg)
    moments = np.cross(rest.points[cloth.pins.vertices], rest.reactions).sum(axis=0) + np.cross(rest.points, weights).sum(
        axis=0
    )
    np.testing.assert_allclose(moments, 0.0, atol=1e-9 * mg)
    still = wc.simulate(
        replace(cloth, positions=rest.points), SOLVERS["newton"], device=device, dtype="float64", frames=3, record="reactions"
    )
    np.testing.assert_allclose(still.reactions, np.tile(rest.reactions, (4, 1, 1)), atol=1e-9 * mg)
    assert rest.energies["gravity"] == pytest.approx(-(weights * (rest.points - cloth.positions)).sum(), rel=1e-12)


def test_pins_of_a_chain_bear_the_tension_of_the_discrete_catenary(device):
    """Link i bears V_i = (i − (N−2)/2) m g upward and H along x, and is L + √(H² + V_i²)/k long; H closes the span."""
    count, span, m, k = 12, 0.8, 0.05, 500.0
    chain = wc.Mesh.chain(count, length=1.0)
    x = np.linspace(0.0, span, count)
    positions = np.stack([x, -np.sin(np.pi * x / span), 0.0 * x], axis=1)
    scene = wc.Scene(chain, masses=np.full(count, m), positions=positions, terms=[wc.Spring(stiffness=k)], pins=[0, count - 1])
    rest = wc.equilibrium(scene, device=device, tolerance=1e-12, record="reactions")
    vertical = (np.arange(count - 1) - 0.5 * (count - 2)) * m * 9.81

    def gap(horizontal):
        tension = np.hypot(horizontal, vertical)
        return ((1.0 / (count - 1) + tension / k) * horizontal / tension).sum() - span

    horizontal = brentq(gap, 1e-3, 10.0, xtol=1e-14)
    half = 0.5 * count * m * 9.81
    np.testing.assert_allclose(rest.reactions, [[-horizontal, half, 0.0], [horizontal, half, 0.0]], rtol=1e-8, atol=1e-9)


def test_pins_bear_pressure_traction_and_forces(device):
    """Pressure on what is pinned all round pulls by p A, A the flat area, whatever its shape."""
    cloth = replace(square(pins="boundary"), gravity=NONE, loads=[wc.Pressure(vertices="all", pressure=50.0)])
    rest = wc.equilibrium(cloth, device=device, tolerance=1e-11, record=BOTH)
    up = np.sign(rest.points[:, 1].sum())
    np.testing.assert_allclose(rest.reactions.sum(axis=0), [0.0, -50.0 * up, 0.0], atol=1e-7)
    assert "work of loads" not in rest.energies  # it depends on the path
    loads = [wc.Traction(vertices="x == 1", traction=(3.0, 0.0, 0.0)), wc.Force(vertices=[0], force=(0.0, 2.0, 0.0))]
    cloth = replace(square(pins="x == 0"), gravity=NONE, loads=loads)
    rest = wc.equilibrium(cloth, device=device, tolerance=1e-11, record=BOTH)
    np.testing.assert_allclose(rest.reactions.sum(axis=0), [-3.0, -2.0, 0.0], atol=1e-8)
    moved = rest.points - cloth.positions
    assert rest.energies["work of loads"] == pytest.approx((3.0 * moved[cloth.mesh.points[:, 0] > 0.99, 0]).mean(), rel=0.05)


def test_rollers_bear_along_the_axes_that_they_hold(device):
    cloth = square(pins=wc.Pins([0, 5, 30], axes=["xyz", "y", "xy"]))
    rest = wc.equilibrium(cloth, device=device, record="reactions")
    assert (rest.reactions[~cloth.pins.held] == 0.0).all()
    assert rest.reactions[:, 1].sum() == pytest.approx(9.81 * cloth.vertex_masses.sum(), rel=1e-7)


# The factor by which the error of the balance falls with half the step.
ORDERS = {"explicit": 2, "newton": 2, "newton midpoint": 4, "newton bdf2": 4, "xpbd": 2, "constrained dynamics": 2}
WITHOUT_AIR = [("constrained dynamics", "air")]


@pytest.mark.parametrize(
    ("name", "driven"),
    slow_but(
        [("newton midpoint", "pins"), ("xpbd", "loads"), ("xpbd", "air")],
        [(name, driven) for name in ORDERS for driven in ("pins", "loads", "air") if (name, driven) not in WITHOUT_AIR],
    ),
)
def test_energies_and_works_balance_to_the_order_of_the_scheme(name, driven, device):
    """Moved pins, a pressure and a force that change, or wind; the motion is the same to the bit as without a history.

    Of which the first frames say all: what a history changed in a step would be in those after it too.
    """
    if driven == "pins":
        cloth = lifted()
    elif driven == "air":
        cloth = square(pins="corners", air=wc.Air(wind=(3.0, 1.0, 2.0)))
    else:
        push = np.zeros((12, 3))
        push[:, 1] = 0.02 * np.sin(0.8 * np.arange(12))
        loads = [wc.Pressure(vertices="all", keyframes=np.arange(12.0)), wc.Force(vertices=[14, 15], keyframes=push)]
        cloth = square(pins="corners", loads=loads)
    if name == "explicit":
        cloth = replace(cloth, terms=cloth.terms[:2])
    gaps = []
    for substeps in (16, 32) if driven == "loads" else (8, 16):
        solver = replace(SOLVERS[name], substeps=substeps)
        if name in ("xpbd", "constrained dynamics"):
            solver = replace(solver, iterations=40)
        run = {"device": device, "dtype": "float64"}
        recorded = wc.simulate(cloth, solver, record=BOTH, frames=11, **run)
        gaps.append(np.abs(total(recorded.energies)).max())
        assert f"work of {driven}" in recorded.energies
    assert (wc.simulate(cloth, solver, frames=2, **run).points == recorded.points[:3]).all()
    order = 2 if (name, driven) == ("newton bdf2", "air") else ORDERS[name]  # its air is of first order
    assert gaps[1] < gaps[0] / (0.85 * order)
    assert gaps[1] < 0.05 * np.abs(recorded.energies[f"work of {driven}"]).max()


def quadratic():
    """Springs without length and attachments, whose energies are quadratic, with pins that move and forces that change."""
    mesh = wc.Mesh.grid(4, 4)
    terms = [
        wc.Spring(stiffness=3.0, rest_lengths=0.0),
        wc.Spring(pairs="shear", stiffness=2.0, rest_lengths=0.0),
        wc.Attachment(vertices="corners", stiffness=4.0),
        wc.QuadraticBending(stiffness=1e-3),
    ]
    start = mesh.points[[5, 9]]
    keyframes = start + 0.05 * np.array([[0, 0, 0], [1, 2, 0], [0, 3, 1], [2, 1, 1]])[:, None]
    loads = [wc.Force(vertices="x > 0.5", keyframes=0.1 * np.array([[0, 0, 0], [1, 0, 2], [-1, 1, 0]]))]
    velocities = np.random.default_rng(3).normal(size=mesh.points.shape)
    return wc.Scene(mesh, density=0.5, terms=terms, velocities=velocities, pins=wc.Pins([5, 9], keyframes), loads=loads)


@pytest.mark.parametrize("loads", ["none", "constant", "keyframes", "air"])
def test_midpoint_balances_quadratic_energies_to_rounding(loads, device):
    constant = [wc.Force(vertices="x > 0.5", force=(0.1, 0.2, 0.3)), wc.Traction(vertices="z == 0", traction=(0.0, 0.1, 0.0))]
    scene = quadratic()
    scene = replace(scene, loads={"constant": constant, "keyframes": scene.loads}.get(loads, []))
    if loads == "air":  # on pins that move, its work is exact to first order only
        scene = replace(scene, air=wc.Air(wind=(3.0, 1.0, 2.0)), pins=[5, 9])
    solver = wc.Newton(substeps=2, integrator="midpoint", tolerance=1e-12, linear="factorised")
    run = wc.simulate(scene, solver, device=device, dtype="float64", frames=8, record="energies")
    sums = total(run.energies)
    np.testing.assert_allclose(sums, sums[0], rtol=0.0, atol=1e-11 * np.abs(run.energies["kinetic"]).max())
    works = {"none": ["pins"], "air": ["air"]}.get(loads, ["pins", "loads"])
    assert all(np.abs(run.energies[f"work of {work}"]).max() > 0.01 for work in works)


def test_implicit_euler_loses_half_the_squares_of_its_changes(device):
    """Of quadratic energies exactly ½‖Δv‖²_M + ½‖Δx‖²_K, with nothing moved."""
    scene = replace(quadratic(), loads=(), pins=[5, 9])
    solver = wc.Newton(substeps=1, tolerance=1e-12, linear="factorised")
    run = wc.simulate(scene, solver, device=device, dtype="float64", frames=8, record="energies")
    dv, dx = np.diff(run.velocities, axis=0), np.diff(run.points, axis=0)
    kinetic = 0.5 * (scene.vertex_masses[:, None] * dv**2).sum(axis=(1, 2))
    # K of a quadratic energy without a linear part about 0 gives U of the change itself; attachments at 0 then.
    about_0 = replace(scene, terms=[*scene.terms[:2], replace(scene.terms[2], targets=NONE), scene.terms[3]])
    elastic = []
    for change in dx:
        still = replace(about_0, positions=change, pins=None, gravity=NONE, velocities=0.0 * change)
        found = wc.simulate(still, solver, device=device, dtype="float64", frames=1, record="energies").energies
        elastic.append(sum(found[term][0] for term in ("Spring", "Spring 2", "Attachment", "QuadraticBending")))
    np.testing.assert_allclose(-np.diff(total(run.energies)), kinetic + elastic, rtol=1e-9)


def test_symplectic_euler_swings_about_its_energy(device):
    """On x″ = −ω²x it keeps ½m(v² + ω²x² − hω²xv), so that the energy is within ½mhω²|xv| of it at each frame."""
    k, m, h = 40.0, 0.5, 1.0 / 240.0
    bead = wc.Scene(
        wc.Mesh.chain(2),
        masses=[1.0, m],
        positions=[[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]],
        terms=[wc.Attachment(vertices=[1], targets=NONE, stiffness=k)],
        pins=[0],
        gravity=NONE,
    )
    run = wc.simulate(bead, wc.Explicit(substeps=4), device=device, dtype="float64", frames=40, record="energies")
    xv = (run.points[:, 1] * run.velocities[:, 1]).sum(axis=1)
    np.testing.assert_allclose(total(run.energies) - 0.5 * h * k * xv, 0.5 * k * 0.3**2, rtol=1e-12)


def test_pins_that_lift_slowly_do_the_work_of_the_weight(device):
    cloth = square(pins="corners", damping=0.01)
    cloth = replace(cloth, positions=wc.equilibrium(cloth, device=device).points)
    start = cloth.positions[cloth.pins.vertices]
    rise = 0.5 * (1.0 - np.cos(np.pi * np.linspace(0.0, 1.0, 61)))
    cloth = replace(cloth, pins=wc.Pins("corners", start + 0.4 * rise[:, None, None] * np.array([0.0, 1.0, 0.0])))
    run = wc.simulate(cloth, SOLVERS["newton"], device=device, dtype="float64", frames=75, record="energies")
    assert 0.0 < run.energies["work of pins"][-1] / (0.4 * 9.81 * cloth.vertex_masses.sum()) - 1.0 < 1e-2  # some is damped


HARD = {
    "xpbd": wc.XPBD(substeps=1, iterations=50),
    "xpbd averaged by constraint": wc.XPBD(substeps=1, iterations=5, sweep="constraint-averaged"),
    "constrained dynamics": wc.ConstrainedDynamics(substeps=1, iterations=100, tolerance=1e-12),
}


def pendulum():
    """A chain of hard and soft links that swings from a pin that stands and one that moves."""
    chain = wc.Mesh.chain(8, length=1.4)
    edges = chain.edges
    terms = [wc.Spring(pairs=edges[::2], stiffness=np.inf), wc.Spring(pairs=edges[1::2], stiffness=1e3)]
    x = np.linspace(0.0, 1.4, 8)
    positions = np.stack([x, 0.0 * x, 0.0 * x], axis=1)
    keyframes = positions[[0, 7]] + np.arange(9)[:, None, None] * np.array([[0.0, 0.0, 0.0], [-0.02, 0.0, 0.01]])
    return wc.Scene(chain, masses=np.full(8, 0.1), positions=positions, terms=terms, pins=wc.Pins([0, 7], keyframes))


@pytest.mark.parametrize("name", HARD)
def test_reactions_of_hard_terms_balance_the_momentum(name, device):
    """Σ R = Σ m Δv/h − Σ m g over vertices that move, and the pins' own weight; XPBD leaves soft springs out of balance."""
    scene = pendulum()
    if "xpbd" in name:
        scene = replace(scene, terms=[wc.Spring(stiffness=np.inf)])
    run = wc.simulate(scene, HARD[name], device=device, dtype="float64", frames=7, record=BOTH)
    assert np.isnan(run.reactions[0]).all()
    rates = np.diff(run.velocities, axis=0)[:, 1:-1].sum(axis=1) * 0.1 * scene.fps
    weight = np.array([0.0, 0.8 * 9.81, 0.0])
    np.testing.assert_allclose(run.reactions[1:].sum(axis=1), rates + weight, atol=1e-8 if "xpbd" in name else 1e-6)
    assert np.abs(run.reactions[1:]).max() > 1.0
    assert (run.energies["Spring"] == 0.0).all()


@pytest.mark.parametrize("name", [*HARD, "xpbd scalar"])
def test_the_upper_of_hard_links_bears_all_weight(name, device):
    solver = {**HARD, "xpbd scalar": wc.XPBD(substeps=1, form="scalar")}[name]
    chain = wc.Mesh.chain(4)
    scene = wc.Scene(chain, masses=[0.1, 0.2, 0.3, 0.4], terms=[wc.Spring(stiffness=np.inf)], pins=[0])
    run = wc.simulate(scene, replace(solver, iterations=1000), device=device, dtype="float64", frames=2, record="reactions")
    np.testing.assert_allclose(run.reactions[1:, 0], [[0.0, 9.81, 0.0]] * 2, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["newton", "newton factorised", "projective dynamics", "admm", "constrained dynamics"])
def test_reactions_of_an_implicit_step_balance_its_momentum(name, device):
    """With damping, which is of the same step."""
    cloth = replace(square(damping=1e-2), pins=[0, 5])
    cloth = replace(cloth, terms=cloth.terms[:1])
    solver = replace(SOLVERS[name], substeps=1, iterations=3000, tolerance=1e-11)
    run = wc.simulate(cloth, solver, device=device, dtype="float64", frames=5, record="reactions")
    momentum = (cloth.vertex_masses[:, None] * run.velocities).sum(axis=1)
    expected = np.diff(momentum, axis=0) * cloth.fps - cloth.vertex_masses.sum() * cloth.gravity
    np.testing.assert_allclose(run.reactions[1:].sum(axis=1), expected, atol=1e-8)


def test_copies_have_books_of_their_own(device):
    """To the bit those of a thread each; a copy that diverges has none from then on."""
    cloth, solver = replace(lifted(), terms=lifted().terms[:1]), wc.Explicit(substeps=8, above_limit="allow")
    run = {"device": device, "dtype": "float64", "frames": 6, "record": BOTH}
    vary = {"Spring.stiffness": [50.0, 100.0, 1e6]}
    batch = wc.simulate(cloth, solver, copies=3, vary=vary, **run)
    alone = wc.simulate(replace(cloth, terms=[replace(cloth.terms[0], stiffness=50.0)]), solver, **run)
    assert batch.reactions.shape == (7, 3, 4, 3)
    np.testing.assert_allclose(batch.reactions[:, 0], alone.reactions, rtol=0.0, atol=1e-10)
    for name, values in batch.energies.items():
        assert values.shape == (7, 3) and alone.energies[name].shape == (7,)
        np.testing.assert_allclose(values[:, 0], alone.energies[name], rtol=0.0, atol=1e-10)
        assert np.isnan(values[-1, 2]) and np.isfinite(values[:, :2]).all()
    assert np.isnan(batch.reactions[-1, 2]).all()
    if device == "cpu":
        shared = wc.simulate(cloth, solver, copies=3, vary=vary, threads=2, **run)
        assert np.array_equal(shared.reactions, batch.reactions, equal_nan=True)
        assert all(np.array_equal(shared.energies[name], batch.energies[name], equal_nan=True) for name in batch.energies)


def test_threads_share_the_multipliers_of_a_batch(device):
    if device != "cpu":
        pytest.skip("threads are of the CPU")
    scene = replace(pendulum(), terms=[wc.Spring(stiffness=np.inf)])
    run = {
        "dtype": "float64",
        "frames": 3,
        "copies": 3,
        "vary": {"gravity": [[0, -9.81, 0], [0, 0, 5], [1, 2, 3]]},
        "record": BOTH,
    }
    alone, shared = (wc.simulate(scene, HARD["xpbd"], threads=threads, **run) for threads in (1, 2))
    assert np.array_equal(alone.reactions, shared.reactions, equal_nan=True)


def test_books_follow_the_order_of_the_vertices(device):
    """Of a model whose vertices are in another order: at the start, which is out of balance."""
    rng = np.random.default_rng(0)
    cloth = square(
        pins=wc.Pins([5, 30, 2], axes=["xyz", "y", "xz"]), loads=[wc.Force(vertices="x > 0.5", force=(1.0, 2.0, 3.0))]
    )
    cloth = replace(cloth, positions=cloth.positions + rng.normal(scale=0.02, size=cloth.positions.shape))
    found = []
    for order in (None, rng.permutation(36)):
        model = cloth.build(device=device, dtype="float64", order=order)
        evaluation, x = Evaluation(model), model.array(model.positions.numpy() * 1.1, model.vec3)
        evaluation.launch(x)
        found.append((evaluation.reactions(), np.array(list(evaluation.energies(x).values()))))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-12, atol=1e-12)
    assert np.abs(found[0][0]).max() > 1.0 and found[0][1][-1] != 0.0


@pytest.mark.parametrize("name", slow_but(("newton", "xpbd", "projective dynamics"), [*MAIN, "newton midpoint", "newton bdf2"]))
def test_books_leave_the_motion_as_it_is(name, device):
    """In float32, and without them nothing is launched for them."""
    cloth = square(solver=SOLVERS[name], pins="corners")
    plain, recorded = (wc.simulate(cloth, SOLVERS[name], device=device, frames=3, record=record) for record in ((), BOTH))
    assert (plain.points == recorded.points).all() and (plain.velocities == recorded.velocities).all()
    assert plain.energies is None and plain.reactions is None
    assert list(recorded.energies) == [*(type(term).__name__ for term in cloth.terms), "kinetic", "gravity"]


@pytest.mark.host
def test_energies_of_terms_of_one_name_are_told_apart():
    names = [None, "Spring 2", None, "kinetic"]
    terms = [wc.Spring(stiffness=float(k + 1), name=name) for k, name in enumerate(names)]
    rest = replace(square(), terms=terms, pins="corners")
    found = wc.equilibrium(rest, record="energies").energies
    assert list(found) == ["Spring", "Spring 2", "Spring 3", "kinetic 2", "gravity"]
    np.testing.assert_allclose(np.array(list(found.values())[:4]) / found["Spring"], [1.0, 2.0, 3.0, 4.0], rtol=1e-12)


@pytest.mark.parametrize("source", [False, True])
@pytest.mark.parametrize("single", [False, True])
def test_books_are_primvars_of_the_animation(source, single, tmp_path, device):
    """Reactions at pins, 0 elsewhere, and energies, sampled as the points are; in SI, over a stage in centimetres too."""
    cloth = replace(lifted(), loads=[wc.Pressure(vertices="all", pressure=1.0)])
    if source:
        path = write_scene(cloth, tmp_path / "cloth.usda")
        stage = Usd.Stage.Open(path)
        UsdGeom.SetStageMetersPerUnit(stage, 0.01)
        UsdGeom.Xformable(stage.GetPrimAtPath("/World")).AddScaleOp().Set(Gf.Vec3f(100.0))
        stage.Save()
        cloth = read_scene(path)
    run = {"device": device, "frames": 4, "record": BOTH, "output": tmp_path / "out.usdc", "single_file": single}
    found = wc.simulate(cloth, SOLVERS["newton"], **run)
    opened = Usd.Stage.Open(str(tmp_path / "out.usdc"))
    prim = find_prim(opened, "out", None)
    reaction = UsdGeom.PrimvarsAPI(prim).GetPrimvar("reaction")
    assert reaction.GetInterpolation() == "vertex" and reaction.GetTypeName() == "float3[]"
    for frame in range(5):
        values = np.array(reaction.Get(frame))
        np.testing.assert_array_equal(values[cloth.pins.vertices], found.reactions[frame].astype(np.float32))
        assert (np.delete(values, cloth.pins.vertices, axis=0) == 0.0).all()
        for name, energies in found.energies.items():
            primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(f"energies:{name.replace(' ', '_')}")
            assert primvar.GetInterpolation() == "constant" and primvar.Get(frame) == energies[frame]
    assert "work of pins" in found.energies and "work of loads" in found.energies
    assert validate(tmp_path / "out.usdc", path if source else None) == []


@pytest.mark.host
def test_wrong_records_and_hidden_forces_are_refused():
    with pytest.raises(ValueError, match=r"^record is 'forces'; it must be some of 'energies', 'reactions', 'pairs'$"):
        wc.simulate(square(), SOLVERS["newton"], record="forces")
    with pytest.raises(ValueError, match=r"^record is 3; it must be"):
        wc.equilibrium(square(), record=3)
    hard = wc.Scene(wc.Mesh.chain(3), masses=np.ones(3), terms=[wc.Spring(stiffness=np.inf)], pins=[0])
    with pytest.raises(ValueError, match=r"^PBD has no multipliers, .*; take XPBD or ConstrainedDynamics, or a finite"):
        wc.simulate(hard, SOLVERS["pbd"], record="reactions")
    assert wc.simulate(hard, SOLVERS["pbd"], frames=2, record="energies").energies["Spring"].tolist() == [0.0] * 3
    body = wc.Scene(wc.Mesh.grid(2, 2), density=1.0, terms=[wc.RigidCluster(vertices=[[0, 1, 2, 3]])], pins=[0])
    with pytest.raises(ValueError, match=r"^XPBD has no multipliers of RigidCluster at pinned vertices"):
        wc.simulate(body, SOLVERS["xpbd"], record="reactions")


@pytest.mark.slow
def test_a_copy_of_a_batch_is_an_animation(device):
    """Of its own numbers, of which those of one copy alone are the same to rounding; and there are no others."""
    cloth = square(pins="corners", self_contact=wc.SelfContact(), colliders=[wc.Sphere(radius=0.1, position=(0.0, -3.0, 0.0))])
    solver, run = wc.XPBD(substeps=2), {"device": device, "dtype": "float64", "frames": 2, "record": (*BOTH, "pairs")}
    density = 2.0 * cloth.density
    both = wc.simulate(cloth, solver, copies=2, vary={"density": np.array([cloth.density, density])}, **run)
    one, alone = both.of_copy(1), wc.simulate(replace(cloth, density=density), solver, **run)
    assert alone.of_copy(0) is alone
    for name in ("points", "velocities", "reactions", "cuts"):
        np.testing.assert_allclose(getattr(one, name), getattr(alone, name), rtol=1e-9, atol=1e-9)
    for name in ("energies", "pairs", "collider_forces"):
        assert getattr(one, name).keys() == getattr(alone, name).keys()
        for key, values in getattr(one, name).items():
            np.testing.assert_allclose(values, getattr(alone, name)[key], rtol=1e-9, atol=1e-9)
    assert one.worst_strain == pytest.approx(alone.worst_strain) and one.cut == alone.cut
    assert one.self_contact.kept == alone.self_contact.kept
    assert (one.status.residual, one.status.frame, one.status.good.tolist()) == (alone.status.residual, 2, [2])
    assert one.status.distance == pytest.approx(alone.status.distance, rel=1e-6) and one.status.grades == alone.status.grades
    with pytest.raises(ValueError, match="copy is 2; it must be 1 or less"):
        both.of_copy(2)


def test_a_copy_of_a_batch_has_its_own_grade(device):
    """With one step and sweep a frame the stiff one ends farther than half an edge from the solution, the soft one nearer."""
    solver, run = wc.XPBD(substeps=1, iterations=1), {"device": device, "dtype": "float64", "frames": 8}
    both = wc.simulate(hanging.scene(n=16), solver, copies=2, vary={"Spring.stiffness": np.array([100.0, 1000.0])}, **run)
    assert not both.status.ok and both.status.complete
    for copy, (stiffness, usable) in enumerate([(100.0, True), (1000.0, False)]):
        found, alone = both.of_copy(copy).status, wc.simulate(hanging.scene(n=16, stiffness=stiffness), solver, **run).status
        assert found.ok is usable and (found.grade, found.grades) == (alone.grade, alone.grades)
        assert found.distance == pytest.approx(alone.distance, rel=1e-6)  # of the same steps, but for the order of sums
