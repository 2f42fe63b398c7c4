"""Fitting parameters to motions and rest shapes: what comes back, how uncertain it is said to be, what cannot be told."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial import Delaunay
from scipy.stats import binomtest

import warpcloth as wc
from support.rows import slow_but
from warpcloth.cli import main
from warpcloth.lab.laboratory import drape_coefficient
from warpcloth.lab.scans import scan, write_capture
from warpcloth.mesh.mesh import Surface
from warpcloth.scenes import catenary, chain, loop
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


def captured(seed=0, noise=NOISE):
    """A sheet as a scanner sees it: other triangles in each frame, noise, and 10 % of the area in holes."""
    scene = sheet(*TRUE.values())
    frames = np.concatenate([[scene.positions], motion(scene)])
    return scan(scene.mesh, frames, 1 / scene.fps, 0.05, noise, 0.1, 0.08, seed=seed)


def test_it_fits_a_capture_whose_triangles_change(tmp_path, capsys):
    """By the distances along the normal. Both parameters are within 4 standard errors; the residual is the noise."""
    start = {"Spring.stiffness": 300.0, "QuadraticBending.stiffness": 2e-4}
    capture = captured()
    assert len({len(capture[k].points) for k in range(3)}) == 3
    found = wc.fit(sheet(1.0, 1.0), SOLVER, start, capture)
    for name, value in TRUE.items():
        assert 1e-4 < found.errors[name] < 0.1 and abs(np.log(found.parameters[name] / value)) < 4.0 * found.errors[name]
    assert found.residual == pytest.approx(NOISE, rel=4.0 / np.sqrt(2.0 * found.freedom))
    exact = wc.fit(sheet(1.0, 1.0), SOLVER, start, captured(noise=0.0))
    assert exact.parameters == pytest.approx(TRUE, rel=1e-6)
    # From files in millimetres, of fewer points, with errors that are larger accordingly.
    write_capture(capture, tmp_path / "seen", scale=1e-3)
    few = wc.CapturePoints(wc.open_capture(tmp_path / "seen", fps=60, scale=1e-3), points=40, sigma=NOISE)
    fewer = wc.fit(sheet(1.0, 1.0), SOLVER, start, few)
    assert fewer.errors["Spring.stiffness"] > 1.2 * found.errors["Spring.stiffness"] and fewer.freedom == np.inf
    # Frame 1 of another capture is not finite: what remains is fitted, and the frame is named.
    broken = [capture[k] for k in range(3)]
    lost = replace(capture, labels=capture.labels[:3], times=capture.times[:3], read=broken.__getitem__)
    broken[1] = Surface(np.full((3, 3), np.nan), [[0, 1, 2]])
    with pytest.warns(UserWarning, match="1 of 2 frames are left out, because no triangle has finite corners: 1$"):
        some = wc.CapturePoints(lost, points=1000)
        assert np.isnan(wc.fit(sheet(1.0, 1.0), SOLVER, {"Spring.stiffness": 300.0}, some).residuals).tolist() == [True, False]
    one = wc.CapturePoints(capture, points=1).bind("measured", sheet(1.0, 1.0), FRAMES)  # its size is that of all points
    assert one.frames.tolist() == list(range(len(capture) - 1))
    words = ["fit", "hanging", "-p", "n=4", "--capture", str(tmp_path / "seen"), "--start", "Spring.stiffness=700"]
    for wrong, sentence in (
        (words, "seen: has no times; open it with open_capture(path, fps=…), or give --fps on the command line"),
        ([*words, "--fps", "24", "--frames", "1"], "none at the time of a frame of the scene"),
        ([*words, "--fps", "60"], "seen: is about 670 m across, and the cloth 1.41 m; lengths must be metres, or, of mesh"),
        ([*words, "--fps", "60", "--scale", "1e-6"], "seen: is about 0.00067 m across, and the cloth 1.41 m"),
        ([*words, "--pins", "x > 7"], "--pins 'x > 7' names no vertex"),
        ([*words, "--fabric", "denin"], "fabric is 'denin'; it must be one of"),
        (["fit", "chain", *words[4:], "--fps", "60"], "seen: the mesh has no triangles to compare a capture with"),
        ([*words, "--fps", "60", "--vertices", "corners"], "--vertices is given, and the vertices of --capture are not"),
        (["fit", "hanging", "-p", "n=4", "seen.npz", *words[6:]], "'seen.npz' is not of the form name=value; MEASURED must"),
        (["fit", "hanging", "seen.npz", *words[4:]], "MEASURED and --capture are given; one of the three must be"),
        (["fit", "hanging", "seen.npz", "--points", "3", *words[6:]], "--scale and --points are for --capture"),
    ):
        assert main(wrong) == 2 and sentence in capsys.readouterr().err, wrong


def test_a_capture_of_a_rest_shape_gives_a_stiffness():
    """Of a chain of triangles that hangs aslant, from the last frame; k is that of the equilibrium that was scanned."""
    scene = sheet(40.0, 3e-4)
    rest = wc.equilibrium(scene)
    seen = scan(scene.mesh, np.array([scene.positions, rest.points]), 1.0, 0.05)
    found = wc.fit(sheet(40.0, 1.0), None, {"QuadraticBending.stiffness": 2e-4}, seen)
    assert found.parameters["QuadraticBending.stiffness"] == pytest.approx(3e-4, rel=1e-4)


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


@pytest.mark.parametrize(("true", "start", "usable"), [(100.0, 1000.0, True), (1000.0, 900.0, False)])
def test_it_has_the_grade_of_the_run_with_the_estimates(true, start, usable, tmp_path, capsys):
    """One step and sweep a frame end farther than half an edge from the solution if the cloth is stiff, as at both starts."""
    solver, frames = wc.XPBD(substeps=1, iterations=1), 8
    starting, seen = (wc.simulate(hanging(n=16, stiffness=k), solver, frames=frames, dtype="float64") for k in (start, true))
    assert not starting.status.ok and seen.status.ok is usable
    found = wc.fit(hanging(n=16), solver, {"Spring.stiffness": start}, seen.points[1:])
    assert found.parameters["Spring.stiffness"] == pytest.approx(true, rel=1e-6) and found.status.ok is usable
    np.savez(tmp_path / "a.npz", points=seen.points, triangles=hanging(n=16).mesh.triangles, times=seen.times)
    words = ["fit", "hanging", str(tmp_path / "a.npz"), "-p", "n=16", "--start", f"Spring.stiffness={start}", "--frames", "8"]
    assert main([*words, "--solver", "xpbd", "-s", "substeps=1", "iterations=1", "--json"]) == (not usable)
    out, err = capsys.readouterr()
    facts = json.loads(out)
    assert facts["usable"] is usable and facts["grade"] == found.status.grade.value
    said = "the run with the fitted parameters is not usable: in frame "
    assert facts["parameters"] == pytest.approx(found.parameters) and (said in err) != usable


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
    assert main([*words, "--vertices", "x > 9"]) == 2
    assert "vertices is 'x > 9', which names no vertex; it must name one at least" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.host
def test_intervals_contain_the_true_value_as_often_as_they_say():
    """Of 50 noisy motions, by the binomial distribution; and errors are as large as they say, to 4/√100."""
    scene = replace(weight(), duration=12 / 60)
    solver = wc.Newton(substeps=1, integrator="midpoint", tolerance=1e-10)
    true = replace(scene, terms=[wc.Spring(stiffness=STIFFNESS)])
    seen = wc.simulate(true, solver, dtype="float64").points[1:, 1:] * [np.nan, 1.0, np.nan]  # 12 numbers
    inside, errors = [], []
    for seed in range(50):
        noise = np.random.default_rng(seed).normal(scale=NOISE, size=seen.shape)
        found = wc.fit(scene, solver, {"Spring.stiffness": 0.95 * STIFFNESS}, seen + noise, [1])
        low, high = found.intervals["Spring.stiffness"]
        inside.append(low < STIFFNESS < high)
        errors.append(np.log(found.parameters["Spring.stiffness"] / STIFFNESS) / found.errors["Spring.stiffness"])
    assert binomtest(sum(inside), 50, 0.95).pvalue > 0.01, sum(inside)
    # The square of a variable of Student's t of ν degrees of freedom has the mean ν/(ν − 2).
    assert np.mean(np.square(errors)) == pytest.approx(11 / 9, rel=4.0 / np.sqrt(100.0))


def hung(k, links=20, weight=1.0, length=1.2):
    """Sag of the scene `catenary` of few springs, by the horizontal tension T, of which the ends are 1 m apart.

    Spring i from the middle on carries V = wh(i − ½), with h its length at rest, and has F = √(T² + V²) and the length h + F/k.
    """
    h = length / links
    V = weight * h * (np.arange(links // 2) + 0.5)

    def springs(T):
        return h / np.hypot(T, V) + 1.0 / k

    low, high = 1e-6, 1e3
    for _ in range(200):
        T = 0.5 * (low + high)
        low, high = (T, high) if 2.0 * (springs(T) * T).sum() < 1.0 else (low, T)
    return (springs(T) * V).sum(), T


DEEP = wc.Reading(lambda rest: -rest.points[:, 1].min(), 0.0)
PULL = wc.Reading(lambda rest: -rest.reactions[0, 0], 0.0)
LONG = wc.Reading(lambda rest: -rest.points[-1, 1], 0.0)


@pytest.mark.host
@pytest.mark.parametrize(
    ("scene", "reading", "of_stiffness", "k"),
    [
        (chain.scene(), LONG, lambda k: 1.0 + 0.01 * 9.81 / k * 20 * 21 / 2, 1e3),
        (catenary.scene(links=20), DEEP, lambda k: hung(k)[0], 1e3),
        (catenary.scene(links=20), PULL, lambda k: hung(k)[1], 1e3),
    ],
    ids=["chain", "catenary", "its tension"],
)
def test_one_reading_gives_a_stiffness(scene, reading, of_stiffness, k):
    """At rest. The error is that of the reading over its derivative by ln k, in closed form."""
    value, sigma = of_stiffness(k), 1e-6
    slope = (of_stiffness(k * np.exp(1e-4)) - of_stiffness(k * np.exp(-1e-4))) / 2e-4
    found = wc.fit(scene, None, {"Spring.stiffness": 0.7 * k}, replace(reading, value=value, sigma=sigma), record="reactions")
    assert found.parameters["Spring.stiffness"] == pytest.approx(k, rel=1e-6)
    assert found.errors["Spring.stiffness"] == pytest.approx(sigma / abs(slope), rel=1e-5)
    low, high = found.intervals["Spring.stiffness"]
    assert np.log(high / low) == pytest.approx(2.0 * 1.96 * found.errors["Spring.stiffness"], rel=1e-4)


@pytest.mark.slow
@pytest.mark.host
def test_the_depth_of_a_heart_loop_gives_its_bending_stiffness():
    """That of the elastica for Γ = 100. The mesh of 128 edges hangs 0.27 % less deep, and D of that depth is 1.2 % less."""
    true = 9 / 8 * 1e-6
    depth = wc.Reading(lambda rest: -rest.points[:, 1].min(), 0.184043, 1e-4)
    found = wc.fit(loop.scene(elements=128, length=1.0), None, {"QuadraticBending.stiffness": 0.7 * true}, depth)
    assert found.parameters["QuadraticBending.stiffness"] == pytest.approx(true, rel=0.02)


@pytest.mark.slow
@pytest.mark.host
def test_the_angle_of_a_strip_in_wind_gives_its_drag():
    """sin φ = (√(1 + 4N²) − 1)/2N with N = ½ρC_n w²/(mg), at 1 m/s; the error is that of the angle over dφ/d ln C_n."""
    mesh = wc.Mesh.grid(3, 5, size=(0.1, 0.2), pattern="alternating")
    terms = [wc.StVKMembrane(stiffness=5e3), wc.QuadraticBending(stiffness=1e-4)]
    down = mesh.points[:, [1, 2, 0]] * [1.0, -1.0, 1.0]

    def angle(C):
        N = 0.5 * 1.2 * C / (0.1 * 9.81)
        return np.arcsin((np.sqrt(1.0 + 4.0 * N**2) - 1.0) / (2.0 * N))

    air = wc.Air(wind=(1.0, 0.0, 0.0), tangential_drag=0.0)
    scene = wc.Scene(mesh, density=0.1, positions=down, terms=terms, pins="z < 0.001", air=air)
    reading = wc.Reading(lambda rest: np.arctan2(rest.points[-1, 0], -rest.points[-1, 1]), angle(1.2), 0.01)
    found = wc.fit(scene, None, {"Air.normal_drag": 1.0}, reading)
    assert found.parameters["Air.normal_drag"] == pytest.approx(1.2, rel=1e-3)
    slope = (angle(1.2 * np.exp(1e-4)) - angle(1.2 * np.exp(-1e-4))) / 2e-4
    assert found.errors["Air.normal_drag"] == pytest.approx(0.01 / slope, rel=1e-3)


def disc(D=1e-6, rings=5):
    """A disc of 30 cm of hexagonal rings over a support of 18 cm, which starts to fall in six folds."""
    turns = [np.arange(6 * k) / (6 * max(k, 1)) for k in range(rings + 1)]
    turns[0] = np.zeros(1)
    r = np.repeat(np.arange(rings + 1) * 0.15 / rings, [len(each) for each in turns])
    a = 2.0 * np.pi * np.concatenate(turns)
    flat = np.stack([r * np.cos(a), 0.0 * r, r * np.sin(a)], axis=1)
    mesh = wc.Mesh(flat, Delaunay(flat[:, [0, 2]]).simplices)
    over = np.maximum(r - 0.091, 0.0)
    start = flat + np.stack([-0.3 * over * np.cos(a), -over * (0.6 + 0.3 * np.cos(6 * a)), -0.3 * over * np.sin(a)], axis=1)
    terms = [wc.Spring(stiffness=100.0), wc.QuadraticBending(stiffness=D)]
    return wc.Scene(mesh, density=0.1, positions=start, terms=terms, pins=np.flatnonzero(r < 0.091))


FLAT = disc().mesh


def coefficient(rest):
    return drape_coefficient(rest.points, FLAT.points, FLAT.triangles)


@pytest.mark.slow
@pytest.mark.host
def test_a_drape_coefficient_gives_a_bending_stiffness():
    """Of the many rest shapes of a drape, on the branch on which it starts."""
    start = 3e-5
    rest = wc.equilibrium(disc(2e-5), start=wc.equilibrium(disc(start)).points)
    assert 0.5 < coefficient(rest) < 0.72
    reading = wc.Reading(coefficient, coefficient(rest), 0.01)
    found = wc.fit(disc(), None, {"QuadraticBending.stiffness": start}, reading)
    assert found.parameters["QuadraticBending.stiffness"] == pytest.approx(2e-5, rel=1e-4)
    assert 0.01 < found.errors["QuadraticBending.stiffness"] < 0.2


def test_readings_on_the_command_line(capsys):
    """A modulus of 1500 N/m ± 10 is that of the membrane at a strain of 1e-6, and so is its relative error."""
    words = ["fit", "strip", "-p", "angle=0", "elements=2", "strain=1e-6", "--start", "OrthotropicMembrane.stiffness=1000"]
    assert main([*words, "--reading", "modulus=1500+-10", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["parameters"]["OrthotropicMembrane.stiffness"] == pytest.approx(1500.0, rel=1e-5)
    assert found["errors"]["OrthotropicMembrane.stiffness"] == pytest.approx(10.0 / 1500.0, rel=1e-5)
    assert main([*words, "--reading", "modulus=1500"]) == 0 and "its error is not known" in capsys.readouterr().out
    cantilever = ["fit", "cantilever", "--reading", "D=800", "--start"]
    for wrong, sentence in (
        (words, "none of MEASURED, --reading and --capture is given; one of the three must be"),
        ([*words, "seen.usdc", "--reading", "modulus=1"], "is not of the form name=value"),
        (["fit", "strip", "seen.usdc", *cantilever[2:], "a=1"], "MEASURED and --reading are given"),
        ([*words, "--reading", "module=1"], "--reading is 'module'; it must be one of 'modulus'"),
        ([*words, "--reading", "modulus=1+-0"], "reading.sigma is 0.0; it must be a finite number above 0"),
        ([*words, "--reading", "modulus=1", "--fps", "24"], "--prim and --fps are for animations, and --reading is given"),
        ([*words, "--reading", "modulus=1", "--frames", "2"], "--reading is given with --solver, -s, --plot or --frames"),
        ([*cantilever, "density=0.1"], "--reading has D, which the device computes from the density"),
        (["fit", "hanging", *cantilever[2:], "Spring.stiffness=1"], "scene.name is 'hanging'; it must be one of 'cantilever'"),
    ):
        assert main(wrong) == 2 and sentence in capsys.readouterr().err, wrong


@pytest.mark.parametrize(
    ("start", "sentence"),
    [
        (["300"], "--start '300' is not of the form name=value"),
        (["Spring.stiffness=1", "Spring.stiffness=2"], "--start Spring.stiffness is given twice, as '1' and '2'"),
        (["Spring.stiffness=1,2"], "--start Spring.stiffness is '1,2'; it must be a number, or a fraction such as 1/240"),
        (["Spring.stiffness=nan"], "--start Spring.stiffness is 'nan'; it must be a number"),
        (["Spring.stiffness=-1"], "start['Spring.stiffness'] is -1.0; it must be a number above 0"),
        (["Spring.stiffness=1e400"], "start['Spring.stiffness'] is inf; it must be a number above 0, and finite"),
        (["n=4"], "start['n'] names no number of this scene; allowed are Spring.stiffness, Spring.damping, "),
    ],
)
def test_a_wrong_start_on_the_command_line(start, sentence, tmp_path, capsys):
    """Nothing is run, so the motion need not be one."""
    mesh = hanging(n=4).mesh
    np.savez(tmp_path / "seen.npz", points=[mesh.points] * 2, triangles=mesh.triangles, times=[0.0, 1 / 60])
    assert main(["fit", "hanging", str(tmp_path / "seen.npz"), "-p", "n=4", "--start", *start]) == 2
    out, err = capsys.readouterr()
    assert err.startswith(f"warpcloth: {sentence}") and err.count("\n") == 1 and not out


def markers(scene, points):
    """Seven points of triangles of a scene, and their positions at points (F, n, 3)."""
    random = np.random.default_rng(1)
    triangles = random.choice(len(scene.mesh.triangles), 7, replace=False)
    weights = random.dirichlet(np.ones(3), 7)
    return triangles, weights, np.einsum("kc,fkci->fki", weights, points[:, scene.mesh.triangles[triangles]])


def table(scene, points, bound):
    """The rows of a .csv file of markers on a scene at points (F, n, 3) of its first frames."""
    _, _, seen = markers(scene, points)
    lines = ["time, id, x, y, z" if bound else "time, x, y, z"]
    for frame, positions in enumerate(seen):
        for k, at in enumerate(positions):
            numbers = ", ".join(f"{value!r}" for value in at.tolist())
            lines.append(f"{frame / scene.fps!r}, {f'm{k}, ' if bound else ''}{numbers}")
    return "\n".join(lines)


@pytest.mark.parametrize("bound", [True, False])
@pytest.mark.parametrize("resting", slow_but([False], [False, True]))
def test_markers_in_a_file_give_the_parameters(bound, resting, tmp_path, capsys):
    """Bound to triangles by where they are at the start, or free points, by their distances; of a motion or at rest."""
    scene, path = hanging(n=4), tmp_path / "seen.csv"
    if resting:
        soft = wc.equilibrium(scene, vary={"Spring.stiffness": [800.0]})  # two shapes rest; the fit follows that of its start
        points = np.array([scene.positions, wc.equilibrium(scene, start=soft.points).points])
        how = ["--at-rest"]
    else:
        points = wc.simulate(scene, SOLVER, frames=8, dtype="float64").points
        how = ["-s", "substeps=4", "integrator=midpoint", "tolerance=1e-10"]
    path.write_text(table(scene, points, bound))
    words = ["fit", "hanging", str(path), "-p", "n=4", "--start", "Spring.stiffness=800", *how]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["parameters"]["Spring.stiffness"] == pytest.approx(1000.0, rel=1e-5)
    assert found["residual"] < 1e-8
    if resting:
        assert main(words) == 0 and "at rest" in capsys.readouterr().out
        for wrong, sentence in (
            (["--solver", "newton"], "--at-rest is given with --solver"),
            (["--frames", "3"], "--at-rest is given with --solver"),
            (["--fps", "0"], "--prim and --fps are for animations"),
            (["--fps", "24"], "--prim and --fps are for animations"),
            (["--vertices", "x < 1"], "measured is a file of markers; leave vertices out"),
        ):
            assert main([*words, *wrong]) == 2 and sentence in capsys.readouterr().err


def test_markers_and_readings_together(device):
    """Each is divided by its sigma, so a second one narrows the intervals."""
    scene = sheet(400.0, 3e-4)
    run = wc.simulate(scene, SOLVER, device=device, dtype="float64", record="energies")
    triangles, weights, seen = markers(scene, run.points[1:])
    data = [
        wc.Markers(positions=seen, triangles=triangles, weights=weights, sigma=1e-3),
        wc.Reading(lambda each: each.energies["Spring"][-1], run.energies["Spring"][-1], sigma=1e-4),
    ]
    found = wc.fit(sheet(1.0, 1.0), SOLVER, {**TRUE, "Spring.stiffness": 300.0}, data, device=device, record="energies")
    assert found.parameters == pytest.approx(TRUE, rel=1e-6)
    alone = wc.fit(sheet(1.0, 1.0), SOLVER, TRUE, data[:1], device=device)
    assert all(found.errors[name] < alone.errors[name] for name in TRUE), "each datum narrows the interval"
    assert len(found.residuals) == scene.frames and found.freedom == np.inf


def test_free_points_are_seen_at_their_distances():
    """Above the cloth, beside its edges, and on it, as far as trimesh says; and so, to first order, of cloth that has moved."""
    scene, random = sheet(1.0, 1.0), np.random.default_rng(0)
    moved = random.normal(size=(2, *scene.positions.shape))
    points = scene.positions + 0.02 * moved[0]
    corners = points[scene.mesh.triangles]
    on = np.einsum("tc,tci->ti", random.dirichlet(np.ones(3), len(corners)), corners)
    seen = np.concatenate(
        [on, points[scene.mesh.boundary] * [1.004, 1.0, 1.004] - [0.001, 0.0, 0.001], on + np.array([0.0, 0.1, 0.0])]
    )
    seen[[3, 25]] = np.nan
    known = np.isfinite(seen).all(axis=1)
    bound = wc.Markers(positions=seen[None]).bind("measured", scene, 1)
    runs = [SimpleNamespace(points=np.array([scene.positions, points + size * moved[1]])) for size in (0.0, 1e-6)]
    for found, run in zip(bound.residuals(runs), runs, strict=True):
        cloth = trimesh.Trimesh(run.points[1], scene.mesh.triangles, process=False)
        away = trimesh.proximity.closest_point_naive(cloth, seen[known])[1]
        assert np.abs(found) == pytest.approx(away, abs=5e-9)  # the square of 1e-6 over a distance of 1 mm
    assert len(bound.frames) == known.sum()


@pytest.mark.parametrize("points", [None, 1, 7, 40, 1000])
def test_captures_are_thinned_to_at_most_the_points_that_are_asked_for(points):
    """To every second vertex, third and so on: to no fewer than half of them."""
    capture, scene = captured(noise=0.0), sheet(1.0, 1.0)
    every, some = (wc.CapturePoints(capture, points=each).bind("measured", scene, FRAMES).frames for each in (None, points))
    given = np.bincount(every)
    steps = np.ceil(given / (points or given.max()))
    assert np.bincount(some).tolist() == np.ceil(given / steps).tolist()
    assert points is None or (np.bincount(some) <= points).all()


SEEN, K = np.zeros((3, 2, 3)), {"Spring.stiffness": 1.0}
ROWS, AFTER = "time,id,x,y,z\n0,a,0,0,0\n", "0.1,a,0,0,0\n"
FILES = {
    "twice.csv": ROWS + "0,a,0.1,0,0\n" + AFTER,
    "far.csv": ROWS + "0,b,170,0,0\n" + AFTER,
    "endless.csv": ROWS + AFTER + "nan,a,0,0,0\n",
    "huge.csv": ROWS + AFTER + "0.2,a,0,1e308,0\n",
    "empty.csv": "time,x,y,z\n",
    "short.csv": "time,x,y,z\n0,1,2\n",
    "words.csv": "time,x,y,z\n0,left,0,0\n",
    "early.csv": ROWS + AFTER + "-0.1,a,0,0,0\n",
    "late.csv": "time,x,y,z\n0.001,0,0,0\n",
}


@pytest.mark.parametrize(
    ("start", "seen", "sentence"),
    [
        (K, [wc.Markers(positions=SEEN, vertices="all"), LONG], r"measured\[1\] has no sigma; each of several data must have"),
        (K, [wc.Markers(positions=SEEN)], r"measured\[0\]: the mesh has no triangles for markers"),
        (
            K,
            replace(LONG, function=lambda run: run.points, sigma=1.0),
            r"measured\[0\].function has shape \(31, 2, 3\); it must be",
        ),
        (K, "empty.csv", "empty.csv: has no rows"),
        (K, "short.csv", "short.csv, line 2: has 3 values; it must have 4"),
        (K, "words.csv", "words.csv, line 2: x is 'left'; it must be a number"),
        (K, "late.csv", "late.csv: has no row at the time of a frame after the start"),
        (
            K,
            replace(LONG, function=lambda run: 1.0, sigma=1.0),
            "measured does not depend on Spring.stiffness near its start, 1;",
        ),
        (K, wc.Markers(positions=SEEN[:, :1], vertices=[99]), r"measured\[0\].vertices\[0\] is 99; it must lie in 0 … 1"),
        (K, replace(PULL, sigma=1.0), r"measured\[0\].function reads what a run has not .*; give record, such as"),
        (K, [wc.Markers(positions=SEEN * np.nan, vertices="all", sigma=1.0)], r"measured\[0\] has 0 numbers; it must have at"),
        (K, SEEN + 1e308, r"measured: a residual is 1e\+308 at the start; its square must be finite"),
        ({}, SEEN, "start is {}; it must be a dict of parameters"),
        ({"Spring.stiffness": None}, SEEN, r"start\['Spring.stiffness'\] is None; it must be a number above 0"),
        ({"Spring.stiffness": 0.0}, SEEN, r"start\['Spring.stiffness'\] is 0.0; it must be a number above 0"),
        ({"Spring.stiffness": 1.0}, SEEN[:, :1], r"measured has shape \(3, 1, 3\); it must be \(F, 2, 3\)"),
        ({"Spring.stiffness": 1.0}, np.full((3, 2, 3), np.nan), "measured has 0 numbers; it must have at least 1"),
        (
            {"Spring.stifness": 1.0},
            SEEN,
            r"start\['Spring.stifness'\] names no number of this scene; allowed are Spring.stiffness",
        ),
        ({"gravity": 9.81}, SEEN, r"start\['gravity'\] names no number of this scene"),  # it is a vector
        ({"masses": 1.0}, SEEN, r"start\['masses'\] names no number"),
        ({"density": 1.0}, SEEN, r"start\['density'\] names no number"),  # this scene has masses
    ],
)
def test_refusals(start, seen, sentence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=sentence):
        wc.fit(weight(), SOLVER, start, seen)


def test_an_error_of_a_reading_is_its_own():
    """Where everything is recorded, None is not what a run lacks."""
    wrong = wc.Reading(lambda run: None + run.points[-1, 1, 1], -1.0, sigma=1.0)
    with pytest.raises(TypeError, match="NoneType"):
        wc.fit(weight(), SOLVER, K, wrong, record=["energies", "reactions"])


@pytest.mark.parametrize(
    ("seen", "vertices", "sentence"),
    [
        ("twice.csv", "all", "twice.csv, line 3: marker 'a' has a row at time 0 before; it must have one only"),
        ("far.csv", "all", "far.csv, line 3: marker 'b' is 16.* m from the cloth at time 0; it must be at most 0.471 m, the"),
        ("endless.csv", "all", "endless.csv, line 4: time is nan; it must be finite"),
        ("huge.csv", "all", r"huge.csv, line 4: y is 1e\+308; it must be at most 1e\+18 m, or NaN"),
        (
            wc.Markers(positions=SEEN, triangles=0, weights=[[1, 0, 0]]),
            "all",
            r"\[0\].triangles has shape \(\); it must be \(k,\)",
        ),
        (wc.Markers(positions=SEEN, triangles=[[0]], weights=[[1, 0, 0]]), "all", r"triangles has shape \(1, 1\); it must be"),
        (wc.Markers(positions=SEEN), [3], r"vertices is \[3\]; it is for animations and arrays; leave it out"),
        ("early.csv", "all", "early.csv, line 4: time is -0.1 s; it must be 0, the start, or later"),
    ],
    ids=range(8),
)
def test_markers_that_are_refused(seen, vertices, sentence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=sentence):
        wc.fit(hanging(n=4), SOLVER, K, seen, vertices)
