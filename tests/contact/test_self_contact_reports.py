"""What a run says of contact of cloth with itself: pairs, lists, moves that were kept, gaps, and where it cannot go on."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from pxr import Usd, UsdGeom

import warpcloth as wc
from support.pairs import all_pairs
from support.usd_validation import validate
from warpcloth.cli import main
from warpcloth.contact import proximity
from warpcloth.core.status import Result
from warpcloth.run.history import PAIRS, History
from warpcloth.usd import write_scene
from warpcloth.usd.stage import find_prim

SOLVER = wc.XPBD(substeps=2, iterations=4)
DISTANCE = 5e-3


def sheets(n=4, gap=0.02, velocity=(0.0, -1.0, 0.0), turn=17.0, **fields):
    """Two sheets of 0.5 m, one turned above the other, which moves."""
    grid, (c, s) = wc.Mesh.grid(n, n, size=0.5), (np.cos(np.radians(turn)), np.sin(np.radians(turn)))
    above = (grid.points - 0.25) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) + [0.25, 0.25 + gap, 0.25]
    given = {"gravity": np.zeros(3), "fps": 24.0, "duration": 0.25, "self_contact": wc.SelfContact(DISTANCE, 1e5)} | fields
    return wc.Scene(
        wc.Mesh(np.concatenate([grid.points, above]), np.concatenate([grid.triangles, grid.triangles + n * n])),
        density=0.15,
        terms=[wc.Spring(stiffness=100.0)],
        velocities=np.repeat([np.zeros(3), velocity], n * n, axis=0),
        **given,
    )


def gaps(scene, points):
    """Distances of all pairs of a frame as stored."""
    return np.concatenate([now for _, now, _ in all_pairs(scene.mesh, points.astype(np.float32).astype(np.float64))])


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_record_of_pairs(dtype, device):
    """Frame by frame against all pairs in NumPy; without it the run has the same motion and totals."""
    scene, run = sheets(), {"device": device, "dtype": dtype}
    found, plain = (wc.simulate(scene, SOLVER, record=record, **run) for record in ("pairs", ()))
    assert (found.points == plain.points).all() and plain.pairs is None
    assert tuple(found.pairs) == PAIRS and all(values.shape == (7,) for values in found.pairs.values())
    distances = [gaps(scene, points) for points in np.asarray(found.points)]
    apart = np.array([each.min() for each in distances])  # neighbours in a sheet are farther apart than the sheets
    assert found.pairs["least gap"] == pytest.approx(apart, rel=1e-5)
    faces = len(all_pairs(scene.mesh, scene.positions)[0][0])  # edges are in contact below a quarter of the contact distance
    inside = np.array([(each[:faces] < DISTANCE).sum() + (each[faces:] < 0.25 * DISTANCE).sum() for each in distances])
    assert (found.pairs["pairs in contact"] == inside).all() and inside.max() > 1 and inside[0] == 0
    assert (found.pairs["pairs listed"] >= inside).all()
    total = found.self_contact
    assert total.least_gap == found.pairs["least gap"].min() and total.too_near is None
    assert total.pairs >= found.pairs["pairs listed"].max()
    assert total.lists == found.pairs["new lists"].sum() >= (2 if device == "cpu" else 1)  # there sweeps end elsewhere
    assert 1.0 - total.kept == pytest.approx(found.cut) and found.cuts.mean() == pytest.approx(6 / 7 * found.cut)
    assert found.pairs["moves kept"] == pytest.approx(1.0 - found.cuts)
    assert plain.self_contact == total


def test_moves_that_the_filter_cuts(device):
    """Thrown at 100 m/s: each frame says how much was kept, and the total is its mean."""
    found = wc.simulate(sheets(velocity=(0.0, -100.0, 0.0)), SOLVER, device=device, record="pairs", frames=4)
    kept = found.pairs["moves kept"]
    assert kept[0] == 1.0 and kept[1] < 0.9 and kept[1:].mean() == pytest.approx(found.self_contact.kept)


def test_totals_of_copies(device):
    """Each has its own gap and share; lists are those of all."""
    velocities = np.stack([sheets().velocities, 0.0 * sheets().velocities])
    run = {"copies": 2, "vary": {"velocities": velocities}, "device": device, "frames": 4}
    found = wc.simulate(sheets(), SOLVER, record="pairs", **run)
    assert found.pairs["least gap"].shape == (5, 2) and found.pairs["pairs in contact"][:, 1].max() == 0.0
    assert found.self_contact.least_gap == pytest.approx([found.pairs["least gap"][:, 0].min(), 0.02], rel=1e-6)
    assert (found.pairs["new lists"][:, 0] == found.pairs["new lists"][:, 1]).all()


def test_none_of_it_without_self_contact(device):
    scene = sheets(self_contact=None)
    assert wc.simulate(scene, SOLVER, device=device, frames=1).self_contact is None
    with pytest.raises(ValueError, match="record is 'pairs', which only runs of scenes with self_contact or mesh"):
        wc.simulate(scene, SOLVER, device=device, record=("energies", "pairs"))
    with pytest.raises(ValueError, match="record is 'pairs', which only runs"):
        wc.equilibrium(sheets(), device=device, record="pairs")


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_frames_too_coarse_for_the_gap_are_named(dtype, device, tmp_path):
    """Sheets 6 µm apart that fly off along x at 100 m/s: beyond x = 16 m this is less than 4 · 2⁻¹⁹ m, from frame 4 on.

    Frames in memory have the precision of the run, those in a file are float32.
    """
    soft = wc.SelfContact(DISTANCE, 1e-6)  # which does not push them apart in the meantime
    scene = sheets(gap=6e-6, turn=0.0, self_contact=soft)
    scene = replace(scene, velocities=np.tile([100.0, 0.0, 0.0], (32, 1)))
    near = wc.simulate(scene, SOLVER, device=device, dtype=dtype, frames=3).self_contact
    assert near.too_near is None and near.least_gap == pytest.approx(6e-6, rel=1e-3)
    kept = wc.simulate(scene, SOLVER, device=device, dtype=dtype, frames=5).self_contact
    far = wc.simulate(scene, SOLVER, tmp_path / "far.usdc", device=device, dtype=dtype, frames=5).self_contact
    assert kept == (far if dtype == "float32" else far._replace(too_near=None))
    assert far.too_near.startswith("in frame 4 first, at vertex ") and "the least gap is 6e-06 m" in far.too_near


def test_the_least_gap_is_that_of_good_frames(device, tmp_path):
    """Also if frames were computed ahead of the one that diverged, as with an output, and in a copy that diverged alone."""
    scene = sheets(velocity=(0.0, -0.1, 0.0), self_contact=wc.SelfContact(DISTANCE, 1e3))
    solver, run = wc.Explicit(substeps=2, above_limit="allow"), {"device": device, "dtype": "float64", "frames": 9}
    alone, written = (wc.simulate(scene, solver, output, **run) for output in (None, tmp_path / "out.usdc"))
    good = alone.status.frame
    assert alone.status.result is Result.DIVERGED and good == written.status.frame >= 1
    distances = [gaps(scene, points).min() for points in alone.points]
    assert alone.self_contact.least_gap == written.self_contact.least_gap == pytest.approx(min(distances), rel=1e-6)
    both = wc.simulate(
        scene,
        solver,
        copies=2,
        vary={"velocities": [scene.velocities, -scene.velocities], "Spring.stiffness": [100.0, 1.0]},
        **run,
    )
    assert both.status.good.tolist() == [good, 9] and both.self_contact.least_gap[0] == alone.self_contact.least_gap


@pytest.mark.parametrize("axes", ["xyz", "y"])
def test_pins_that_cloth_holds_back(axes, device):
    """Pins that are to go down through pins, by 0.08 m, stop above them: the run says so, and counts moves of free vertices."""
    scene = sheets(turn=0.0)
    keyframes = np.tile(scene.positions, (5, 1, 1))
    keyframes[:, 16:, 1] -= np.linspace(0.0, 0.08, 5)[:, None]
    pins = wc.Pins(np.arange(32), keyframes, axes=axes)
    found = wc.simulate(replace(scene, pins=pins), SOLVER, device=device, dtype="float64", frames=5)
    back = (found.points[-1] - keyframes[-1])[16:, 1].max()
    assert back > 0.05 and 0.0 <= found.cut <= 1.0
    said = found.self_contact.held_pins
    assert said.startswith("cloth holds back pins from frame 1 on, vertex ")
    farthest = float(said.split("by up to ")[1].split(" m")[0])
    assert farthest == pytest.approx(back, rel=1e-2)
    what = said.split("; ")[0]
    assert not found.status and f"not usable: {what}; move the pins so that" in found.status.message
    allowed = replace(scene, pins=pins, self_contact=replace(scene.self_contact, held_pins="allow"))
    found = wc.simulate(allowed, SOLVER, device=device, dtype="float64", frames=5)
    assert found.status and found.self_contact.held_pins == said


def test_held_pins_catch_up(device):
    """Pins that were held come back to keyframes that they can meet; the message says how far they were from them."""
    scene = sheets(turn=0.0)
    keyframes = np.tile(scene.positions, (5, 1, 1))
    keyframes[:, 16:, 1] -= np.array([0.0, 0.04, 0.08, 0.04, 0.0])[:, None]
    found = wc.simulate(
        replace(scene, pins=wc.Pins(np.arange(32), keyframes)), wc.Explicit(substeps=16), device=device, frames=4
    )
    assert found.points[-1] == pytest.approx(keyframes[-1], abs=1e-7)
    assert (found.points[2] - keyframes[2])[16:, 1].min() > 0.05
    assert "cloth holds back pins from frame " in found.status.message
    assert " first, by up to 0.06 m; move the pins so that they do not run" in found.status.message  # 0.08 m less the gap


def test_pins_that_go_their_way(device):
    """No pin is said to be held back while cloth only presses on it."""
    scene = sheets(gravity=np.array([0.0, -9.81, 0.0]), pins=np.arange(16))
    found = wc.simulate(scene, SOLVER, device=device)
    assert found.self_contact.held_pins is None and "pins" not in found.status.message


@pytest.mark.parametrize("far", [0.0, 700.0])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_filter_leaves_the_least_gap(far, dtype, device):
    """Where only one of two sides comes nearer too: a soft sheet sinks on another one at rest, also where float32 is coarse."""
    least = max(1e-3 * DISTANCE, 4.0 * float(np.finfo(dtype).eps) * far)
    scene = sheets(self_contact=wc.SelfContact(DISTANCE, 1e-3), gravity=np.array([0.0, -9.81, 0.0]), pins=np.arange(16))
    scene = replace(scene, positions=scene.positions + far, mesh=wc.Mesh(scene.mesh.points + far, scene.mesh.triangles))
    found = wc.simulate(scene, wc.XPBD(substeps=8, iterations=4), device=device, dtype=dtype, frames=8, record="pairs")
    assert found.self_contact.too_near is None
    assert found.self_contact.least_gap >= least
    assert found.pairs["least gap"][-1] < 4.0 * least


def test_a_resumed_run_has_the_same_record(tmp_path, device):
    def stop(frame, _frames):
        if frame == 12:
            raise KeyboardInterrupt

    scene, record = sheets(duration=14 / 24), ("energies", "pairs")
    whole = wc.simulate(scene, SOLVER, device=device, record=record)
    given = {"device": device, "record": record, "output": tmp_path / "out.usdc"}
    with pytest.raises(KeyboardInterrupt):
        wc.simulate(scene, SOLVER, progress=stop, **given)
    resumed = wc.simulate(scene, SOLVER, resume=True, **given)
    assert resumed.self_contact == whole.self_contact
    for name in PAIRS:
        assert (resumed.pairs[name] == whole.pairs[name]).all()
    stage = Usd.Stage.Open(str(tmp_path / "out.usdc"))
    prim = find_prim(stage, "out", None)
    for name in PAIRS:
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(f"self_contact:{name.replace(' ', '_')}")
        assert primvar.GetInterpolation() == "constant"
        assert [primvar.Get(frame) for frame in range(15)] == whole.pairs[name].tolist()
    assert validate(tmp_path / "out.usdc") == []


def test_command(tmp_path, capsys, device):
    stage = write_scene(sheets(duration=4 / 24), tmp_path / "sheets.usda")
    files = {name: str(tmp_path / name) for name in ("run.usdc", "run.csv", "run.json")}
    options = ["--solver", "xpbd", "-s", "substeps=10", "iterations=8", "--device", device]
    given = ["run", str(stage), *options, "-o", files["run.usdc"]]
    assert main([*given, "--csv", files["run.csv"], "--report", files["run.json"]]) == 0
    printed = capsys.readouterr().out
    assert "  contact       up to " in printed and " % of moves kept, least gap 0.00" in printed
    with open(files["run.csv"], newline="") as file:
        rows = list(csv.DictReader(file))
    with open(files["run.json"]) as file:
        report = json.load(file)
    for name in PAIRS:
        assert [float(row[name]) for row in rows] == report["pairs"][name]
    assert main([*given, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)["self_contact"]
    assert facts["least_gap"] == min(report["pairs"]["least gap"]) and facts["too_near"] is None
    assert facts["lists"] == sum(report["pairs"]["new lists"])


@pytest.mark.parametrize("solver", [SOLVER, wc.Newton(substeps=2)], ids=["xpbd", "newton"])
def test_no_memory_for_pairs(solver, tmp_path, monkeypatch, device):
    """A run that cannot go on says in which frame and why, and its frames are those of one that can."""
    scene = sheets(n=10, gap=0.2, velocity=(0.0, -3.0, 0.0), duration=4 / 24)
    whole = wc.simulate(scene, solver, device=device)
    assert whole.status.complete and whole.self_contact.pairs > 1024

    def no_memory(frame, _frames):
        monkeypatch.setattr(proximity, "BYTES_OF_A_PAIR", 1 << 62)

    given = {"device": device, "progress": no_memory}
    for output in (None, tmp_path / "out.usdc"):
        monkeypatch.undo()
        found = wc.simulate(scene, solver, output=output, **given)
        frame = found.status.frame
        assert 0 < frame < 4 and found.status.result is Result.STOPPED and not found.status.ok
        assert found.status.message.startswith(f"stopped before the end of frame {frame + 1}: the cloth has ")
        assert "pairs that are near one another, which takes" in found.status.message
        assert (np.float32(found.points) == np.float32(whole.points)[: frame + 1]).all()  # as the file holds them


@pytest.mark.parametrize("solver", [SOLVER, wc.Newton(substeps=2), wc.PBD(substeps=2)], ids=["xpbd", "newton", "pbd"])
def test_bits_repeat(solver, device):
    """Runs are the same that make room for pairs in the middle of a frame, that have it from the start, and in a batch."""
    scene, ends = sheets(n=10, gap=0.2, velocity=(0.0, -3.0, 0.0)), []
    for copies, room in ((1, None), (1, None), (1, 10_000), (2, None)):
        stepper = solver.bind(scene.build(device=device, copies=copies))
        if room:
            stepper.pairs.grow_to(room)
            stepper.record_again()
        stepper.frame()
        before = len(stepper.pairs.pairs.stencils)
        for _ in range(3):
            stepper.frame()
        assert (len(stepper.pairs.pairs.stencils) > before) == (room is None)
        x, v = (array.numpy().reshape(copies, -1, 3) for array in stepper.state)
        ends += [x[copy].tobytes() + v[copy].tobytes() for copy in range(copies)]
    assert len(ends) == 5 and len(set(ends)) == 1


def test_work_of_pins_where_a_step_makes_room(device):
    """Recorded launches are recorded again if a step itself makes room for pairs."""
    grid = wc.Mesh.grid(10, 10)
    falling = sheets(n=10, gap=0.05, velocity=(0.0, -3.0, 0.0))
    way = np.linspace(0.0, 0.05, 7)[:, None, None] * [0.0, 1.0, 0.0]
    pins = wc.Pins(np.arange(len(grid.points)), falling.mesh.points[: len(grid.points)] + way)
    works = []
    for room in (None, 10_000):
        model = replace(falling, pins=pins).build(device=device)
        stepper = SOLVER.bind(model)
        if room:
            stepper.pairs.grow_to(room)
            stepper.record_again()
        history = History(stepper, model, ("energies",))
        before = len(stepper.pairs.pairs.stencils)
        for _ in range(3):
            history.frame()
            history.keep(np.ones(1, dtype=bool))
        assert (len(stepper.pairs.pairs.stencils) > before) == (room is None)
        works.append(history.energies)
    assert (works[0] == works[1]).all() and works[0][-1, 0, history.names.index("work of pins")] != 0.0


TIP = [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]


def test_a_gap_to_a_mesh_names_the_stiffness_of_contact(device):
    """Of edges too, which no vertex of the cloth shows."""
    tip = wc.MeshCollider([[-0.2, -0.3, -0.1], [0.2, -0.3, -0.1], [0.0, -0.3, 0.2], [0.02, -0.01, 0.01]], TIP)
    grid = wc.Mesh.grid(3, 3, size=0.2)
    fields = {"terms": [wc.Spring(stiffness=100.0)], "density": 0.15, "fps": 24.0, "duration": 4 / 24}
    contact, itself = wc.Contact(distance=5e-3, stiffness=100.0), wc.SelfContact(distance=5e-3, stiffness=1e5)
    mesh = wc.Mesh(grid.points - [0.1, 0.0, 0.1], grid.triangles)
    scene = wc.Scene(mesh, colliders=[tip], contact=contact, self_contact=itself, **fields)
    message = wc.simulate(scene, wc.Newton(substeps=4), device=device, dtype="float64").status.message
    assert "the gap between cloth and a mesh falls below half the contact distance; a larger contact.stiffness" in message
    assert "self_contact.stiffness" not in message
