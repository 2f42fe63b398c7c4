"""Scenes in pyPBD: arrays, motion against the same energies here, refusals, and stiffness by samples."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import warpcloth as wc
from support.others import MASSES, MESH, SPRINGS, declared
from warpcloth.lab.campaign import Store
from warpcloth.lab.choosing import choose
from warpcloth.lab.measurements import SceneRef
from warpcloth.lab.work_precision import time_diagram
from warpcloth.others.pbd_calibration import calibrate
from warpcloth.others.pbd_model import METHODS, frame_of, pbd_model
from warpcloth.others.pbd_runs import PbdSteps, PositionBasedDynamics
from warpcloth.others.runs import run_other
from warpcloth.others.simulators import SIMULATORS

pytest.importorskip("pypbd", reason="pyPBD is not installed: pip install -e '.[pbd]'")


@pytest.mark.parametrize("gravity", [(0.0, -9.81, 0.0), (1.0, -2.0, 3.0)])
def test_arrays_are_those_of_the_scene(gravity):
    """To the bit, unless gravity turns them; time is scaled so that gravity is 9.81 m/s² there."""
    rng = np.random.default_rng(0)
    positions, velocities = MESH.points + 0.1 * rng.random((16, 3)), rng.random((16, 3))
    pairs = SPRINGS.stencil(MESH)
    springs = wc.Spring(pairs=pairs, stiffness=1.0 + rng.random(len(pairs)), rest_lengths=0.3 + rng.random(len(pairs)))
    hard = wc.Spring(pairs=[[0, 5]], stiffness=np.inf, name="hard")
    scene = declared(positions=positions, velocities=velocities, terms=[springs, hard], gravity=gravity)
    steps = PbdSteps(scene, PositionBasedDynamics("xpbd", 4))
    turned = 0.0 if gravity[0] == 0.0 else 1e-15
    np.testing.assert_allclose(steps.points(), positions, rtol=0.0, atol=turned)
    np.testing.assert_allclose(steps.velocities(), velocities, rtol=4.0 * turned, atol=turned)
    particles, constraints = steps.model.getParticles(), steps.model.getConstraints()
    masses = [particles.getMass(i) for i in range(16)]
    assert masses == np.where(np.isin(np.arange(16), [0, 3]), 0.0, MASSES).tolist()
    scale = frame_of(scene.gravity)[1]
    assert [each.restLength for each in constraints] == [*springs.rest_lengths, np.linalg.norm(MESH.points[5] - MESH.points[0])]
    np.testing.assert_allclose([each.stiffness for each in constraints][:-1], springs.stiffness / scale**2, rtol=1e-15)
    assert constraints[len(pairs)].stiffness == 1.0 and type(constraints[len(pairs)]).__name__ == "DistanceConstraint"


@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.parametrize("method", METHODS)
def test_motion_converges_to_that_of_the_energies(method, iterations):
    """At first order in the step, for any number of iterations, in a direction of gravity that is not that of pyPBD."""
    scene = declared(gravity=(1.0, -2.0, 3.0))
    exact = wc.simulate(scene, wc.Explicit(substeps=1000), dtype="float64", frames=6).points
    moved = np.abs(exact[-1] - exact[0]).max()
    assert moved > 0.01
    found = [run_other(scene, PositionBasedDynamics(method, n, iterations), frames=6) for n in (20, 40)]
    assert all(run.status.ok and run.points.dtype == np.float64 for run in found) and "pyPBD 2." in found[0].status.message
    errors = [np.abs(run.points - exact).max() for run in found]
    assert errors[1] < 0.02 * moved and 1.7 < errors[0] / errors[1] < 2.3
    np.testing.assert_allclose(found[0].points[:, [0, 3]], np.broadcast_to(MESH.points[[0, 3]], (7, 2, 3)), atol=1e-15)


def test_membranes_have_the_shear_and_stretch_of_the_corotated_energy():
    """Vertices that a small strain F moves to, all but one held, begin with the same acceleration, whatever the triangle."""
    mesh = wc.Mesh([[0, 0, 0], [1, 0.3, 0], [0.3, 0.8, 0.5]], [[0, 1, 2]])
    strain = np.array([[3.0, 1.0, 0.0], [1.0, -2.0, 4.0], [0.0, 4.0, 1.0]]) * 1e-5
    given = {"masses": np.ones(3), "positions": mesh.points + mesh.points @ strain}
    given |= {"terms": [wc.CorotatedMembrane(stiffness=1e6)], "pins": [0], "gravity": (0.0, -1e-9, 0.0), "fps": 1e6}
    given |= {"duration": 1e-6}
    scene = wc.Scene(mesh, **given)
    runs = [wc.simulate(scene, wc.Explicit(substeps=1), dtype="float64", frames=1)]
    runs.append(run_other(scene, PositionBasedDynamics("pbd", 1), frames=1))
    ours, found = (run.velocities[1] * 1e6 for run in runs)
    assert np.abs(ours).max() > 5.0
    np.testing.assert_allclose(found, ours, rtol=0.0, atol=1e-4 * np.abs(ours).max())


def test_methods_and_devices_that_it_has_not_are_refused():
    with pytest.raises(ValueError, match="method is 'fem'; it must be one of pbd, xpbd"):
        pbd_model(declared(), "fem", 0.01)
    with pytest.raises(ValueError, match="pyPBD has the CPU only"):
        PositionBasedDynamics("pbd", 1).bind(declared(), "cuda:0")


@pytest.mark.parametrize(("method", "iterations"), [("xpbd", 1), pytest.param("pbd", 3, marks=pytest.mark.slow)])
def test_samples_are_as_stiff_there(method, iterations):
    """Within 1 %: a strip of springs, one of a membrane, and a cantilever, at rest."""
    assert list(calibrate(method, iterations)) == pytest.approx([1.0] * 3, abs=0.01)


def test_charts_and_choices_have_its_solvers(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path / "cache"))
    one = SIMULATORS["pbd"].solvers["pypbd-xpbd"]._replace(runs=({"substeps": 20, "iterations": 1},))
    monkeypatch.setitem(SIMULATORS, "pbd", SIMULATORS["pbd"]._replace(solvers={"pypbd-xpbd": one}))
    scene, given = SceneRef("hanging", {"n": 4, "bending": 1e-4}), {"frames": 6, "others": ["pbd"], "solvers": ["explicit"]}
    with ThreadPoolExecutor(1) as executor:
        given |= {"executor": executor, "store": Store()}
        found = time_diagram(scene, limit=30.0, **given)
        choice, measured, _exact = choose(scene, tolerance=0.05, **given)
    row = next(row for row in found["rows"] if row["solver"] == "pypbd-xpbd")
    assert row["status"] == "ok" and 0.0 < row["error"] < 0.02 and found["machine"]["pbd"].startswith("2.")
    assert choice.meets and {each.setup.solver for each in measured} == {"explicit", "pypbd-xpbd"}
