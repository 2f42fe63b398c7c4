"""What a run says of contact of cloth with itself: pairs, lists, moves that were kept, gaps, and where it cannot go on."""

import csv
import gc
import json
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from pxr import Usd, UsdGeom

import warpcloth as wc
from support.layers import layers
from support.pairs import all_pairs
from support.steps import stopped_and_resumed
from support.usd_validation import validate
from warpcloth.cli import main
from warpcloth.contact import pair_contact, proximity
from warpcloth.core.status import Result
from warpcloth.run.history import PAIRS, History
from warpcloth.usd import write_scene
from warpcloth.usd.stage import find_prim

SOLVER = wc.XPBD(substeps=2, iterations=4)
DISTANCE, TERMS = 5e-3, [wc.Spring(stiffness=100.0)]


def sheets(n=4, velocity=(0.0, -1.0, 0.0), **fields):
    """Two sheets of 0.5 m, one turned above the other, which moves."""
    velocities = np.repeat([np.zeros(3), velocity], n * n, axis=0)
    return layers(n=n, **{"turn": 17.0, "duration": 0.25, "velocities": velocities, "terms": TERMS, **fields})


def pins_down(scene, *depths, **given):
    """Keyframes of all vertices, those of the upper sheet so much lower [m]."""
    keyframes = np.tile(scene.positions, (len(depths), 1, 1))
    keyframes[:, 16:, 1] -= np.array(depths)[:, None]
    return wc.Pins(np.arange(32), keyframes, **given)


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
    assert found.pairs["moves kept"] == pytest.approx(1.0 - found.cuts) and plain.self_contact == total


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
    """Sheets 6 µm apart that fly off along x at 100 m/s: beyond x = 16 m this is less than 4 · 2⁻¹⁹ m, from frame 4 on."""
    # They are too soft to push one another apart. Frames in memory have the precision of the run, those in a file are float32.
    scene = sheets(gap=6e-6, turn=0.0, stiffness=1e-6, velocities=np.tile([100.0, 0.0, 0.0], (32, 1)))

    def report(frames, output=None):
        return wc.simulate(scene, SOLVER, output, device=device, dtype=dtype, frames=frames).self_contact

    near, kept, far = report(3), report(5), report(5, tmp_path / "far.usdc")
    assert near.too_near is None and near.least_gap == pytest.approx(6e-6, rel=1e-3)
    assert kept == (far if dtype == "float32" else far._replace(too_near=None))
    assert far.too_near.startswith("in frame 4 first, at vertex ") and "the least gap is 6e-06 m" in far.too_near


def test_the_least_gap_is_that_of_good_frames(device, tmp_path):
    """Also if frames were computed ahead of the one that diverged, as with an output, and in a copy that diverged alone."""
    scene = sheets(velocity=(0.0, -0.1, 0.0), stiffness=1e3)
    solver, run = wc.Explicit(substeps=2, above_limit="allow"), {"device": device, "dtype": "float64", "frames": 9}
    alone, written = (wc.simulate(scene, solver, output, **run) for output in (None, tmp_path / "out.usdc"))
    good = alone.status.frame
    assert alone.status.result is Result.DIVERGED and good == written.status.frame >= 1
    distances = [gaps(scene, points).min() for points in alone.points]
    assert alone.self_contact.least_gap == written.self_contact.least_gap == pytest.approx(min(distances), rel=1e-6)
    vary = {"velocities": [scene.velocities, -scene.velocities], "Spring.stiffness": [100.0, 1.0]}
    both = wc.simulate(scene, solver, copies=2, vary=vary, **run)
    assert both.status.good.tolist() == [good, 9] and both.self_contact.least_gap[0] == alone.self_contact.least_gap


@pytest.mark.parametrize("axes", ["xyz", "y"])
def test_pins_that_cloth_holds_back(axes, device):
    """Pins that are to go down through pins, by 0.08 m, stop above them: the run says so, and counts moves of free vertices."""
    scene = sheets(turn=0.0)
    scene, run = replace(scene, pins=pins_down(scene, 0.0, 0.02, 0.04, 0.06, 0.08, axes=axes)), {"device": device, "frames": 5}
    found = wc.simulate(scene, SOLVER, dtype="float64", **run)
    back = (found.points[-1] - scene.pins.keyframes[-1])[16:, 1].max()
    assert back > 0.05 and 0.0 <= found.cut <= 1.0
    message = found.self_contact.held_pins
    assert message.startswith("cloth holds back pins from frame 1 on, vertex ")
    farthest = float(message.split("by up to ")[1].split(" m")[0])
    assert farthest == pytest.approx(back, rel=1e-2)
    what = message.split("; ")[0]
    assert not found.status and f"not usable: {what}; move the pins so that" in found.status.message
    allowed = replace(scene, self_contact=replace(scene.self_contact, held_pins="allow"))
    found = wc.simulate(allowed, SOLVER, dtype="float64", **run)
    assert found.status and found.self_contact.held_pins == message


def test_held_pins_catch_up(device):
    """Pins that were held come back to keyframes that they can meet; the message says how far they were from them."""
    scene = sheets(turn=0.0)
    scene = replace(scene, pins=pins_down(scene, 0.0, 0.04, 0.08, 0.04, 0.0))
    found, keyframes = wc.simulate(scene, wc.Explicit(substeps=16), device=device, frames=4), scene.pins.keyframes
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
    scene = sheets(stiffness=1e-3, gravity=np.array([0.0, -9.81, 0.0]), pins=np.arange(16))
    scene = replace(scene, positions=scene.positions + far, mesh=wc.Mesh(scene.mesh.points + far, scene.mesh.triangles))
    found = wc.simulate(scene, wc.XPBD(substeps=8, iterations=4), device=device, dtype=dtype, frames=8, record="pairs")
    assert found.self_contact.too_near is None and found.self_contact.least_gap >= least
    assert found.pairs["least gap"][-1] < 4.0 * least


def test_a_resumed_run_has_the_same_record(tmp_path, device):
    scene, record, output = sheets(duration=14 / 24), ("energies", "pairs"), tmp_path / "out.usdc"
    whole = wc.simulate(scene, SOLVER, device=device, record=record)
    resumed = stopped_and_resumed(12, scene, SOLVER, output=output, device=device, record=record)
    assert resumed.self_contact == whole.self_contact
    stage = Usd.Stage.Open(str(output))
    primvars = UsdGeom.PrimvarsAPI(find_prim(stage, "out", None))
    for name in PAIRS:
        assert (resumed.pairs[name] == whole.pairs[name]).all()
        primvar = primvars.GetPrimvar(f"self_contact:{name.replace(' ', '_')}")
        assert primvar.GetInterpolation() == "constant"
        assert [primvar.Get(frame) for frame in range(15)] == whole.pairs[name].tolist()
    assert validate(output) == []


def test_command(tmp_path, capsys, device):
    stage = write_scene(sheets(duration=4 / 24), tmp_path / "sheets.usda")
    out, table, report = (tmp_path / name for name in ("run.usdc", "run.csv", "run.json"))
    options = ["--solver", "xpbd", "-s", "substeps=10", "iterations=8", "--device", device]
    given = ["run", str(stage), *options, "-o", str(out)]
    assert main([*given, "--csv", str(table), "--report", str(report)]) == 0
    printed = capsys.readouterr().out
    assert "  contact       up to " in printed and " % of moves kept, least gap 0.00" in printed
    rows, pairs = list(csv.DictReader(table.read_text().splitlines())), json.loads(report.read_text())["pairs"]
    for name in PAIRS:
        assert [float(row[name]) for row in rows] == pairs[name]
    assert main([*given, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)["self_contact"]
    assert facts["least_gap"] == min(pairs["least gap"]) and facts["too_near"] is None
    assert facts["lists"] == sum(pairs["new lists"])


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
        assert found.status.message.startswith(f"stopped before the end of frame {frame + 1}: the cloth needs room for ")
        assert "pairs that are near one another, which takes" in found.status.message
        assert (np.float32(found.points) == np.float32(whole.points)[: frame + 1]).all()  # as the file holds them


ASKED = [((1e5, 0), proximity.BYTES_OF_A_PAIR), ((0, 1e5), pair_contact.BYTES_OF_A_CONTACT)]


@pytest.mark.parametrize(("room", "asked"), ASKED, ids=["pairs", "contacts"])
@pytest.mark.parametrize("solver", [SOLVER, wc.Newton(substeps=2)], ids=["xpbd", "newton"])
def test_pairs_and_contacts_take_at_most_the_memory_that_is_asked_for(solver, room, asked, device):
    """With friction; meshes, float64 and CUDA take more. Arrays of the mesh are far smaller here."""
    before = [each for each in gc.get_objects() if type(each) is wp.array]  # keeps them, so that new ones are others
    stepper = solver.bind(replace(sheets(n=10, gap=0.2), self_contact=wc.SelfContact(friction=0.3)).build(device=device))
    stepper.pairs.grow_to(*room)
    capacity = max(stepper.pairs.capacities)
    known = {each.ptr for each in before}
    arrays = {each.ptr: each for each in gc.get_objects() if type(each) is wp.array and each.size >= capacity}
    taken = sum(each.capacity for each in arrays.values() if each.ptr not in known) / capacity
    assert 0.45 <= taken / asked <= 1.0


def test_more_pairs_than_numbers(device):
    stepper = SOLVER.bind(sheets(n=4, gap=0.2).build(device=device))
    with pytest.raises(ValueError, match="room for 300000000 pairs that are near one another; it must be at most 268435455"):
        stepper.pairs.grow_to(2e8)


def test_work_of_pins_where_a_step_makes_room(device):
    """Recorded launches are recorded again if a step itself makes room for pairs."""
    falling, works = sheets(n=10, gap=0.05, velocity=(0.0, -3.0, 0.0)), []
    way = np.linspace(0.0, 0.05, 7)[:, None, None] * [0.0, 1.0, 0.0]
    scene = replace(falling, pins=wc.Pins(np.arange(100), falling.mesh.points[:100] + way))
    for room in (None, 10_000):
        model = scene.build(device=device)
        stepper = SOLVER.bind(model)
        if room:
            stepper.pairs.grow_to(room)
            stepper.record_again()
        history, before = History(stepper, model, ("energies",)), len(stepper.pairs.pairs.stencils)
        for _ in range(3):
            history.frame()
            history.keep(np.ones(1, dtype=bool))
        assert (len(stepper.pairs.pairs.stencils) > before) == (room is None)
        works.append(history.energies)
    assert (works[0] == works[1]).all() and works[0][-1, 0, history.names.index("work of pins")] != 0.0


def test_a_gap_to_a_mesh_names_the_stiffness_of_contact(device):
    """Of edges too, which no vertex of the cloth shows."""
    corners = [[-0.2, -0.3, -0.1], [0.2, -0.3, -0.1], [0.0, -0.3, 0.2], [0.02, -0.01, 0.01]]
    tip = wc.MeshCollider(corners, [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    contact, gravity = wc.Contact(distance=DISTANCE, stiffness=100.0), (0.0, -9.81, 0.0)
    scene = layers(1, n=3, size=0.2, colliders=[tip], contact=contact, gravity=gravity, terms=TERMS, duration=4 / 24)
    message = wc.simulate(scene, wc.Newton(substeps=4), device=device, dtype="float64").status.message
    assert "the gap between cloth and a mesh falls below half the contact distance; a larger contact.stiffness" in message
    assert "self_contact.stiffness" not in message
