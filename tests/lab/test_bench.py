"""Benchmarks: what they count, what they make of times, and the command; times themselves are not tested."""

import csv
import json
import os
import time
from dataclasses import asdict

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.rows import slow_but
from warpcloth.cli import main
from warpcloth.cli.bench import _contact
from warpcloth.core.capture import Segment
from warpcloth.lab import benchmarks
from warpcloth.lab.bandwidth import measure as bandwidth
from warpcloth.lab.benchmarks import Run, SolverBenchmark, contacts, self_contacts, standard
from warpcloth.lab.counts import compulsory_bytes, elements_of, launches_of
from warpcloth.lab.measurements import SceneRef, Setup
from warpcloth.lab.results import exponent, growth, ratios, write_csv
from warpcloth.lab.timing import measure
from warpcloth.scenes import hanging
from warpcloth.solvers import SOLVERS


@pytest.mark.parametrize(("dtype", "size"), [("float32", 4), ("float64", 8)])
@pytest.mark.parametrize("copies", [1, 3])
def test_bytes(dtype, size, copies, device):
    """Of each copy: x in and out and 1/m for each vertex, two indices and a rest length for each spring; k is one number."""
    scene = wc.Scene(wc.Mesh.grid(5, 4), density=0.1, terms=[wc.Spring(pairs="structural", stiffness=1.0)])
    model = scene.build(device=device, dtype=dtype, copies=copies)
    n, springs = 20, 4 * 4 + 5 * 3
    assert elements_of(model) == copies * springs
    iteration = copies * (n * 7 * size + springs * (2 * 4 + size)) + size
    for iterations in (1, 3.5):
        assert compulsory_bytes(model, iterations) == iterations * iteration + copies * n * 6 * size


@wp.kernel(module="unique", enable_backward=False)
def count_down(left: wp.array(dtype=int)):
    left[0] = wp.max(left[0] - 1, 0)


def test_launches_of_loops_on_the_device_count_each_time(device):
    left, times = wp.array([5], dtype=int, device=device), wp.zeros(1, dtype=int, device=device)

    def count():
        wp.launch(count_down, 1, outputs=[left], device=device)

    def record():
        times.zero_()
        wp.copy(times, left)
        wp.capture_while(left, count)

    segment = Segment(wp.get_device(device), record)
    left.fill_(5)
    before = wp.launch, wp.copy, wp.array.zero_, Segment.__call__
    assert launches_of(segment) == 1 + 1 + 5
    assert times.numpy()[0] == 5 and left.numpy()[0] == 0
    left.fill_(3)
    with pytest.raises(KeyError):
        launches_of({}.__getitem__("x"))
    assert (wp.launch, wp.copy, wp.array.zero_, Segment.__call__) == before
    assert launches_of(lambda: (segment(), segment())) == 2 * 2 + 3


@pytest.mark.parametrize("solver", slow_but(("explicit", "newton", "xpbd"), SOLVERS))
def test_counting_takes_the_same_steps(solver, device):
    """To the bit; of explicit they are no more than a launch for each term and one for all vertices."""
    record = SOLVERS[solver](substeps=20 if solver == "explicit" else 4)
    steppers = [record.bind(hanging.scene(n=5).build(device=device)) for _ in range(2)]
    for stepper in steppers * 8:  # of a start at rest nothing is to be minimised
        stepper.step()
    launches = launches_of(steppers[0].step)
    steppers[1].step()
    np.testing.assert_array_equal(*(stepper.state.x.numpy() for stepper in steppers))
    assert steppers[0].iterations == steppers[1].iterations >= 1
    assert 1 <= launches <= 3 if solver == "explicit" else launches > steppers[0].iterations


@pytest.mark.parametrize("one", standard(), ids=lambda each: each.setup.solver)
def test_a_row_of_every_solver(one, device):
    scene = SceneRef(one.scene.name, {"n": 5})
    setup = SolverBenchmark(scene, one.setup, device=device).setup_of(scene)
    row = measure(asdict(scene), asdict(setup), frames=2, device=device, dtype="float32", started=time.time())
    assert row["status"] == "ok" and row["frames"] == 2 and row["vertices"] == 25
    scene = scene.load()
    assert row["elements"] == sum(len(term.stencil(scene.mesh)) for term in scene.terms)
    options = setup.options
    assert row["substeps"] == options["substeps"] and 1 <= row["iterations"] <= options.get("iterations", 100)
    if "pbd" in setup.solver:
        assert row["iterations"] == options["iterations"]
    model = scene.build(device=device)
    assert row["bytes"] == round(compulsory_bytes(model, row["iterations"]))
    assert row["bytes_per_s"] == pytest.approx(row["bytes"] * row["substeps"] / (1e-3 * row["ms"]))
    assert row["spread"][0] <= row["ms"] <= row["spread"][1] and row["start_s"] > row["bind_s"] > 0.0
    assert row["memory"] is None or row["memory"] > model.report()["bytes"]
    json.dumps(row, allow_nan=False)


def test_a_row_has_the_grade_of_the_same_frames_of_a_run(device):
    """Of the frames that are timed, and 2 before them."""
    scene, setup = SceneRef("hanging", {"n": 16}), Setup("xpbd", {"substeps": 1, "iterations": 1})
    row = measure(asdict(scene), asdict(setup), frames=8, device=device, dtype="float32", started=time.time())
    status = wc.simulate(scene.load(), setup.record(), frames=10, device=device).status
    assert row["status"] == "ok" and row["grade"] == status.grade.value == "not usable"
    assert row["distance"] == pytest.approx(status.distance, rel=1e-3)


def test_contact_is_measured_touched_and_far_away():
    """All vertices are at the gap of each shape, within the contact distance or farther than a second of falling."""
    listed = contacts(dtype="float64")
    assert [each.setup.solver for each in listed] == ["explicit", "newton", "xpbd", "projective-dynamics", "explicit"]
    assert {each.dtype for each in listed} == {"float64"}
    for each in listed:
        for ref in each.scenes():
            scene = SceneRef(ref.name, ref.parameters | {"n": 5}).load()
            gap, (shape,) = ref.parameters.get("gap", 0.9e-3), scene.colliders
            np.testing.assert_allclose(shape.distances(scene.positions), gap, rtol=1e-6, atol=1e-6)  # float32 of meshes
            assert gap < scene.contact.distance or gap > 0.5 * 9.81
    shapes = [(each["collider"], each["gap"] < 1.0) for each in listed[0].variants]
    assert len(shapes) == len(set(shapes)) == 10
    assert [ref.load().colliders[0].triangles.shape[0] for ref in listed[-1].scenes()] == [1250, 5000, 20000, 80000]


@pytest.mark.parametrize("scene", [SceneRef("resting", {"n": 5, "collider": "sphere"}), SceneRef("drape", {"n": 5})], ids=str)
def test_what_contact_costs(scene, device):
    """The difference of two frames, over vertices, substeps and colliders."""
    setup = Setup("explicit", {"substeps": 32})
    row = measure(asdict(scene), asdict(setup), frames=2, device=device, dtype="float32", started=time.time())
    count = 25 * 32 * len(scene.load().colliders)
    assert row["status"] == "ok" and row["triangles"] == 0 and row["ms_without"] > 0.0
    assert row["contact_ns"] == pytest.approx(1e6 * (row["ms"] - row["ms_without"]) / count)
    said = _contact(row)
    assert said.startswith(f"{row['ms'] / row['ms_without']:.2f} of the time without") and _contact({"ms": 1.0}) == ""


@pytest.mark.slow
def test_what_self_contact_costs(device):
    """As above, and what its filter did: sheets in a stack are listed as near to one another, and stay apart."""
    scene = SceneRef("stack", {"sheets": 2, "n": 4})
    given = {"frames": 1, "device": device, "dtype": "float32", "started": time.time()}
    row = measure(asdict(scene), asdict(Setup("xpbd", {"substeps": 4, "iterations": 2})), **given)
    assert row["contact_ns"] == pytest.approx(
        1e6 * (row["ms"] - row["ms_without"]) / (row["vertices"] * 4 * 3)
    )  # floor, ball and cloth
    assert row["pairs"] > 0 and 0.0 < row["lists"] <= 1.0 and 0.0 < row["kept"] <= 1.0 and row["least_gap"] > 0.0
    assert row["list_ns"] > 0.0 and row["find_ns"] > 0.0
    said = _contact(row)
    assert f"; {row['pairs']} pairs, {row['lists']:.2g} lists a substep, " in said and said.endswith(
        f", its contacts {row['find_ns']:.3g}"
    )


def test_self_contact_is_measured_flat_and_folded():
    """Nothing touches a flat sheet; layers of a folded one are a contact distance apart, and not nearer."""
    listed = self_contacts(dtype="float64")
    assert [each.scene.parameters["layers"] for each in listed] == [1, 2] * 4
    assert {each.setup.solver for each in listed} == {"explicit", "newton", "xpbd", "pbd"}
    flat, folded = (SceneRef("folded_sheet", {"n": 9, "layers": layers}).load() for layers in (1, 2))
    assert (flat.positions == flat.mesh.points).all()
    assert np.ptp(folded.positions[:, 1]) == pytest.approx(folded.self_contact.distance)
    one = [row(n, n**2) | {"list_ns": 9.0, "find_ns": n**0.5} for n in (4, 8, 16)]
    assert growth(one)[0]["list"][0] == pytest.approx(1.0) and growth(one)[0]["find"][0] == pytest.approx(1.25)


def test_growth_with_triangles():
    rows = [row(8, 0.1 * count**0.5, triangles=count) for count in (100, 400, 1600)]
    (one,) = growth(rows)
    assert one["over"] == "triangles" and one["frame"] == pytest.approx([0.5, 0.0], abs=1e-9)
    assert growth([row(n, n**2) for n in (4, 8)])[0]["over"] == "vertices"


def test_the_standard_has_every_solver_on_growing_scenes():
    listed = standard(device="cpu", dtype="float64", frames=3)
    assert {each.setup.solver for each in listed} == set(SOLVERS)
    local = [each for each in listed if each.scene != SceneRef("hanging")]
    assert [(each.scene, each.setup.options["sweep"]) for each in local] == [(SceneRef("net"), "vertex-averaged")]
    assert standard(device="cuda:0")[-1].sizes == (256, 512, 1024, 2048)
    for each in (*listed, *standard(device="cuda:0", dtype="float64", frames=3)):
        assert len(each.sizes) >= 3 and list(each.sizes) == sorted(set(each.sizes))
        assert (each.dtype, each.frames) == ("float64", 3)
        assert SOLVERS[each.setup.solver].limited or each.setup.record().substeps


def test_a_copy_moves_something(device):
    assert all(each > 0.0 for each in bandwidth(device).values())


def test_the_exponent_of_a_power_is_exact():
    sizes = np.array([16, 64, 256, 1024])
    p, error = exponent(sizes, 3.0 * sizes**1.25)
    assert p == pytest.approx(1.25, abs=1e-12) and error == pytest.approx(0.0, abs=1e-12)
    assert exponent([4, 16], [1.0, 8.0]) == (pytest.approx(1.5), None)
    assert exponent([4], [1.0]) == exponent([4, 4], [1.0, 2.0]) == exponent([], []) == (None, None)


def test_the_error_of_an_exponent():
    """Logarithms −1, 0, 1 and times that are off the line by e, −2e, e: p stays, and its error is √(6e²/1/2)."""
    e = 0.01
    p, error = exponent(np.exp([-1.0, 0.0, 1.0]), np.exp([-0.7 + e, -2.0 * e, 0.7 + e]))
    assert p == pytest.approx(0.7) and error == pytest.approx(np.sqrt(3.0) * e)


def row(n, ms, substeps=4, benchmark=0, solver="xpbd", status="ok", wide=0.1, **more):
    found = {"scene": "hanging", "parameters": {"n": n}, "solver": solver, "options": {"substeps": substeps, "iterations": 5}}
    found |= {"label": f"{solver} {substeps}×5", "device": "cpu", "dtype": "float32", "benchmark": benchmark, "status": status}
    found |= {"reason": "", "vertices": n * n, "substeps": substeps, "iterations": 5.0, "ms": ms, "spread": None, "bytes": 100}
    found |= {"launches": 10.0, "start_s": 1.0, "memory": 1000, "copies": 1, "threads": 1, "cloths_per_s": ms and 1e3 / ms}
    return found | ({"spread": [(1 - wide) * ms, (1 + wide) * ms]} if ms else {}) | more


def result(*rows, processor="p"):
    return {"machine": {"processor": processor, "device": "cpu"}, "rows": list(rows)}


def test_growth_of_frames_and_of_iterations():
    """Substeps that grow with n: a frame as n³, an iteration as n²; other benchmarks, and what failed, are apart."""
    rows = [row(n, 0.1 * n**3, substeps=n) for n in (4, 8, 16)]
    rows += [row(32, None, substeps=32, status="refused"), row(4, 1.0, benchmark=1), row(8, 4.0, benchmark=2)]
    (one,) = growth(rows)
    assert one["frame"] == pytest.approx([1.5, 0.0], abs=1e-9) and one["iteration"] == pytest.approx([1.0, 0.0], abs=1e-9)
    assert one["options"] == {"iterations": 5} and one["solver"] == "xpbd"


OLD = result(row(4, 1.0), row(8, 4.0), row(16, 16.0), row(32, 64.0), row(6, None, status="refused"))
NEW = result(
    row(4, 0.5, launches=5.0, memory=None),
    row(8, 8.0),
    row(16, 17.0),
    row(6, 1.0),
    row(4, 1.0, solver="pbd"),
    row(32, None, status="refused"),
)


def test_ratios():
    found = {each["parameters"]["n"]: each for each in ratios(OLD, NEW)}
    assert list(found) == [4, 8, 16]
    assert [each["verdict"] for each in found.values()] == ["faster", "slower", ""]
    assert [each["ratio"] for each in found.values()] == pytest.approx([0.5, 2.0, 17 / 16])
    assert found[4]["spread"] == pytest.approx([0.5 * 0.9 / 1.1, 0.5 * 1.1 / 0.9]) and found[4]["ms"] == [1.0, 0.5]
    assert (found[4]["launches"], found[4]["memory"], found[8]["bytes"]) == (0.5, None, 1.0)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with results old.json, new.json and such that are none."""
    monkeypatch.chdir(tmp_path)
    files = {"old": json.dumps(OLD), "new": json.dumps(NEW), "alone": json.dumps(result(row(5, 1.0)))}
    files["before"] = json.dumps(
        result(*({k: v for k, v in each.items() if k not in ("copies", "threads")} for each in OLD["rows"]))
    )
    files |= {"text": "no result", "list": "[]", "rows": '{"rows": [{}], "machine": {}}', "number": '{"rows": 3}'}
    files |= {"twice": '{"rows": [], ' + json.dumps(NEW)[1:], "deep": "[" * 100_000, "digits": "1" * 5001}
    for name, text in files.items():
        (tmp_path / f"{name}.json").write_text(text, encoding="utf-8")
    return tmp_path


def test_the_command_compares(folder, capsys):
    assert main(["bench", "--compare", "old.json", "new.json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 7 and "hanging n=16" in lines[3]
    assert lines[1].split()[-1] == "faster" and lines[2].split()[-1] == "slower" and "–" in lines[1]
    assert lines[4:] == [
        "slower by more than the spread: xpbd 4×5 hanging n=8",
        "faster by more than the spread: xpbd 4×5 hanging n=4",
        "5 rows have no partner that was measured",
    ]
    (folder / "other.json").write_text(json.dumps({**NEW, "machine": {"processor": "q", "device": "cpu"}}), encoding="utf-8")
    assert main(["bench", "--compare", "old.json", "other.json"]) == 0
    assert capsys.readouterr().out.startswith("processor: p and q, so that times say little of the code\n")
    for old in ("old.json", "before.json"):  # a row without these columns has one of each
        assert main(["bench", "--compare", old, "new.json", "--json"]) == 0
        assert [each["verdict"] for each in json.loads(capsys.readouterr().out)["rows"]] == ["faster", "slower", ""]


@pytest.mark.slow
def test_the_command_measures(folder, device, capsys):
    environment = dict(os.environ)
    command = ["bench", "hanging", "-p", "bending=0", "--solver", "explicit", "--sizes", "6", "4", "6", "--frames", "3"]
    assert main([*command, "--device", device, "--csv", "table.csv", "--json"]) == 0
    assert dict(os.environ) == environment
    found = json.loads(capsys.readouterr().out)
    assert {"date", "machine", "bandwidth", "rows", "growth"} == set(found) and found["machine"]["device"]
    small, large = found["rows"]
    assert [row["parameters"]["n"] for row in (small, large)] == [4, 6] and small["vertices"] == 16
    assert small["options"]["substeps"] < large["options"]["substeps"]
    # Of an odd number of steps on CUDA one copy a frame is more.
    assert all(1.0 <= row["launches"] <= 1.0 + 1.0 / row["options"]["substeps"] for row in (small, large))
    assert small["cold_start_s"] > 0.0 and large["cold_start_s"] is None
    assert found["growth"][0]["frame"][1] is None
    table = list(csv.DictReader((folder / "table.csv").open(encoding="utf-8")))
    assert [(line["elements"], line["bytes"]) for line in table] == [
        (str(r["elements"]), str(r["bytes"])) for r in found["rows"]
    ]
    assert float(table[0]["ms_low"]) <= float(table[0]["ms"]) <= float(table[0]["ms_high"])


def test_the_command_measures_copies(device, capsys, monkeypatch):
    monkeypatch.setattr(benchmarks, "_alone", lambda asked: asked.run())  # in this process, which has the kernels
    command = ["bench", "hanging", "-p", "n=4", "--solver", "pbd", "--copies", "3", "--frames", "3", "--device", device]
    assert main([*command, "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["rows"]
    assert found["copies"] == 3 and found["vertices"] == 3 * 16
    assert found["dtype"] == ("float64" if device == "cpu" else "float32")  # as in a run
    assert found["cloths_per_s"] == pytest.approx(3e3 / found["ms"])
    assert not ratios(result(found), result({**found, "copies": 1}))


def rows_until(stop, error):
    """Something in place of `benchmarks._alone`: made-up rows, and an error when so many are done."""
    state = {"rows": 0}

    def alone(asked):
        if asked.function.endswith("bandwidth:measure"):
            return {"copy": 1e9, "kernel": 2e9}
        frames = asked.arguments["frames"]
        if state["rows"] == stop:
            raise error
        state["rows"] += frames > 0
        found = row(asked.arguments["scene"]["parameters"]["n"], 1.0, frames=3, elements=5, ns=1.0, bytes_per_s=1e9)
        found["label"] = asked.arguments["setup"]["solver"]
        return found | {"bind_s": 0.1, "factorise_s": 0.0}

    return alone


@pytest.mark.parametrize(
    ("stop", "error", "said", "code"),
    [
        (2, KeyboardInterrupt(), "interrupted after 2 of 3 rows, which are printed", 130),
        (0, KeyboardInterrupt(), "interrupted before the first row; nothing was measured", 130),
        (2, MemoryError(), "not enough memory", 2),
    ],
)
def test_what_ends_early_keeps_the_rows(stop, error, said, code, folder, monkeypatch, capsys):
    monkeypatch.setattr(benchmarks, "_alone", rows_until(stop, error))
    command = ["bench", "hanging", "--solver", "xpbd", "--sizes", "4", "6", "8", "--csv", "t.csv"]
    assert main(command) == code
    out, err = capsys.readouterr()
    assert said in err and err.count("\n") == 1
    assert (out.count("\nhanging n="), (folder / "t.csv").exists()) == (stop, stop > 0)
    if stop:
        assert "vertices^0.00" in out and "50 %" in out
        assert len((folder / "t.csv").read_text().splitlines()) == 1 + stop


def test_refused_and_diverged_rows(folder, monkeypatch, capsys):
    """One that diverged gives 1; what was refused or is not usable is marked; where all are refused, that is all there is."""
    refused = row(4, None, status="refused", reason="too large", share=None, cold_start_s=None, start_s=None)
    table = [
        (["ok", "diverged"], 1, "warpcloth: diverged: xpbd hanging n=6\n"),
        (["refused", "ok"], 0, ""),
        (["refused", "not usable"], 0, ""),
        (["refused", "refused"], 2, "warpcloth: too large\n"),
    ]
    for statuses, code, said in table:
        made = rows_until(-1, None)

        def alone(asked, made=made, statuses=statuses):
            found = made(asked)
            if "scene" not in asked.arguments:
                return found
            status = statuses[[4, 6].index(asked.arguments["scene"]["parameters"]["n"])]
            more = {"grade": status} if status == "not usable" else {"status": status}
            return found | (refused | {"bytes_per_s": None} if status == "refused" else more)

        monkeypatch.setattr(benchmarks, "_alone", alone)
        assert main(["bench", "hanging", "--solver", "xpbd", "--sizes", "4", "6"]) == code
        out, err = capsys.readouterr()
        assert err == said and ("refused: too large" in out) == (code == 0)
        assert ("not usable" in out) == ("not usable" in statuses)


def test_each_benchmark_begins_with_an_empty_kernel_cache(monkeypatch):
    made, seen = rows_until(-1, None), []

    def alone(asked):
        if "scene" in asked.arguments:
            folder = os.environ["WARP_CACHE_PATH"]
            seen.append((folder, os.listdir(folder), asked.arguments["frames"]))
            open(os.path.join(folder, str(len(seen))), "w").close()
        return made(asked)

    monkeypatch.setattr(benchmarks, "_alone", alone)
    monkeypatch.setenv("WARP_CACHE_PATH", "before")
    Run([SolverBenchmark(SceneRef("hanging"), Setup("pbd", {"substeps": 1}), (4, 6), frames=5)] * 2).measure()
    assert os.environ["WARP_CACHE_PATH"] == "before" and not any(os.path.exists(folder) for folder, _, _ in seen)
    assert [(len(files), frames) for _, files, frames in seen] == [(0, 0), (1, 5), (2, 5)] * 2
    assert len({folder for folder, _, _ in seen[:3]}) == 1 and seen[0][0] != seen[3][0]


def test_variants_are_compiled_before_they_are_measured(monkeypatch):
    made, asked = rows_until(-1, None), []

    def alone(one):
        asked.append((one.arguments.get("scene", {}).get("parameters"), one.arguments.get("frames")))
        return made(one)

    monkeypatch.setattr(benchmarks, "_alone", alone)
    run = Run([SolverBenchmark(SceneRef("hanging", {"n": 7}), Setup("pbd", {"substeps": 1}), variants=({"n": 4}, {"n": 6}))])
    run.measure()
    assert asked[1:] == [({"n": 4}, 0), ({"n": 4}, 20), ({"n": 6}, 0), ({"n": 6}, 20)] and run.total == 2
    assert [row["cold_start_s"] is None for row in run.rows] == [False, True]


def test_scenes_without_sizes_are_taken_as_they_are(monkeypatch, tmp_path):
    made = rows_until(-1, None)
    monkeypatch.setattr(benchmarks, "_alone", made)
    run = Run([SolverBenchmark(SceneRef("hanging", {"n": 7}), Setup("pbd", {"substeps": 1}))])
    run.measure()
    assert run.total == len(run.rows) == 1 and run.rows[0]["parameters"] == {"n": 7}
    write_csv(tmp_path / "t.csv", run.rows)
    assert growth(run.rows) == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("bench hangin", "there is no scene 'hangin'"),
        ("bench hanging --sizes 0", "sizes is 0; it must be a whole number of 2 or more"),
        ("bench hanging --sizes many", "invalid int value: 'many'"),
        ("bench hanging --frames 0", "frames is 0; it must be a whole number of 1 or more"),
        ("bench hanging --copies 0", "copies is 0; it must be a whole number of 1 or more"),
        ("bench hanging --solver simplex", "invalid choice: 'simplex'"),
        ("bench hanging --dtype float16", "invalid choice: 'float16'"),
        ("bench hanging --device gpu", "device is 'gpu'"),
        ("bench hanging -s tolerances=1", "Newton has no option 'tolerances'"),
        ("bench hanging -s substeps=0", "substeps is 0"),
        ("bench hanging -p m=3", "has no parameter 'm'"),
        ("bench flag --sizes 4 -p m=3", "has no parameter 'm'"),
        ("bench bunny --sizes 4", "bunny has no resolution to vary; none of its parameters is n or links or elements"),
        ("bench hanging --csv none/t.csv", "none does not exist"),
        ("bench --sizes 4", "--sizes is given without SCENE, which must stand before it"),
        ("bench -p n=4", "-p is given without SCENE"),
        ("bench --solver xpbd", "--solver is given without SCENE"),
        ("bench --compare old.json", "expected 2 arguments"),
        ("bench hanging --compare old.json new.json", "SCENE is given beside --compare"),
        ("bench --compare old.json new.json --csv t.csv", "--csv is given beside --compare"),
        ("bench --compare old.json new.json --copies 2", "--copies is given beside --compare"),
        ("bench --compare old.json new.json --device cuda:0", "--device is given beside --compare"),
        ("bench --compare old.json none.json", "none.json: No such file"),
        ("bench --compare old.json text.json", "text.json: is no result of benchmarks"),
        ("bench --compare list.json new.json", "list.json: is no result of benchmarks"),
        ("bench --compare rows.json new.json", "rows.json: is no result of benchmarks"),
        ("bench --compare number.json new.json", "number.json: is no result of benchmarks"),
        *(
            (f"bench --compare old.json {name}.json", f"{name}.json: is no result of benchmarks")
            for name in ("twice", "deep", "digits")
        ),
        ("bench --compare old.json alone.json", "have no row in common that was measured in both"),
    ],
)
def test_wrong_use(words, said, folder, capsys):
    before = sorted(folder.iterdir())
    assert main(words.split()) == 2
    out, err = capsys.readouterr()
    assert said in err and err.count("\n") == 1 and not out and sorted(folder.iterdir()) == before
