"""The choice of a solver from recorded measurements."""

import csv
import itertools
import json
import re
import runpy
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from warpcloth.chart.cheapest import text_of_cell
from warpcloth.cli import main
from warpcloth.cli.choose import command_line
from warpcloth.lab import campaign, choosing, own_reference, trajectory
from warpcloth.lab.campaign import Store
from warpcloth.lab.cheapest import cheapest_of_each
from warpcloth.lab.choosing import Longest, Measured, choose, climb, climb_others, ladders, ladders_of_others, pick, run_limit
from warpcloth.lab.measurements import SceneRef, Setup
from warpcloth.lab.reference import Reference
from warpcloth.lab.setups import grid_in_words, setups_of_runs
from warpcloth.lab.side_by_side import nearest_setting, side_by_side

# hanging, 64 × 64 vertices: error and ms a frame, with quartiles, of ladders from coarse to fine.
TABLE = {
    ("explicit", 152): (0.0032, 46.0, (45.0, 48.0)),
    ("xpbd", 20): (0.031, 21.0, (20.0, 22.0)),
    ("xpbd", 40): (0.016, 42.0, (41.0, 44.0)),
    ("xpbd", 80): (0.0079, 84.0, (82.0, 88.0)),
    ("xpbd", 160): (0.004, 168.0, (165.0, 171.0)),
    ("newton", 4): (0.0075, 477.0, (470.0, 490.0)),
    ("newton", 8): (0.0040, 900.0, (890.0, 950.0)),
    ("pbd", 10): (None, None, None),
    ("pbd", 120): (0.009, 47.0, (44.0, 50.0)),
}


def measured(setup):
    error, milliseconds, spread = TABLE[setup.solver, setup.options["substeps"]]
    return Measured(setup, error, milliseconds, spread, "" if error else "diverged in frame 3")


LADDERS = [
    [Setup(solver, {"substeps": substeps}) for _, substeps in rungs]
    for solver, rungs in itertools.groupby(TABLE, key=lambda key: key[0])
]
ALL = [measured(setup) for ladder in LADDERS for setup in ladder]


def name(choice):
    return str(choice.chosen.setup) if choice.chosen else None


@pytest.mark.parametrize(
    ("options", "chosen", "meets"),
    [
        ({"tolerance": 0.01}, "explicit substeps=152", True),
        ({"tolerance": 0.05}, "xpbd substeps=20", True),
        ({"tolerance": 0.01, "floor": 0.002}, "explicit substeps=152", True),
        ({"tolerance": 0.0035, "floor": 0.002}, "explicit substeps=152", False),
        ({"tolerance": 0.01, "budget": 46.0}, "explicit substeps=152", True),
        ({"tolerance": 0.01, "budget": 30.0}, "xpbd substeps=20", False),
        ({"tolerance": 0.001}, "explicit substeps=152", False),
        ({"budget": 45.0}, "xpbd substeps=40", True),
        ({"budget": 1.0}, None, False),
        ({"tolerance": 0.01, "budget": 1.0}, None, False),
    ],
)
def test_the_cheapest_that_meets_it(options, chosen, meets):
    choice = pick(ALL, **options)
    assert (name(choice), choice.meets) == (chosen, meets)


@pytest.mark.parametrize("options", [{"tolerance": t} for t in (0.1, 0.03, 0.01, 0.005, 0.001)] + [{"budget": 45.0}])
def test_climbing_picks_the_same_and_measures_no_more_than_it_needs(options):
    said, asked = [], []

    def measure(setups):
        asked.extend(setups)
        return [measured(setup) for setup in setups]

    choice, found = climb(LADDERS, measure, **options, progress=said.append)
    assert name(choice) == name(pick(ALL, **options))
    assert len(asked) == len(set(map(str, asked))) == len(found) and said[-1] == found
    if options == {"tolerance": 0.01}:
        # xpbd 80 meets it, and newton 4 is dearer than what does.
        left_out = {str(setup) for ladder in LADDERS for setup in ladder} - {str(setup) for setup in asked}
        assert left_out == {"xpbd substeps=160", "newton substeps=8"}


def test_solvers_of_others_are_searched_for_their_own_cheapest():
    """Newton's 4 is measured, though explicit 152 is cheaper; without time, what is left is not measured and not kept."""

    def measure(setups):
        return [replace(measured(setup), seconds=1.0) for setup in setups]

    found, ended = climb_others(LADDERS, measure, 0.01)
    left_out = {str(setup) for ladder in LADDERS for setup in ladder} - {str(each.setup) for each in found}
    assert left_out == {"xpbd substeps=160", "newton substeps=8"}
    assert ended["xpbd"] == "3 settings in 3 s; other settings cost more"
    found, ended = climb_others(LADDERS, measure, 0.001, seconds=1.5)
    assert [each.setup.options["substeps"] for each in found if each.setup.solver == "xpbd"] == [20, 40]
    assert ended["xpbd"] == "2 settings in 2 s; the time of 1.5 s is used up"
    assert ended["explicit"] == "1 settings in 1 s; finer settings take too long or are refused"
    found, ended = climb_others(
        LADDERS, lambda setups: [replace(measured(each), final=True, status="left") for each in setups], 0.01
    )
    assert found == [] and set(ended.values()) == {"0 settings in 0 s; the total time is used up"}


def test_the_total_time_also_ends_the_own_motions_of_others(tmp_path, monkeypatch):
    """It is used up when the reference is known: no setting is measured, and a motion ends at its first frame."""
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    scene, setups = SceneRef("chain", {"links": 5}), [Setup("explicit", {"substeps": 200})]
    setups += [Setup(f"newton-{name}", {"substeps": 2, "iterations": 2}) for name in ("vbd", "xpbd")]
    exact = SimpleNamespace(error=1e-5, points=np.zeros((3, 6, 3)), path="none", key="none")
    ran = []

    def run(scene, record, device, frames, watch):
        ran.append(record.method)
        watch(0, frames)

    monkeypatch.setattr(choosing, "reference", lambda *given, **options: exact)
    monkeypatch.setattr(choosing, "setups_of_runs", lambda *given: setups)
    monkeypatch.setattr(own_reference, "run_other", run)
    found, measured, _ = choose(scene, tolerance=0.01, others=["newton"], total=1e-9)
    facts = {"cut": True, "searched": "0 settings in 0 s; the total time is used up"}
    assert found.chosen is None and found.others == {"newton-vbd": facts, "newton-xpbd": facts}
    assert ran == ["vbd", "xpbd"] and {each.status for each in measured} == {"left"}


def test_the_longest_time():
    """For a solver of another simulator: twelve limits for its own reference, six for its search, and one for its last run."""
    assert Longest(10.0, 3, 2).seconds == 50.0 + 30.0 + 2 * 190.0


def test_all_simulators_that_are_lacking_are_named(monkeypatch):
    for module in ("newton", "pypbd", "uipc"):
        monkeypatch.setitem(sys.modules, module, None)
    words = r"-e '\.\[newton\]' in the checkout; .* pyPBD needs it: .* -e '\.\[pbd\]' .*; .* -e '\.\[uipc\]' in the checkout"
    with pytest.raises(ImportError, match=words):
        setups_of_runs(SceneRef("hanging"), others=["newton", "pbd", "uipc"])


def test_ladders_of_others_double_substeps_and_iterations():
    setups = [Setup("newton-vbd", {"substeps": s, "iterations": i}) for s, i in ((3, 2), (8, 2), (3, 5))]
    found = [[(each.options["substeps"], each.options["iterations"]) for each in one] for one in ladders_of_others(setups)]
    assert [one[0] for one in found] == [(3, 2), (3, 5), (3, 10), (3, 20)]
    assert found[0] == [(s, 2) for s in sorted([8, *(3 * 2**k for k in range(11))])]
    (alone,) = ladders_of_others([Setup("newton-semi-implicit", {"substeps": 7})])
    assert [each.options for each in alone] == [{"substeps": 7 * 2**k} for k in range(11)]
    assert grid_in_words([{"substeps": 4, "iterations": 2}, {"substeps": 2, "iterations": 2}, {"substeps": 9}]) == "9; 2, 4 × 2"


def test_the_cheapest_of_each_solver():
    """For 0.45 % xpbd needs 160 steps and newton 8; a reference that is known to 0.06 % leaves explicit steps alone."""
    best = cheapest_of_each(ALL, 0.0045, 0.0)
    assert [str(each.setup) for each in best] == ["explicit substeps=152", "xpbd substeps=160", "newton substeps=8"]
    assert cheapest_of_each(ALL, 0.0045, 0.0006) == best[:1]


@pytest.mark.parametrize("reason", ["slow", "diverged"])
def test_a_ladder_ends_where_finer_steps_are_no_help(reason):
    """A setting that took too long, or is refused for its method, is not tried with more steps; one that diverged is."""
    rungs = [Setup("newton", {"substeps": n}) for n in (1, 2, 4)]
    _, found = climb(
        [rungs], lambda setups: [Measured(setup, None, 100.0, None, reason, final=reason == "slow") for setup in setups], 0.01
    )
    assert len(found) == (1 if reason == "slow" else 3)


@pytest.fixture
def in_a_thread(monkeypatch):
    """Measures in a thread of this process; test_extending.py has the command start one."""
    monkeypatch.setattr(campaign, "processes", lambda workers: ThreadPoolExecutor(1))


@pytest.mark.usefixtures("in_a_thread")
def test_refused_methods_are_asked_once(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    hard = SceneRef("chain", {"links": 3, "stiffness": "inf"})
    choice, found, _ = choose(hard, 0.05, solvers=["newton", "pbd", "xpbd"], frames=4, store=Store(), workers=1)
    newton = [each for each in found if each.setup.solver == "newton"]
    assert choice.meets and len(newton) == 6 and all(each.final and "infinite stiffness" in each.reason for each in newton)


def test_the_sentence_where_nothing_meets_it_says_why():
    """It is not said that nothing meets it where the budget or the reference is why."""
    assert "within the budget meets 1%; the most accurate comes to 3.1%" in pick(ALL, tolerance=0.01, budget=30.0).certainty
    said = pick(ALL, tolerance=0.0035, floor=0.002).certainty
    assert "meets 0.35%; the most accurate comes to 0.32%, and the reference is known to 0.2% only" in said
    assert "only" not in pick(ALL, tolerance=0.001).certainty
    assert "0.00032%" in pick([Measured(ALL[0].setup, 3.2e-6, 1.0, (1.0, 1.0))], tolerance=1e-5).certainty


def test_rivals_are_those_whose_times_overlap():
    choice = pick(ALL, tolerance=0.01)
    assert [str(each.setup) for each in choice.rivals] == ["pbd substeps=120"]
    assert "within the spread of the times as cheap: pbd substeps=120 (47 ms)" in choice.certainty
    assert pick(ALL, tolerance=0.05).rivals == [] and "nothing else" in pick(ALL, tolerance=0.05).certainty


def graded(*doubted):
    """All measurements, of which those of the settings named are not usable."""
    return [replace(each, grade="not usable" if str(each.setup) in doubted else "completed") for each in ALL]


EXPLICIT, PBD = "explicit substeps=152", "pbd substeps=120"


@pytest.mark.parametrize(
    ("options", "doubted", "chosen", "rivals", "said"),
    [
        ({"tolerance": 0.01}, [PBD], EXPLICIT, [PBD], False),
        ({"tolerance": 0.01}, [EXPLICIT], PBD, [EXPLICIT], False),
        ({"tolerance": 0.01}, [EXPLICIT, PBD], EXPLICIT, [PBD], True),
        ({"tolerance": 0.05}, ["xpbd substeps=20"], "xpbd substeps=20", [], True),
        ({"tolerance": 0.001}, [EXPLICIT], EXPLICIT, [], True),
        ({"budget": 45.0}, ["xpbd substeps=40"], "xpbd substeps=40", [], True),
        ({"budget": 45.0, "floor": 0.02}, ["xpbd substeps=40"], "xpbd substeps=20", ["xpbd substeps=40"], False),
    ],
)
def test_a_setting_that_is_not_usable_is_chosen_where_no_other_is_as_good(options, doubted, chosen, rivals, said):
    """Its error is measured, so it meets a tolerance; one that is usable and as cheap, or as accurate, is taken before it."""
    choice = pick(graded(*doubted), **options)
    assert (name(choice), [str(each.setup) for each in choice.rivals]) == (chosen, rivals)
    assert ("its run is not usable, so 'warpcloth run' ends with exit code 1" in choice.certainty) == said
    assert pick(ALL, **options) == pick([replace(each, grade=None) for each in graded()], **options)  # stored before grades


def test_the_table_marks_settings_that_are_not_usable(tmp_path, monkeypatch, capsys):
    exact = SimpleNamespace(points=np.zeros((3, 1, 3)), error=0.0, path=tmp_path)
    found = graded("xpbd substeps=20")
    monkeypatch.setattr(choosing, "choose", lambda *_, **options: (pick(found, options.get("tolerance") or 0.05), found, exact))
    assert main(["choose", "hanging", "--tolerance", "5%"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[-3:] for line in lines if "not usable" in line][:1] == [["not", "usable", "chosen"]]
    assert sum(line.startswith("  ") and "not usable" in line for line in lines) == 1
    assert main(["choose", "hanging", "--tolerance", "5%", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert [each["label"] for each in facts["measured"] if each["grade"] == "not usable"] == ["xpbd substeps=20"]


def test_what_is_refused():
    for options in ({}, {"tolerance": 0.0}, {"budget": -1.0}, {"tolerance": "1%"}):
        with pytest.raises(ValueError, match=r"tolerance|budget"):
            pick(ALL, **options)
    assert pick([], tolerance=0.1).chosen is None and "nothing was measured" in pick([], tolerance=0.1).certainty


def test_ladders_are_of_one_method_each_and_go_on():
    setups = [Setup("xpbd", {"substeps": n, "iterations": 1}) for n in (40, 10)] + [
        Setup("xpbd", {"substeps": 5, "iterations": 2})
    ]
    found = [[setup.options["substeps"] for setup in ladder] for ladder in ladders(setups)]
    assert found == [[10, 40, 80, 160, 320], [5, 10, 20, 40]]
    (by_error, by_steps) = ladders([Setup("newton", {"error": e}) for e in (1e-4, 1e-3)] + [Setup("newton", {"substeps": 4})])
    assert [setup.options["error"] for setup in by_error] == pytest.approx([1e-3, 1e-4, 2.5e-5, 6.25e-6, 1.5625e-6])
    assert [setup.options for setup in by_steps] == [{"substeps": n} for n in (4, 8, 16, 32)]


def test_runs_end_soon_after_the_cheapest_that_meets_it():
    """20 frames of 10 ms, three times and 1 s, are 1.6 s: a limit of 60 s is halved five times, one of 1 s is kept."""
    assert [run_limit(60.0, 20, meeting) for meeting in ([], [50.0, 10.0], [1e5])] == [60.0, 1.875, 60.0]
    assert run_limit(1.0, 20, [10.0]) == 1.0


@pytest.mark.parametrize(("limit", "why"), [(np.inf, "smaller steps make it no less"), (300.0, "halved for 300 s")])
def test_nothing_is_measured_if_the_reference_cannot_tell(limit, why, tmp_path, monkeypatch, capsys):
    points = np.zeros((5, 2, 3))
    facts = {"strain_error": 0.0, "substeps": 64, "seconds": 1.0, "path": "", "key": "", "scene": "", "method": "Newton"}
    exact = Reference(points=points, times=np.arange(5.0), error=0.02, limit=limit, **facts)
    monkeypatch.setattr(choosing, "reference", lambda *given, **options: exact)
    choice, found, _ = choose(SceneRef("chain", {"links": 3}), 0.01, solvers=["newton"], frames=4, store=Store())
    assert (choice.chosen, choice.meets, found) == (None, False, []) and choice.untried > 0
    assert "is known to 2% only (Newton, 64 substeps" in choice.certainty and why in choice.certainty
    compared = side_by_side(SceneRef("chain", {"links": 3}), [], 0.01, solvers=["newton"], frames=4, store=Store())
    assert compared["ratios"] == [] and nearest_setting(compared).startswith(
        "no setting of warpcloth has an error; the reference"
    )
    (tmp_path / "compared.json").write_text(json.dumps(compared | {"machine": {"device": "cuda:0", "warp": "1"}}))
    (tmp_path / "failed.json").write_text(json.dumps({"scene": "fold", "frames": 2, "device": "cpu", "failed": "it is slow"}))
    monkeypatch.setattr(sys, "argv", ["compared", "--stored", *map(str, sorted(tmp_path.iterdir()))])
    runpy.run_path(COMPARED, run_name="__main__")
    said = capsys.readouterr().out
    assert "no setting of warpcloth has an error" in said and "fold, 2 frames, cpu: no result, because it is slow" in said
    compared["rows"] = [{"solver": "pbd", "label": f"pbd {error}", "error": error} for error in (0.05, 0.03, None)]
    assert "meets 1%; nearest is pbd 0.03 with 3%" in nearest_setting(compared)
    assert nearest_setting({"ratios": [{"solver": "pbd"}]}) == ""


COMPARED = str(Path(__file__).parents[2] / "benchmarks" / "compared.py")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--solvers newtons", "solvers is 'newtons'; it must be one of 'explicit'"),
        ("--total 0", "total is 0.0; it must be a number above 0"),
        ("--limit nan", "limit is nan; it must be a number above 0"),
        ("--frames 0", "frames is 0; it must be a whole number of 1 or more"),
        ("--tolerance -1", "tolerance is -1.0; it must be a number above 0"),
        ("--device cpux", "cpux"),
        ("-p m=4", "has no parameter 'm'"),
        ("--total 1e-9", None),
    ],
)
def test_the_benchmark_stores_a_lack_of_a_reference_and_refuses_wrong_use(words, said, tmp_path, monkeypatch, capsys):
    """An older result stays after wrong use; the chart of an older result does not stay beside a result without one."""
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("warpcloth.lab.setups.check_installed", lambda names: None)
    result, chart = tmp_path / "hanging.json", tmp_path / "hanging.png"
    result.write_text("{}")
    chart.touch()
    monkeypatch.setattr(sys, "argv", [COMPARED, *"--scene hanging -p n=4 --out".split(), str(tmp_path), *words.split()])
    if said is None:
        runpy.run_path(COMPARED, run_name="__main__")
        assert "the reference of hanging needs more than 3.33333e-10 s" in json.loads(result.read_text())["failed"]
        assert "no result, because the reference" in capsys.readouterr().out and not chart.exists()
    else:
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(COMPARED, run_name="__main__")
        err = capsys.readouterr().err
        assert ended.value.code == 2 and said in err and err.count("\n") == 1
        assert result.read_text() == "{}" and chart.exists()


SCENES = [
    pytest.param("hanging", {"n": 6}, 12, marks=pytest.mark.slow),
    ("chain", {"links": 5}, 12),
    pytest.param("cantilever", {"elements": 6}, 10, marks=pytest.mark.slow),  # with all solvers
]


@pytest.mark.parametrize(("scene", "parameters", "frames"), SCENES)
@pytest.mark.usefixtures("in_a_thread")
def test_the_choice_meets_the_tolerance_when_it_is_run_afresh(scene, parameters, frames, tmp_path, monkeypatch):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    solvers = ["explicit", "xpbd", "newton"] if frames == 12 else None
    scene = SceneRef(scene, parameters)
    choice, found, exact = choose(scene, 0.01, solvers=solvers, frames=frames, store=Store(), workers=1)
    again = trajectory.measure(asdict(scene), asdict(choice.chosen.setup), reference=str(exact.path))
    assert choice.meets and again["error"] + exact.error <= 0.01
    assert again["error"] == pytest.approx(choice.chosen.error, rel=1e-6)
    cheaper = [each for each in found if each.milliseconds and each.milliseconds < choice.chosen.milliseconds]
    cheaper = [each for each in cheaper if each.usable or not choice.chosen.usable]
    assert not any(each.error is not None and each.error + exact.error <= 0.01 for each in cheaper)


@pytest.mark.usefixtures("in_a_thread")
def test_the_command(tmp_path, monkeypatch, capsys):
    """It prints the command to use, which works; the second time nothing is measured; run takes the choice."""
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    command = ["choose", "hanging", "-p", "n=5", "--tolerance", "1%", "--frames", "6", "--solvers", "xpbd", "explicit"]
    assert main(command) == 0
    said, text = capsys.readouterr()
    count = re.fullmatch(
        r"warpcloth: takes at most (.*) min, .*: 5 min for the reference, 60 s for each of (\d+) settings\n", text
    )
    assert float(count[1]) == 5 + int(count[2]) > 5
    last = said.splitlines()[-1].split()
    # What was measured are 6 frames: what comes after may stray further.
    assert last[:5] == ["warpcloth", "run", "hanging", "-p", "n=5"] and last[-6:-4] == ["--frames", "6"]
    assert main(last[1:]) == 0
    stored = (tmp_path / "cache" / "trajectories.jsonl").read_text()
    capsys.readouterr()
    assert main([*command, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["meets"] and facts["chosen"]["error"] <= 0.01 and facts["command"].split() == last
    default = {"xpbd": "float64", "explicit": "float32"}
    assert all(each["dtype"] == default[each["setup"]["solver"]] for each in facts["measured"])
    assert last[last.index("--dtype") + 1] == default[facts["chosen"]["setup"]["solver"]]
    assert (tmp_path / "cache" / "trajectories.jsonl").read_text() == stored
    run = ["run", "hanging", "-p", "n=5", "--frames", "6", "-o", "out.usdc"]
    assert main([*run, "--tolerance", "1%"]) == 0
    assert "warpcloth: chosen: " in capsys.readouterr().err


@pytest.mark.usefixtures("in_a_thread")
def test_the_command_takes_hard_constraints(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    words = "choose chain -p links=3 stiffness=inf --frames 4 --tolerance 5% --solvers pbd hierarchical-pbd"
    assert main(words.split()) == 0
    assert "links=3 stiffness=inf" in capsys.readouterr().out.splitlines()[-1]


MAP = "chart cheapest hanging --x n 4 5 --y stiffness 100 400 --frames 2 --solvers explicit pbd --json".split()


@pytest.mark.usefixtures("in_a_thread")
def test_the_map_of_the_cheapest(tmp_path, monkeypatch, capsys):
    """Each cell has what was measured in it, and is not measured again; the picture and the table have every cell."""
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    found = []
    for outputs in (["-o", "map.png"], ["--csv", "map.csv"]):
        assert main(MAP + outputs) == 0
        found.append(json.loads(capsys.readouterr().out))
    assert found[0] == found[1] and (tmp_path / "map.png").stat().st_size > 0
    assert found[0]["dtype"] == "float32 and float64"  # explicit and PBD
    cells = found[0]["cells"]
    assert [(cell["x"], cell["y"]) for cell in cells] == [("4", "100"), ("5", "100"), ("4", "400"), ("5", "400")]
    rows = list(csv.DictReader((tmp_path / "map.csv").open()))
    for cell, row in zip(cells, rows, strict=True):
        accurate = [
            each for each in cell["measured"] if each["error"] is not None and each["error"] + cell["reference_error"] <= 0.01
        ]
        assert cell["status"] == "found" and cell["complete"] and 0.0 < cell["reference_error"] < 0.002
        assert row["grade"] == cell["grade"] != "not usable" and "not usable" not in text_of_cell(cell)
        assert "not usable" in text_of_cell(cell | {"grade": "not usable"})
        assert cell["ms"] == min(each["milliseconds"] for each in accurate) == float(row["ms"])
        explicit = next(each["setup"]["options"] for each in accurate if each["setup"]["solver"] == "explicit")
        other = cell["second"] or {"options": None}
        assert explicit in (cell["options"], other["options"]) and cell["solver"] != other.get("solver")
        assert row["second_options"] == (json.dumps(other["options"]) if cell["second"] else "")
        assert (row["x_value"], row["y_value"], row["complete"]) == (cell["x"], cell["y"], "True")
        assert row["dtype"] == cell["dtype"] == ("float32" if cell["solver"] == "explicit" else "float64")
    steps = [each["setup"]["options"]["substeps"] for cell in cells for each in cell["measured"][:1]]
    assert steps[2] == pytest.approx(2.0 * steps[0], abs=1.0)  # explicit steps grow with the root of the stiffness


@pytest.mark.parametrize(
    ("more", "status", "said"),
    [
        (["--solvers", "pbd", "--tolerance", "1e-6%"], "none", "no setting meets 1e-06%; pbd "),
        (["--limit", "1e-9"], "unknown", "the reference of hanging needs more than 6e-09 s"),
    ],
)
@pytest.mark.usefixtures("in_a_thread")
def test_cells_without_an_accurate_setting_say_why(more, status, said, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    assert main([*"chart cheapest hanging --x n 4 --frames 2 --json".split(), *more]) == 0
    (cell,) = json.loads(capsys.readouterr().out)["cells"]
    assert cell["status"] == status and cell["reason"].startswith(said) and cell["ms"] is None and cell["grade"] is None
    assert " ".join(text_of_cell(cell)).startswith(said)


@pytest.mark.parametrize("more", [["-p", "n=9"], ["-p", "stiffness=1e3", "--y", "stiffness", "1e4"]])
def test_a_parameter_is_not_both_fixed_and_on_an_axis(more, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    assert main([*"chart cheapest hanging --x n 4 --frames 2".split(), *more]) == 2
    assert "given as a parameter of the scene and as" in capsys.readouterr().err


def test_an_interruption_says_what_is_kept(tmp_path, monkeypatch, capsys):
    def interrupted(tasks, progress, **_):
        progress(1, len(tasks), 2.0)
        raise KeyboardInterrupt
        yield

    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    monkeypatch.setattr("warpcloth.lab.campaign.sweep", interrupted)
    assert main("choose chain -p links=3 --frames 3 --tolerance 5% --solvers pbd".split()) == 130
    assert "settings that are measured are kept" in capsys.readouterr().err


def test_the_command_line_has_the_device():
    given = {"scene": "s.py", "p": [], "pins": "x < 1", "frames": None, "dtype": "float64", "imports": ["own.py"]}
    arguments = SimpleNamespace(**given, device="cuda:1")
    command = command_line(arguments, {}, Setup("pbd", {"substeps": 2}))
    assert "s.py --import own.py --pins 'x < 1'" in command and "--device cuda:1 --dtype float64" in command


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("choose hanging", "give one of them"),
        ("choose hanging --tolerance 0", "tolerance is 0.0; it must be a number above 0"),
        ("choose hanging --tolerance 5", "tolerance is 5, 5 times the whole"),
        ("choose hanging --budget fast", "budget"),
        ("choose hanging --budget 1ms --limit -3", "warpcloth: limit is -3.0; it must be a number above 0"),
        ("choose hanging --budget 1ms --frames 0", "warpcloth: frames is 0; it must be a whole number of 1 or more"),
        ("choose hanging --tolerance 1% --solvers newtons", "newtons"),
        ("chart cheapest hanging --x n", "--x has 'n' alone"),
        ("chart cheapest hanging --x n 4 --y n 5", "x and y are both n"),
        ("chart cheapest hanging --x m 4", "has no parameter 'm'"),
        ("chart cheapest hanging --x n four", "n is 'four'"),
        ("chart cheapest hanging --x n 4 --limit 0", "limit is 0.0"),
        ("run hanging --tolerance 1% --solver newton -o o.usdc", "--solver is given, and --tolerance or --budget chooses it"),
    ],
)
def test_wrong_use(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert main(words.split()) == 2
    text = capsys.readouterr().err
    assert said in text and "at most" not in text
