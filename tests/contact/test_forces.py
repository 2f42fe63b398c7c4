"""Forces on colliders, works and heat against known answers and balances."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import trimesh

import warpcloth as wc
from support.layers import cloth
from support.rows import table
from support.scenes import incline
from warpcloth.cli import main

BOTH = ("energies", "reactions")
G, DENSITY, R = 9.81, 0.15, 1e-3
EXACT = wc.Newton(substeps=1, tolerance=1e-12, linear="factorised")
SOLVERS = {
    "explicit": wc.Explicit(substeps=80),
    "newton": wc.Newton(substeps=2, tolerance=1e-11),
    "projective dynamics": wc.ProjectiveDynamics(substeps=2, tolerance=1e-10, iterations=500),
    "xpbd": wc.XPBD(substeps=2, iterations=300),
    "admm": wc.ADMM(substeps=2, tolerance=1e-11, iterations=1000),
    "constrained dynamics": wc.ConstrainedDynamics(substeps=2, tolerance=1e-11, iterations=100, linear="factorised"),
}


def total(energies):
    """Constant but for what integrators lose: all energies and heat, less the works."""
    return sum(-values if name.startswith("work") else values for name, values in energies.items())


def balances(scene, solver, steps, device, dtype, record="energies"):
    """Runs of 11 frames with each of the numbers of steps in a frame, and the errors of their balances [J]."""
    solvers = [replace(solver, substeps=substeps) for substeps in steps]
    runs = [wc.simulate(scene, each, device=device, dtype=dtype, frames=11, record=record) for each in solvers]
    return runs, [np.abs(total(run.energies) - total(run.energies)[0]).max() for run in runs]


def rates(scene, run):
    """ΔΣp/h less the weight [N]: what pins and colliders do in each step (frames, 3)."""
    momentum = (scene.vertex_masses[:, None] * run.velocities).sum(axis=1)
    return np.diff(momentum, axis=0) * scene.fps - scene.vertex_masses.sum() * scene.gravity


@table("name", [name for name in SOLVERS if name != "explicit"], SOLVERS)
def test_a_plane_bears_the_weight(name, device):
    scene, _, _ = incline(0.0, 0.0)
    run = wc.simulate(scene, SOLVERS[name], device=device, dtype="float64", record=BOTH)
    weight = [0.0, -G * scene.vertex_masses.sum(), 0.0]
    np.testing.assert_allclose(run.collider_forces["slope"], np.tile(weight, (7, 1)), rtol=0.0, atol=1e-12)
    rest = wc.equilibrium(scene, device=device, record=BOTH)
    np.testing.assert_allclose(rest.collider_forces["slope"], weight, rtol=0.0, atol=1e-9)
    depth = 0.1 * R
    assert rest.energies["contact with slope"] == pytest.approx(0.5 * depth * G * scene.vertex_masses.sum(), rel=1e-6)
    assert run.friction_forces == {} and (run.cuts == 0.0).all()


@table("name", ["explicit", "admm"], [name for name in SOLVERS if name != "constrained dynamics"])
def test_a_slope_bears_the_weight_and_slides_by_friction(name, device):
    """N = mg cos θ and μN up the slope; the heat is μN times the way, less what the anchors store."""
    scene, normal, down = incline(30.0, 0.3, terms=[wc.Spring(stiffness=1000.0)])
    run = wc.simulate(scene, SOLVERS[name], device=device, dtype="float64", record=BOTH)
    pressed = G * scene.vertex_masses.sum() * np.sqrt(0.75)
    forces, friction = run.collider_forces["slope"][2:], run.friction_forces["slope"][2:]
    np.testing.assert_allclose(forces @ normal, -pressed, rtol=1e-6)
    np.testing.assert_allclose(friction @ down, 0.3 * pressed, rtol=1e-6)
    np.testing.assert_allclose(friction @ normal, 0.0, atol=1e-9)
    way = ((run.points[1:] - run.points[0]) @ down).mean(axis=1)
    lost = run.energies["heat of friction"] + run.energies["friction on slope"]
    np.testing.assert_allclose(np.diff(lost[1:]), 0.3 * pressed * np.diff(way), rtol=1e-4)


def pushed(friction):
    """A sheet that is held all round, and a ball that rises into it faster and faster, drifts and turns."""
    k = np.arange(12)
    position = np.stack([0.25 + 0.002 * k, 0.0015 * k**1.5 - 0.106, 0.23 + 0.0 * k], axis=1)
    rotation = np.stack([0.0 * k, np.sin(0.01 * k), 0.0 * k, np.cos(0.01 * k)], axis=1)
    ball = wc.Sphere(radius=0.1, position=position, rotation=rotation, friction=friction, name="ball")
    fields = {"density": 1.0, "pins": "boundary", "gravity": (0.0, -1.0, 0.0), "stiffness": 4.0}
    contact = wc.Contact(distance=6e-3, stiffness=2e4)
    return cloth(wc.Mesh.grid(6, 6, size=0.5), colliders=[ball], contact=contact, **fields)


def swelling(friction):
    """A sheet over a box of triangles that grows, leans and rises."""
    cube, k = trimesh.creation.box((0.2, 0.2, 0.2)), np.arange(12)[:, None]
    corners, top = cube.vertices, cube.vertices[:, 1] > 0.0
    points = corners * np.stack([1.0 + 0.004 * k, 1.0 + 0.0 * k, 1.0 - 0.003 * k], axis=-1) + [0.25, -0.106, 0.23]
    points[..., 0] += 0.002 * k
    points[:, top, 1] += 0.0015 * k**1.5
    points[:, top, 0] += 0.001 * k
    return replace(pushed(friction), colliders=[wc.MeshCollider(points, cube.faces, friction=friction, name="ball")])


# The factor by which the error of the balance falls with half the step.
ORDERS = {
    "explicit": (wc.Explicit(substeps=1), 2),
    "newton": (wc.Newton(substeps=1, tolerance=1e-9), 2),
    "newton midpoint": (wc.Newton(substeps=1, integrator="midpoint", tolerance=1e-9), 4),
    "newton bdf2": (wc.Newton(substeps=1, integrator="bdf2", tolerance=1e-9), 4),
    "xpbd": (wc.XPBD(substeps=1, iterations=30), 2),
}


# In explicit steps the filter of pairs moves cloth over a swelling mesh, and records no work.
@table(
    "scene, name, friction",
    [(pushed, "newton midpoint", 0.4), (swelling, "newton", 0.4)],
    [*product([pushed], ORDERS, (0.0, 0.4)), (swelling, "newton", 0.4), (swelling, "xpbd", 0.4)],
)
def test_work_of_colliders_is_the_change_of_energy_to_the_order_of_the_scheme(scene, name, friction, device):
    """With friction too, of which the heat is counted; below 1e-4 of the work midpoint has no order any more."""
    solver, order = ORDERS[name]
    steps = (64, 128) if scene is swelling else (32, 64)
    runs, gaps = balances(scene(friction), solver, steps, device, "float64", record=BOTH)
    energies = runs[1].energies
    work = np.abs(energies["work of colliders"]).max()
    assert gaps[1] < max(gaps[0] / (0.85 * order), 1e-4 * work) and gaps[1] < 0.05 * work and work > 5e-3
    assert not friction or energies["heat of friction"][-1] > 0.1 * work
    assert runs[1].cut == 0.0


def beads(masses, positions, colliders, stiffness, **fields):
    """Vertices that nothing but contact acts on."""
    contact = wc.Contact(distance=R, stiffness=stiffness)
    fields = {"positions": positions, "colliders": colliders, "contact": contact, "gravity": (0.0, 0.0, 0.0), **fields}
    return wc.Scene(wc.Mesh.chain(len(masses)), masses=masses, **fields)


@pytest.mark.parametrize("name", ["newton", "xpbd"])
def test_a_collider_that_jumps_does_the_work_that_the_cloth_gets(name, device):
    """Of 5.1 m in a step it pushes for the last 0.1 m: by m v/h, 0 at first, it does ½ m v² to r over this way."""
    jumping = wc.Plane(position=[[0.0, -5.0, 0.0], [0.0, -5.0, 0.0], [0.0, 0.1, 0.0]])
    scene = beads([1.0, 2.0], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [jumping], 1e9)
    solver = replace(SOLVERS[name], substeps=1)
    energies = wc.simulate(scene, solver, device=device, dtype="float64", frames=4, record="energies").energies
    np.testing.assert_allclose(energies["work of colliders"][2:], energies["kinetic"][2:], rtol=R / 0.1)
    assert energies["kinetic"][2] == pytest.approx(1.5 * (0.1 * scene.fps) ** 2, rel=2.0 * R / 0.1)


FILTERED = {"explicit": wc.Explicit(substeps=1), "midpoint": wc.Newton(substeps=1, integrator="midpoint")}
FILTERED |= {"pbd": wc.PBD(substeps=1)}


@pytest.mark.parametrize("tilt", [0.0, 0.5])
@pytest.mark.parametrize("solver", FILTERED.values(), ids=FILTERED)
def test_the_filter_takes_the_energy_of_what_it_stops(solver, tilt, device):
    """Of beads at a floor ½mv², of those that it leaves r/10 above it all; of one that slides on, what is normal to a slope."""
    normal, masses = np.array([np.sin(tilt), np.cos(tilt), 0.0]), np.array([1.0, 2.0, 3.0])
    start = np.array([[0.0, 1.0, 0.0], [1.0, 2.0, 0.0], [2.0, 1.5, 0.0]])
    v = np.array([[0.0, -50.0, 0.0], [3.0, -80.0, 1.0], [4.0, -60.0, 0.0]])
    scene = beads(masses, start, [wc.Plane(normal=normal, position=-2.0 * normal)], 1e-9, velocities=v)
    energies = wc.simulate(scene, solver, device=device, dtype="float64", frames=12, record="energies").energies
    before, stopped = 0.5 * masses @ (v**2).sum(axis=1), 0.5 * masses @ (v @ normal) ** 2
    assert energies["kinetic"][-1] == pytest.approx(before - stopped, rel=1e-6)
    assert energies["work of the filter"][-1] == pytest.approx(-stopped, rel=1e-6)
    np.testing.assert_allclose(total(energies), total(energies)[0], rtol=1e-8)  # of the tolerance of Newton's method


def jumping(friction=0.0):
    """A hanging sheet, and a collider that jumps by centimetres in each frame."""
    jumps = np.random.default_rng(1).normal(scale=0.03, size=(12, 3))
    jumps[0] = 0.0
    position = np.array([0.25, -0.106, 0.23]) + np.cumsum(jumps, axis=0)
    ball = wc.Sphere(radius=0.1, position=position, friction=friction)
    contact = wc.Contact(distance=R, stiffness=10.0 * DENSITY * G / R)
    return cloth(wc.Mesh.grid(8, 8, size=0.5), colliders=[ball], contact=contact, pins="corners")


@pytest.mark.parametrize(("friction", "dtype"), ((0.0, "float64"), (0.3, "float32")))
def test_works_balance_with_cuts_too_to_the_order_of_the_scheme(friction, dtype, device):
    """Nearly all that explicit steps get is of the filter; a box, whose edges cut often, needs shorter steps."""
    runs, gaps = balances(jumping(friction), wc.Explicit(substeps=1), (64, 128), device, dtype)
    of_filter = np.abs(runs[1].energies["work of the filter"]).max()
    assert runs[1].cut > 1e-3 and of_filter > 0.01 and gaps[1] < 0.7 * gaps[0] and gaps[1] < 0.1 * of_filter


def test_steps_that_do_not_converge_have_works_of_the_same_size(device):
    """ADMM leaves vertices so deep inside that ∇U there, times the way of the ball, is 10 000 times the work of the ball."""
    found = []
    for solver in (wc.Newton(substeps=4), wc.ADMM(substeps=4, iterations=10)):
        run = wc.simulate(jumping(), solver, device=device, dtype="float64", frames=11, record="energies")
        found.append(run.energies["work of colliders"][-1] + run.energies["work of the filter"][-1])
    assert "used up" in run.status.message and found[1] == pytest.approx(found[0], rel=0.5)


def test_forces_of_an_implicit_step_balance_its_momentum(device):
    """Of pins and a ball together, where the ball takes no friction, which is of another N than that of the step."""
    scene = pushed(0.0)
    run = wc.simulate(scene, EXACT, device=device, dtype="float64", frames=11, record="reactions")
    found = run.reactions.sum(axis=1) - run.collider_forces["ball"]
    np.testing.assert_allclose(found[1:], rates(scene, run), atol=1e-9)
    assert np.abs(run.collider_forces["ball"]).max() > 0.1


def test_a_roller_and_a_plane_share_the_weight(device):
    """A vertex that is held at 0.4 r, by contact pushed up and pressed down by its pin, at rest and as the others swing."""
    scene, _, _ = incline(0.0, 0.0)
    positions = scene.positions + np.eye(9, 1) * [0.0, -0.5 * R, 0.0]
    scene = replace(scene, positions=positions, pins=wc.Pins([0], axes="y"))
    weight = G * scene.vertex_masses.sum()
    rest = wc.equilibrium(scene, device=device, tolerance=1e-11, record="reactions")
    assert rest.reactions[0, 1] < -0.1 * weight
    assert rest.reactions[0, 1] - rest.collider_forces["slope"][1] == pytest.approx(weight, rel=1e-12)
    run = wc.simulate(scene, EXACT, device=device, dtype="float64", record="reactions")
    found = run.reactions.sum(axis=1) - run.collider_forces["slope"]
    np.testing.assert_allclose(found[1:], rates(scene, run), atol=1e-12)


def test_hard_contact_bears_the_weight_by_its_multipliers(device):
    scene, _, _ = incline(0.0, 0.0, contact=wc.Contact(distance=R, stiffness=np.inf), duration=0.4)
    forces = wc.simulate(scene, SOLVERS["xpbd"], device=device, dtype="float64", record="reactions").collider_forces["slope"]
    assert np.isnan(forces[0]).all()
    np.testing.assert_allclose(forces[-1], [0.0, -G * scene.vertex_masses.sum(), 0.0], rtol=0.0, atol=1e-12)
    with pytest.raises(ValueError, match="PBD has no multipliers"):
        wc.simulate(scene, wc.PBD(substeps=2), device=device, record="reactions")


def test_copies_have_forces_of_their_own(device):
    """And of two balls of one name, of which the second is far away; threads leave them as they are."""
    scene, solver = pushed(0.4), wc.Newton(substeps=4)
    scene = replace(scene, colliders=[*scene.colliders, wc.Sphere(radius=0.1, position=(0.0, 5.0, 0.0), name="ball")])
    run = {"device": device, "dtype": "float64", "frames": 4, "record": BOTH}
    alone = wc.simulate(scene, solver, **run)
    for threads in (1, 2) if device == "cpu" else (1,):
        batch = wc.simulate(scene, solver, copies=2, **run, threads=threads)
        assert list(batch.collider_forces) == ["ball", "ball 2"] and list(batch.friction_forces) == ["ball"]
        assert (batch.collider_forces["ball 2"] == 0.0).all() and batch.cuts.shape == (5, 2)
        found = batch.collider_forces | batch.energies
        for name, values in (alone.collider_forces | alone.energies).items():
            both = np.stack([values, values], axis=1)
            np.testing.assert_allclose(found[name], both, rtol=0.0, atol=1e-9, err_msg=name)
    assert list(alone.energies) == [
        *("Spring", "QuadraticBending", "contact with ball", "friction on ball", "contact with ball 2"),
        *("kinetic", "gravity", "work of colliders", "work of the filter", "heat of friction"),
    ]


def test_an_equilibrium_has_moved_colliders_where_they_stand_last(device):
    """As it has pins and loads; cloth must start outside of them there."""
    scene = pushed(0.0)
    last = replace(scene, colliders=[scene.colliders[0].at_last()], positions=scene.positions + np.array([0.0, 0.1, 0.0]))
    moved = replace(scene, positions=last.positions, gravity=(0.0, -9.81, 0.0))
    rests = [wc.equilibrium(each, device=device, record=BOTH) for each in (moved, replace(moved, colliders=last.colliders))]
    assert (rests[0].points == rests[1].points).all() and rests[0].stable
    weight = 9.81 * scene.vertex_masses.sum()
    borne = rests[0].reactions.sum(axis=0) - rests[0].collider_forces["ball"]
    np.testing.assert_allclose(borne, [0.0, weight, 0.0], atol=1e-6)
    with pytest.raises(ValueError, match=r"^where the last keyframe has the colliders, vertex \d+ starts .* inside"):
        wc.equilibrium(scene)


def test_a_run_writes_them(tmp_path, monkeypatch, capsys, device):
    """In the table and the report, and as primvars of the cloth."""
    from pxr import Usd, UsdGeom

    monkeypatch.chdir(tmp_path)
    options = "-p n=4 duration=0.1 -s substeps=2 --frames 4 -o a.usda --csv a.csv --report a.json --dtype float64".split()
    assert main(["run", "incline", "--solver", "newton", *options, "--device", device]) == 0
    assert "cut short     0 %" in capsys.readouterr().out
    header, *rows = (line.split(",") for line in (tmp_path / "a.csv").read_text().splitlines())
    table = {name: np.array([float(row[k] or "nan") for row in rows]) for k, name in enumerate(header)}
    assert header[-7:] == [f"{what} on slope {axis}" for what in ("force", "friction") for axis in "xyz"] + ["cut short"]
    stage = Usd.Stage.Open("a.usda")
    cloth = next(UsdGeom.PrimvarsAPI(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    for what, kind in (("force", "collider_forces"), ("friction", "friction_forces")):
        primvar = cloth.GetPrimvar(f"{kind}:slope")
        assert primvar.GetInterpolation() == "constant"
        found = np.array([primvar.Get(frame) for frame in range(5)])
        np.testing.assert_allclose(found, np.stack([table[f"{what} on slope {axis}"] for axis in "xyz"], axis=1), atol=1e-8)
    heat = [cloth.GetPrimvar("energies:heat_of_friction").Get(frame) for frame in range(5)]
    np.testing.assert_allclose(heat, table["heat of friction"], rtol=1e-6, atol=1e-12)
    assert table["force on slope y"][-1] < -0.01


@pytest.mark.parametrize("integrator", ("euler", "midpoint"))
def test_heat_on_a_mesh_is_that_on_a_plane(integrator):
    """Of a belt that carries a sheet away; Euler's trapezoidal rule on the plane takes half of the first step for rest."""
    corners = [[-2.0, 0.0, -2.0], [-2.0, 0.0, 2.0], [2.0, 0.0, 2.0], [2.0, 0.0, -2.0]]
    moving = {"position": [(0.03 * k, -0.0009, 0.0) for k in range(7)], "friction": 0.3}
    solver, heats = wc.Newton(substeps=8, tolerance=1e-7, integrator=integrator), []
    fields = {"terms": [wc.Spring(stiffness=100.0)], "duration": 0.25, "fps": 24.0}
    for belt in (wc.MeshCollider(corners, [[0, 1, 2], [0, 2, 3]], **moving), wc.Plane(**moving)):
        contact = wc.Contact(distance=R, stiffness=1.5e4)
        scene = cloth(wc.Mesh.grid(4, 4, size=0.5), colliders=[belt], contact=contact, **fields)
        heats.append(wc.simulate(scene, solver, dtype="float64", record="energies").energies["heat of friction"][-1])
    assert heats[0] == pytest.approx(heats[1], rel=0.03) and heats[1] > 1e-3
