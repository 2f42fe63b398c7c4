"""Tests forces, tractions and pressures against gravity, impulses, closed forms and virtual work, with every solver."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import warpcloth as wc
from support import setups
from support.energies import energy_and_gradient
from support.layers import positions
from support.rows import table
from support.setups import MAIN, allocated, square
from support.steps import after_frames

SOLVERS = {name: replace(solver, substeps=8) for name, solver in setups.SOLVERS.items()}
NONE = (0.0, 0.0, 0.0)


@table("name", ("explicit", "newton midpoint", "xpbd"), [*MAIN, "newton midpoint", "newton bdf2"])
def test_forces_in_proportion_to_masses_are_gravity(name, device):
    """Residuals are relative to it or to the forces over the masses, which is the same; the rest is rounding."""
    down = square(solver=SOLVERS[name], pins="corners")
    loaded = replace(down, gravity=NONE, loads=[wc.Force(vertices="all", force=down.vertex_masses[:, None] * down.gravity)])
    run = {"device": device, "dtype": "float64", "frames": 5}
    ends = [wc.simulate(each, SOLVERS[name], **run) for each in (down, loaded)]
    np.testing.assert_allclose(ends[1].points, ends[0].points, rtol=0.0, atol=1e-10)
    assert ends[1].status.ok == ends[0].status.ok  # rounding decides where a step stops


# Where in a step its forces are taken, in steps.
TAKEN = {
    "explicit": (wc.Explicit(substeps=4), 0.0),
    "newton": (wc.Newton(substeps=4), 1.0),
    "midpoint": (wc.Newton(substeps=4, integrator="midpoint"), 0.5),
    "pbd": (wc.PBD(substeps=4), 1.0),
    "xpbd": (wc.XPBD(substeps=4), 1.0),
}
PULSE = np.array([[0.0, 0.0, 0.0], [0.3, -1.0, 0.2], [1.0, 2.0, -0.5], [0.25, 0.0, 0.0]])


def pushed(keyframes=PULSE):
    """Two masses of 0.5 kg on which the same forces act, so that their spring stays at rest."""
    push = wc.Force(vertices=[1, 0], keyframes=keyframes)
    return wc.Scene(wc.Mesh.chain(2), masses=[0.5, 0.5], terms=[wc.Spring(stiffness=1.0)], gravity=NONE, loads=[push])


@pytest.mark.parametrize("name", TAKEN)
def test_keyframes_of_forces_are_impulses(name, device):
    """Linear between keyframes and constant after the last: v = Σ h f(t + c h)/m. Their work is Σ f·Δx."""
    # Where a step takes its forces at its end, f is the mean of both ends, so that the work is of second order.
    solver, ahead = TAKEN[name]
    run = wc.simulate(pushed(), solver, device=device, dtype="float64", frames=5, record="energies")

    def forces(ahead):
        return np.stack([np.interp((np.arange(20) + ahead) / 4, np.arange(4), axis) for axis in PULSE.T], axis=1)

    v = np.cumsum(forces(ahead), axis=0) / 240.0 / 0.5
    np.testing.assert_allclose(run.velocities[-1], np.tile(v[-1], (2, 1)), atol=1e-13)
    assert run.status.ok
    over = 0.5 * (forces(0.0) + forces(1.0)) if ahead == 1.0 else forces(ahead)
    moved = (v if ahead != 0.5 else v - 0.5 * np.diff(v, axis=0, prepend=0.0)) / 240.0
    work = np.append(0.0, 2.0 * np.cumsum((over * moved).sum(axis=1))[3::4])  # of both masses, after each frame
    np.testing.assert_allclose(run.energies["work of loads"], work, atol=1e-13)


def test_bdf2_takes_keyframes_of_forces_to_second_order(device):
    errors = []
    for substeps in (8, 16):
        run = wc.simulate(pushed(), wc.Newton(substeps=substeps, integrator="bdf2"), device=device, dtype="float64", frames=5)
        exact = np.trapezoid(np.concatenate([PULSE, PULSE[-1:], PULSE[-1:]]), dx=1 / 60, axis=0) / 0.5
        errors.append(np.abs(run.velocities[-1] - exact).max())
    assert errors[1] < errors[0] / 3.5 < 1e-3


def strip(n=9):
    """A corotated membrane of 1000 N/m, 0.5 m × 1 m, on rollers at x = 0 and in its plane."""
    mesh = wc.Mesh.grid(n, 5, size=(0.5, 1.0), pattern="alternating")
    axes = ["xyz" if i == 0 else "xy" if x == 0.0 else "y" for i, x in enumerate(mesh.points[:, 0])]
    pins = wc.Pins("all", axes=axes)
    return wc.Scene(mesh, density=0.1, terms=[wc.CorotatedMembrane(stiffness=1e3)], pins=pins, gravity=NONE)


@pytest.mark.parametrize("keyframes", [False, True])
def test_a_traction_strains_a_strip_by_its_ratio_to_the_stiffness(keyframes, device):
    """Of a corotated membrane P = k(F − R), so that ε = T/k along the pull and 0 across, at each vertex."""
    pull = {"keyframes": [NONE, (50.0, 0.0, 0.0)]} if keyframes else {"traction": (50.0, 0.0, 0.0)}
    loaded = replace(strip(), loads=[wc.Traction(vertices="x == 0.5", **pull)])
    rest = wc.equilibrium(loaded, device=device, tolerance=1e-12)
    np.testing.assert_allclose(rest.points, loaded.mesh.points * [1.05, 1.0, 1.0], rtol=0.0, atol=1e-10)
    assert rest.stable


@pytest.mark.filterwarnings("ignore:.* encountered in:RuntimeWarning")
def test_a_pressure_that_bursts_a_sheet_has_no_rest_shape(device):
    """The tension of stretched springs grows with their length, as the force of the pressure does; with 1000 Pa that wins."""
    sheet = wc.Mesh.grid(9, 9, pattern="alternating")
    given = {"density": 0.1, "terms": [wc.Spring(stiffness=100.0)], "pins": "boundary", "gravity": NONE}
    loads = [[wc.Pressure(vertices="all", pressure=p)] for p in (200.0, 1000.0)]
    held, burst = (wc.equilibrium(wc.Scene(sheet, loads=each, **given), device=device) for each in loads)
    assert held.status.ok and held.points[:, 1].max() > 0.3 and not burst.status.ok and not burst.stable


def test_a_balloon_balances_its_pressure(device):
    """At rest p δV = δU of any move: x·∇U = 3 p V of a growth, and p ∂V/∂x = ∂U/∂x at each vertex."""
    ball, terms = trimesh.creation.icosphere(subdivisions=2, radius=0.1), [wc.NeoHookeanMembrane(stiffness=500.0)]
    fields = {"loads": [wc.Pressure(vertices="all", pressure=400.0)], "gravity": NONE, "pins": [0]}
    scene = wc.Scene(wc.Mesh(ball.vertices, ball.faces), density=0.1, terms=terms, **fields)
    rest = wc.equilibrium(scene, device=device, tolerance=1e-10)
    assert rest.status.ok
    a, b, c = np.moveaxis(rest.points[scene.mesh.triangles], 1, 0)
    slopes = np.zeros_like(rest.points)
    for corner, slope in zip(scene.mesh.triangles.T, (np.cross(b, c), np.cross(c, a), np.cross(a, b)), strict=True):
        np.add.at(slopes, corner, slope / 6.0)
    _, stress = energy_and_gradient(replace(scene, loads=()).build(device=device, dtype="float64"), rest.points)
    volume = (a * np.cross(b, c)).sum() / 6.0
    assert volume > 1.05 * 4.0 / 3.0 * np.pi * 0.1**3
    np.testing.assert_allclose(stress, 400.0 * slopes, rtol=0.0, atol=1e-6 * np.abs(400.0 * slopes).max())
    assert (rest.points * stress).sum() == pytest.approx(3.0 * 400.0 * volume, rel=1e-7)


def sail():
    """A sheet that is pinned by two corners and blown by a pressure that rises and falls."""
    terms = [wc.Spring(pairs=("structural", "shear"), stiffness=50.0)]
    wind = wc.Pressure(vertices="all", keyframes=[0.0, 10.0, 20.0, 5.0, -10.0])
    return wc.Scene(wc.Mesh.grid(5, 5, pattern="alternating"), density=0.2, terms=terms, pins=[0, 4], loads=[wind], fps=30.0)


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("midpoint", 2), ("bdf2", 2)])
def test_pressure_keeps_the_order_of_the_integrator(integrator, order, device):
    def end(substeps, integrator):
        solver = wc.Newton(substeps=substeps, integrator=integrator, tolerance=1e-10, linear="factorised")
        return wc.simulate(sail(), solver, device=device, dtype="float64", frames=5).points[-1]

    exact = end(128, "midpoint")
    errors = [np.abs(end(substeps, integrator) - exact).max() for substeps in (8, 16)]
    assert errors[1] < errors[0] / 2 ** (order - 0.25)


@pytest.mark.parametrize("name", ["explicit", "newton", "xpbd"])
def test_loads_vary_in_a_batch(name, device):
    """Each copy as alone, in another order of vertices and by two threads too."""
    solver, scene = SOLVERS[name], sail()
    pull = wc.Force(vertices=[24], force=(0.0, 0.1, 0.0), name="pull")
    scene = replace(scene, loads=[*scene.loads, pull])
    keyframes = np.array([[0.0, 10.0, 20.0], [5.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    forces = np.array([[0.0, 0.1, 0.0], [0.2, 0.0, 0.0], [0.0, 0.0, 0.3]])
    vary = {"Pressure.keyframes": keyframes, "pull.force": forces}
    run = {"device": device, "dtype": "float64", "frames": 4}
    batch = wc.simulate(scene, solver, copies=3, vary=vary, **run).points
    for copy in range(3):
        loads = [replace(scene.loads[0], keyframes=keyframes[copy]), replace(pull, force=forces[copy])]
        alone = wc.simulate(replace(scene, loads=loads), solver, **run).points
        np.testing.assert_allclose(batch[:, copy], alone, rtol=0.0, atol=1e-11)
    if name != "xpbd":  # whose sweeps go in the order of elements
        order = {"copies": 3, "vary": vary, "order": np.arange(25)[::-1]}
        stepper = after_frames(scene, solver, 4, device=device, dtype="float64", **order)
        found = stepper.model.in_scene_order(stepper.state.x.numpy()).reshape(3, 25, 3)
        np.testing.assert_allclose(found, batch[-1], rtol=0.0, atol=1e-9)
    if device == "cpu":
        shared = wc.simulate(scene, solver, copies=3, vary=vary, threads=2, **run).points
        assert (shared == batch).all()


@pytest.mark.parametrize("name", ["explicit", "newton", "xpbd"])
def test_steps_with_loads_allocate_nothing(name, device):
    stepper = after_frames(sail(), SOLVERS[name], steps=1, device=device, dtype="float64")
    assert allocated(lambda: [stepper.step() for _ in range(10)], device) == 0


@pytest.mark.parametrize("name", ["explicit", "newton midpoint", "xpbd"])
def test_a_reset_and_a_copied_state_start_loads_again(name, device):
    stepper = after_frames(sail(), SOLVERS[name], 3, device=device, dtype="float64")
    first = stepper.state.x.numpy().copy()
    stepper.reset()
    assert (list(positions(stepper, 3))[-1] == first).all()


@pytest.mark.parametrize("name", ["explicit", "newton"])
def test_what_loads_drive_has_not_diverged(name, device):
    """A sheet that nothing holds is blown away; with steps above the limit it is still noticed."""
    push = wc.Force(vertices="all", force=(0.0, 0.0, 0.5))
    blown = replace(sail(), pins=None, gravity=NONE, loads=[push, wc.Pressure(vertices="all", pressure=30.0)], duration=2.0)
    assert wc.simulate(blown, SOLVERS[name], device=device).status.ok
    swung = np.outer(3.0 * np.sin(0.5 * np.arange(61)), [1.0, 0.0, 0.0])
    swinging = replace(sail(), loads=[wc.Force(vertices="x > 0.5", keyframes=swung)], duration=2.0)
    assert wc.simulate(swinging, SOLVERS[name]).status.ok


def test_an_exploding_run_with_loads_is_noticed(device):
    with np.errstate(all="ignore"):
        run = wc.simulate(replace(sail(), duration=2.0), wc.Explicit(substeps=1, above_limit="allow"), device=device)
    assert not run.status.ok and "diverged" in run.status.message


@pytest.mark.parametrize("name", ["explicit", "newton", "pbd"])
def test_constant_forces_cost_no_launch_and_no_loads_cost_nothing(name, device):
    """But for the plain form of explicit steps, as where coordinates are locked."""
    free = np.ones((36, 3), dtype=bool)
    free[7, 0] = False
    launches, scenes = {}, {"plain": square(), "locked": square(free_axes=free)}
    scenes["force"] = square(loads=[wc.Force(vertices=[7], force=(1.0, 0.0, 0.0))])
    scenes["pressure"] = square(loads=[wc.Pressure(vertices="all", pressure=1.0)])
    for key, scene in scenes.items():
        model = replace(scene, terms=scene.terms[:1]).build(device=device)
        stepper, before = SOLVERS[name].bind(model), model.launches[0]
        stepper.integrator.launch_prediction() if stepper.integrator else stepper.launch_steps(1)
        launches[key] = model.launches[0] - before
        assert ("set_loads" in str(model.report())) == (key in ("force", "pressure"))
        assert (model.loads is None) == (key in ("plain", "locked"))
    assert launches["force"] <= launches["locked"]


@pytest.mark.host
@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: wc.Force(vertices=[0]), "Force: exactly one of force and keyframes must be given"),
        (lambda: wc.Force(vertices=[0], force=NONE, keyframes=[NONE]), "Force: exactly one of force and keyframes"),
        (lambda: wc.Force(vertices=[0], force="up"), "Force.force is 'up', which is not numeric"),
        (lambda: wc.Force(vertices=[0], force=(0.0, np.nan, 0.0)), "Force.force[1] is nan; it must be finite"),
        (lambda: wc.Force(vertices=[0], force=NONE, name=3), "Force.name is 3; it must be a text or None"),
        (lambda: wc.Force(vertices=[99], force=NONE), "Force.vertices[0] is 99; it must lie in 0 … 35"),
        (lambda: wc.Force(vertices="x > 9", force=NONE), "Force acts on nothing, for the mesh has no such vertices"),
        (lambda: wc.Force(vertices=[0, 1], force=1.0), "Force.force has shape (); it must be (3,) or (2, 3)"),
        (lambda: wc.Force(vertices=[0, 1], keyframes=NONE), "Force.keyframes has shape (3,); it must be (F, 3) or (F, 2, 3)"),
        (lambda: wc.Traction(vertices=[0], traction=NONE), "the mesh has no edges between such vertices; leave the load out"),
        (lambda: wc.Pressure(vertices=[0, 1], pressure=1.0), "the mesh has no triangles of such vertices; leave the load out"),
        (lambda: wc.Pressure(vertices="all", pressure=[1.0, 2.0]), "Pressure.pressure has shape (2,); it must be () or (50,)"),
        (lambda: 3, "loads[0] is 3; it must be a Force, Traction or Pressure"),
    ],
)
def test_bad_loads_are_refused(make, sentence):
    with pytest.raises(ValueError) as found:
        square(loads=[make()])
    assert sentence in str(found.value)


@pytest.mark.host
def test_batches_refuse_what_they_cannot():
    scene = sail()
    with pytest.raises(ValueError, match=r"^vary\['Pressure.keyframes'\] has shape \(2,\); it must have 3 entries"):
        scene.build(copies=3, vary={"Pressure.keyframes": [1.0, 2.0]})
    with pytest.raises(ValueError, match=r"names nothing in this scene; .*Pressure.pressure, Pressure.keyframes, "):
        scene.build(copies=3, vary={"Force.force": np.zeros((3, 3))})
