"""Fitting parameters to motions: what comes back, how uncertain it is said to be, what cannot be told."""

import json

import numpy as np
import pytest

import warpcloth as wc
from warpcloth.cli import main
from warpcloth.scenes.hanging import scene as hanging

SOLVER = wc.Newton(substeps=4, integrator="midpoint", tolerance=1e-10)
FRAMES, MASS, STIFFNESS, NOISE = 30, 0.5, 40.0, 1e-3
TRUE = {"Spring.stiffness": 400.0, "QuadraticBending.stiffness": 3e-4}


def weight(k=1.0):
    """A mass on a spring, from rest."""
    terms = [wc.Spring(stiffness=k)]
    return wc.Scene(wc.Mesh.chain(2), masses=[1.0, MASS], terms=terms, pins=[0], duration=FRAMES / 60.0)


def sheet(k, D):
    mesh = wc.Mesh.grid(4, 4, size=0.5, pattern="alternating")
    terms = [wc.Spring(stiffness=k), wc.QuadraticBending(stiffness=D)]
    return wc.Scene(mesh, density=0.1, terms=terms, pins="corners and z == 0", duration=0.3)


def motion(scene, device="cpu"):
    """Positions at frames 1 … F, (F, n, 3)."""
    found = wc.simulate(scene, SOLVER, device=device, dtype="float64")
    return np.array([found.points[frame] for frame in range(1, scene.frames + 1)])


def test_it_finds_the_parameters_of_a_motion(device):
    """Without noise, and without a third of the numbers: to 1e-6, from half the k and a sixth of the D."""
    seen = motion(sheet(*TRUE.values()), device)
    seen[np.random.default_rng(0).uniform(size=seen.shape) < 1 / 3] = np.nan
    start = {"Spring.stiffness": 200.0, "QuadraticBending.stiffness": 5e-5}
    found = wc.fit(sheet(1.0, 1.0), SOLVER, start, seen, device=device)
    assert found.parameters == pytest.approx(TRUE, rel=1e-6)
    assert found.residual < 1e-9 and found.runs < 15


def expected_error():
    """σ of ln k by the motion z = (mg/k)(1 − cos ωt), ω² = k/m, at all frames."""
    t, rest, omega = np.arange(1, FRAMES + 1) / 60.0, MASS * 9.81 / STIFFNESS, np.sqrt(STIFFNESS / MASS)
    slope = -rest * (1.0 - np.cos(omega * t)) + 0.5 * rest * omega * t * np.sin(omega * t)
    return NOISE / np.linalg.norm(slope)


def noisy(seen, seed):
    return wc.fit(
        weight(),
        SOLVER,
        {"Spring.stiffness": 0.8 * STIFFNESS},
        seen + np.random.default_rng(seed).normal(scale=NOISE, size=seen.shape),
        [1],
    )


def test_errors_are_those_of_the_closed_form():
    """s estimates the noise from 90 numbers, to 1/√180; the estimate is within 4 σ."""
    found = noisy(motion(weight(STIFFNESS))[:, 1:], 0)
    assert found.residual == pytest.approx(NOISE, rel=4.0 / np.sqrt(180.0))
    assert found.errors["Spring.stiffness"] == pytest.approx(expected_error(), rel=0.3)
    assert abs(np.log(found.parameters["Spring.stiffness"] / STIFFNESS)) < 4.0 * expected_error()
    low, high = found.intervals["Spring.stiffness"]
    assert low < found.parameters["Spring.stiffness"] < high


def test_what_the_motion_does_not_tell_has_no_error():
    """Of two springs side by side only the sum."""
    terms = [wc.Spring(name=name, stiffness=1.0) for name in ("one", "other")]
    scene = wc.Scene(wc.Mesh.chain(2), masses=[1.0, MASS], terms=terms, pins=[0], duration=FRAMES / 60.0)
    found = wc.fit(scene, SOLVER, {"one.stiffness": 10.0, "other.stiffness": 25.0}, motion(weight(STIFFNESS))[:, 1:], [1])
    assert sum(found.parameters.values()) == pytest.approx(STIFFNESS, rel=1e-5)
    assert all(error == np.inf for error in found.errors.values()) and np.isnan(found.correlation).all()


def test_the_command_reads_a_file_by_its_times(tmp_path, capsys):
    """It uses the frames of the file at the times of frames of the scene, here the even ones, and no others."""
    scene = hanging(n=4)
    points = wc.simulate(scene, SOLVER, frames=6, dtype="float64").points
    times = np.array([0, 2, 3.5, 4, 6]) / scene.fps
    shown = [points[0], points[2], points[0], points[4], points[6]]
    np.savez(tmp_path / "seen.npz", points=shown, triangles=scene.mesh.triangles, times=times)
    words = ["fit", "hanging", str(tmp_path / "seen.npz"), "-p", "n=4", "--start", "Spring.stiffness=700"]
    words += ["-s", "substeps=4", "integrator=midpoint", "tolerance=1e-10", "--plot", str(tmp_path / "residuals.png")]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["parameters"]["Spring.stiffness"] == pytest.approx(1000.0, rel=1e-6)
    assert [value == "nan" for value in found["residuals"]] == [True, False, True, False, True, False]
    assert (tmp_path / "residuals.png").stat().st_size
    assert main([*words, "--frames", "1"]) == 2
    assert "none at the time of a frame of the scene" in capsys.readouterr().err
    assert main([*words, "--vertices", "x < 0.5"]) == 2
    assert "seen.npz: has 16 vertices; it must have 8, one for each of 'vertices'" in capsys.readouterr().err


SEEN = np.zeros((3, 2, 3))


@pytest.mark.parametrize(
    ("start", "seen", "sentence"),
    [
        ({}, SEEN, "start is {}; it must be a dict of parameters"),
        ({"Spring.stiffness": 0.0}, SEEN, r"start\['Spring.stiffness'\] is 0.0; it must be a finite number above 0"),
        ({"Spring.stiffness": 1.0}, SEEN[:, :1], r"measured has shape \(3, 1, 3\); it must be \(F, 2, 3\)"),
        ({"Spring.stiffness": 1.0}, np.full((3, 2, 3), np.nan), "measured has 0 numbers; it must have at least 1"),
        ({"Spring.stifness": 1.0}, SEEN, r"vary\['Spring.stifness'\] names nothing in this scene"),
    ],
)
def test_refusals(start, seen, sentence):
    with pytest.raises(ValueError, match=sentence):
        wc.fit(weight(), SOLVER, start, seen)
