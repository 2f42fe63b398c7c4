"""Charts of speed against accuracy: the gap of one step, the error of a motion, the spectrum, and what is made of them."""

import contextlib
import csv
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from itertools import pairwise

import numpy as np
import pytest

import warpcloth as wc
from support.rows import slow_but
from warpcloth.base.digest import scene_digest
from warpcloth.chart import pareto, style
from warpcloth.cli import main
from warpcloth.lab import campaign, convergence, machine, spectrum, work_precision
from warpcloth.lab.campaign import Store
from warpcloth.lab.convergence import OneStep
from warpcloth.lab.measurements import SceneRef, Setup
from warpcloth.lab.setups import label, setups_of_runs, setups_of_steps
from warpcloth.lab.work_precision import (
    cheapest,
    front,
    quartiles,
    solver_diagram,
    spectrum_diagram,
    time_diagram,
    without_point,
    write_csv,
)
from warpcloth.solvers import SOLVERS
from warpcloth.solvers.explicit import step_limits

pytestmark = pytest.mark.host
SMALL, TOUCHING = SceneRef("hanging", {"n": 6}), SceneRef("incline", {"n": 4})
FRAME, SUBSTEPS = 12, 4
STEPS = setups_of_steps()


def measure(setup, device, scene=SMALL, **options):
    limit = 5.0 if device == "cpu" else 60.0  # of so few vertices an iteration takes a GPU ten times as long
    given = {"frame": FRAME, "substeps": SUBSTEPS, "device": device, "limit": limit, "repeats": 1} | options
    return convergence.measure(asdict(scene), scene_digest(scene.load()), asdict(setup), **given)


@pytest.fixture(autouse=True)
def cache_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path / "cache"))


# --- one step


def test_gap_is_that_of_the_objective_of_implicit_euler(device):
    """By φ of springs written out, at positions between x̃ and the minimiser, where ∇φ vanishes."""
    scene = replace(SMALL.load(), terms=SMALL.load().terms[:1])
    step = OneStep(scene, FRAME, SUBSTEPS, device)
    assert step.gap(np.zeros_like(step.best)) == 1.0 and abs(step.gap(step.best)) <= step.floor
    (springs,) = step.model.terms
    base, ends, rest = step.base.numpy(), springs.stencil.numpy(), springs.rest.numpy().ravel()

    def objective(d):
        lengths = np.linalg.norm(np.diff((base + d)[ends], axis=1)[:, 0], axis=1)
        inertia = (scene.vertex_masses[step.free, None] * d[step.free] ** 2).sum() / (2.0 * step.h**2)
        return inertia + 0.5 * 1e3 * ((lengths - rest) ** 2).sum()

    parts = np.array([0.0, 0.5, 1.0, 1.5])
    found = np.array([step.objective(part * step.best) for part in parts])
    assert found == pytest.approx([objective(part * step.best) for part in parts], rel=1e-12)
    # A minimum: φ at ½ and 3/2 is above it, by the same but for third derivatives.
    assert found[2] < found[1] < found[0] and found[3] - found[2] == pytest.approx(found[1] - found[2], rel=0.2)


@pytest.mark.parametrize("name", ["hanging", "flag"])
def test_state_is_that_of_the_run(name, device):
    """The next frame, with pins that move, is that of a run that goes on; rounded to float32 where the step begins."""
    scene = SceneRef(name, {"n": 6} if name == "hanging" else {}).load()
    newton = wc.Newton(substeps=4, tolerance=1e-9)
    step = OneStep(scene, 3, 4, device)
    stepper = wc.Newton(substeps=4, tolerance=1e-9).bind(scene.build(device=device, dtype="float64"))
    step.set_state(stepper)
    for _ in range(4):
        stepper.step()
    run = wc.simulate(scene, newton, frames=4, dtype="float64", device=device).points
    moved = np.abs(run[4] - run[3]).max()
    # Steps of 1/240 s have one minimum. The start is that of Newton at its default tolerance of 1e-3 g: 2e-7 m a step, and
    # float32's 1e-7 m.
    assert np.abs(stepper.state.x.numpy() - run[4]).max() < 1e-3 * moved


@pytest.mark.parametrize("setup", STEPS, ids=label)
def test_all_that_minimise_close_the_gap(setup, device):
    """Down to the rounding of φ in float64, or nearly so; no iteration of Newton or plain projective dynamics raises φ."""
    found = measure(setup, device, dtype="float64")
    gaps = [point["gap"] for point in found["points"]]
    print(label(setup), found["message"], len(gaps), gaps[0], gaps[-1], found["floor"])
    assert found["status"] == "ok" and found["floor"] < 1e-10
    assert min(gaps) < 1e-6 and gaps[0] > 1e3 * found["floor"] and found["compile_s"] > 0.0
    assert min(gaps) > -2.0 * found["floor"], "nothing is below the minimum"
    assert [point["iterations"] for point in found["points"]] == convergence.LADDER[: len(gaps)]
    if setup.solver in ("newton", "projective-dynamics") and "chebyshev" not in label(setup):
        assert all(later <= before + found["floor"] for before, later in pairwise(gaps))


@pytest.mark.parametrize(
    ("solver", "which"), slow_but([("newton", 0)], [("newton", 0), ("projective-dynamics", -1), ("xpbd", 0)])
)
def test_the_gap_closes_in_contact(solver, which, device):
    """Also where friction and contact are most of what is to be minimised."""
    found = measure(setups_of_steps([solver])[which], device, TOUCHING)
    assert found["status"] == "ok" and found["points"][-1]["gap"] <= max(found["floor"], 1e-12)


def test_float32_ends_where_its_rounding_is(device):
    """Both precisions have the same first iterations, and an end that more of them do not change."""
    single, double = (measure(STEPS[0], device, dtype=dtype) for dtype in ("float32", "float64"))
    gaps = [[point["gap"] for point in found["points"]] for found in (single, double)]
    assert gaps[0][0] == pytest.approx(gaps[1][0], rel=0.05)  # conjugate gradients end where they may
    assert single["message"].startswith("no nearer") and 0.0 < gaps[0][-1] < 1e-4
    assert len(gaps[0]) < 12, "Newton stops by itself, and more rungs are not tried"


def test_what_cannot_be_measured_says_why(device, monkeypatch, tmp_path):
    (tmp_path / "stiff.py").write_text(
        "import warpcloth as wc\n\ndef scene():\n    mesh = wc.Mesh.grid(3, 3)\n"
        "    term = wc.StVKMembrane(stiffness=100.0, poisson_ratio=0.3, damping=1.0)\n"
        "    return wc.Scene(mesh, density=0.1, terms=[term], pins=[0])\n"
    )
    stiff = SceneRef(str(tmp_path / "stiff.py"))
    refused = measure(Setup("xpbd"), device, stiff)
    assert refused["status"] == "refused" and "XPBD cannot take" in refused["reason"] and not refused["points"]
    slow = measure(Setup("xpbd"), device, limit=1e-9)
    assert slow["status"] == "slow" and "more than 1e-09 s" in slow["reason"] and len(slow["points"]) == 1
    monkeypatch.setattr(convergence, "LOST", 0.5)
    lost = measure(Setup("xpbd"), device)
    assert lost["status"] == "diverged" and "a gap of" in lost["reason"]
    with pytest.raises(ValueError, match="is another scene now"):
        convergence.measure(asdict(SMALL), "another", asdict(STEPS[0]), FRAME, SUBSTEPS, device)
    falling = replace(SMALL.load(), pins=None)
    with pytest.raises(ValueError, match="nothing to minimise"):
        OneStep(falling, 0, 1, device)


# --- the spectrum


def test_spectrum_of_one_spring(device):
    """Along it an iteration leaves nothing, across it k(L/l)/(m/h² + k) of the error (Bouaziz et al. 2014 for the matrix)."""
    mesh = wc.Mesh(np.array([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), edges=[[0, 1]])
    k, m = 300.0, 0.7
    scene = wc.Scene(mesh, masses=[m, m], positions=[[0, 0, 0], [0.6, -0.9, 0]], terms=[wc.Spring(stiffness=k)], pins=[0])
    step = OneStep(scene, 0, 1, device)
    length = np.linalg.norm((step.base.numpy() + step.best)[1])
    mu, V, A = spectrum.relative_spectrum(step)
    assert step.roundings()[:, 1].any() and not step.roundings()[:, 0].any(), "a pin has no rounding"
    across = k / length / (m / step.h**2 + k)
    assert 1.0 - mu == pytest.approx([across, across, 0.0], rel=1e-12, abs=1e-12)
    assert V.T @ A @ V == pytest.approx(np.eye(3), abs=1e-12)


def test_errors_of_projective_dynamics_end_at_the_floor(device):
    """After all iterations that count its error is rounding, which the floor bounds, by less than a hundred times."""
    found = spectrum.measure(asdict(SMALL), scene_digest(SMALL.load()), FRAME, 16, device)
    step = OneStep(SMALL.load(), FRAME, 16, device)
    _mu, V, A = spectrum.relative_spectrum(step)
    rows, stepper = np.repeat(step.free, 3), spectrum._bound(step, 256, device)
    step.set_state(stepper)
    stepper.step()
    left, first = ((d.ravel()[rows] @ A @ V) for d in (step.correction(stepper) - step.best, step.best))
    assert 0.01 * found["floor"] < np.linalg.norm(left) / np.linalg.norm(first) < found["floor"] < spectrum.RESOLVED


@pytest.mark.parametrize(
    ("scene", "substeps"),
    [
        (SMALL, 4),
        pytest.param(SMALL, 16, marks=pytest.mark.slow),
        pytest.param(TOUCHING, 4, id="touching-4", marks=pytest.mark.slow),
    ],
    ids=lambda value: str(value),
)
def test_projective_dynamics_converges_as_its_spectrum_says(scene, substeps, device):
    """Terms of second order in the error are neglected: from 1e-2 on the prediction is off by less than 1e-2 of itself, and
    the last factor of an iteration, at errors of 1e-4 or less, by less than 1e-4 of 1 less it."""
    found = spectrum.measure(asdict(scene), scene_digest(scene.load()), FRAME, substeps, device, limit=np.inf)
    mu = np.array(found["eigenvalues"])
    assert 0.0 < mu[0] and mu[-1] <= 1.0 + 1e-12, "the matrix is never below the Hessian"
    known = [point for point in found["points"] if point["predicted"] is not None and point["error"] > spectrum.RESOLVED]
    assert len(known) >= 4 and known[-1]["error"] < 1e-5
    for point in known:
        assert point["predicted"] == pytest.approx(point["error"], rel=spectrum.LINEAR)
    assert 1.0 - found["measured"] == pytest.approx(1.0 - found["expected"], rel=1e-4)
    # Of the parts of the error the slowest is left in the end.
    assert found["measured"] == pytest.approx(found["contraction"], rel=0.05) and found["measured"] < found["contraction"]
    for before, last in pairwise(known):
        most = found["contraction"] ** (last["iterations"] - before["iterations"])
        assert last["error"] <= most * (1.0 + spectrum.LINEAR) * before["error"]


def test_a_step_without_a_spectrum_costs_no_other(tmp_path):
    """Of so little motion the shortest steps have nothing to minimise; of all, it is said."""
    still = {"n": 4, "stiffness": 1.0}
    with ThreadPoolExecutor(1) as executor:
        found = spectrum_diagram(SceneRef("hanging", still), frames=1, limit=0.2, executor=executor, store=Store())
        assert [row["status"] for row in found["rows"]].count("ok") in range(1, 5)
        assert "has nothing to minimise" in found["rows"][-1]["reason"] and without_point(found)
        pareto.plot_spectrum(tmp_path / "spectrum.png", found)
        hard = SceneRef("net", {"n": 4, "stiffness": "inf"})
        with pytest.raises(ValueError, match="Newton cannot take Spring with infinite stiffness"):
            spectrum_diagram(hard, frames=1, executor=executor, store=Store())


def test_spectrum_of_too_many_unknowns_is_refused(device):
    with pytest.raises(ValueError, match=r"hanging has 2694 unknowns; a spectrum takes at most 2000"):
        spectrum.relative_spectrum(OneStep(SceneRef("hanging", {"n": 30}).load(), 1, 1, device))


# --- settings


def test_settings_are_of_all_solvers_and_differ(device):
    setups = setups_of_runs(SMALL, device=device)
    assert {setup.solver for setup in setups} == set(SOLVERS)
    assert len({label(setup) for setup in setups}) == len(setups) and len({label(setup) for setup in STEPS}) == len(STEPS)
    assert all(setup.record().per_frame(60.0) for setup in setups)
    assert {setup.solver for setup in setups_of_runs(SMALL, ["pbd", "xpbd"])} == {"pbd", "xpbd"}
    assert [setup.solver for setup in setups_of_steps(["admm"])] == ["admm", "admm"]
    with pytest.raises(ValueError, match="solvers has 'pbd'; this diagram takes newton, projective-dynamics"):
        setups_of_steps(["pbd"])
    assert label(Setup("xpbd", {"substeps": 80, "iterations": 1, "integrator": "bdf2"})) == "xpbd bdf2 80×1"
    assert label(Setup("admm", {"substeps": 4, "weight": 0.1, "tolerance": 1e-9})) == "admm 4 weight=0.1"
    assert label(Setup("newton", {"substeps": 1, "integrator": "bdf2", "tolerance": 1e3})) == "newton bdf2 1 tolerance=1000"


def test_explicit_starts_at_the_fewest_stable_substeps(device):
    """10 % below the limit about the rest shape, and no more than a substep below that or the limit in motion."""
    first, *more = (setup.options["substeps"] for setup in setups_of_runs(SMALL, ["explicit"], device))
    rest, motion = step_limits(SMALL.load().build(device=device))
    limit = 60.0 * min(rest / 1.1, motion)
    assert 1.0 / first < limit <= 1.0 / (first - 1) and more == [round(1.5 * first), 2 * first]


def test_steps_are_as_long_at_any_frame_rate(tmp_path):
    """And no longer than a frame; settings that come to the same are one."""
    (tmp_path / "frames.py").write_text(
        "import warpcloth as wc\n\ndef scene(fps=60.0):\n    mesh = wc.Mesh.grid(3, 3)\n"
        "    return wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=10.0)], pins=[0], fps=fps)\n"
    )
    of = {fps: setups_of_runs(SceneRef(str(tmp_path / "frames.py"), {"fps": fps}), ["xpbd", "newton"]) for fps in (60.0, 4.0)}
    by_error = [[s.options for s in each if "substeps" not in s.options] for each in of.values()]
    assert by_error[0] == by_error[1] == [{"error": 1e-3}, {"error": 1e-4}]
    steps = [[s.options["substeps"] for s in each if "substeps" in s.options] for each in of.values()]
    assert steps[1] == [15 * each for each in steps[0]]
    fast = setups_of_runs(SceneRef(str(tmp_path / "frames.py"), {"fps": 6e3}))
    assert {s.options.get("substeps", 1) for s in fast if s.solver != "explicit"} == {1, 2}
    assert len({str(s) for s in fast}) == len(fast) and {s.solver for s in fast} == set(SOLVERS)


def test_what_takes_hard_constraints_has_settings_for_them(device):
    """Of each solver that takes some one or more, so that a chart of them compares solvers."""
    model = SceneRef("net", {"n": 4, "stiffness": "inf"}).load().build(device=device)
    bound = set()
    for setup in setups_of_runs(SceneRef("net", {"n": 4, "stiffness": "inf"}), device=device):
        with contextlib.suppress(ValueError):
            setup.record().bind(model)
            bound.add(setup.solver)
    assert bound == {"pbd", "hierarchical-pbd", "xpbd", "constrained-dynamics"}


def test_what_is_refused_alike_is_said_once(tmp_path, drawn):
    """Of a solver with many settings; and what has no points is no line in the legend."""
    rows = [
        {"solver": solver, "label": f"{solver} {n}", "status": "refused", "reason": why, "points": [], "floor": 1e-9}
        for solver, n, why in (("newton", 1, "hard"), ("newton", 4, "hard"), ("newton", 8, "soft"), ("admm", 1, "hard"),
                               ("pbd", 1, "strain 1.5e+03"), ("pbd", 2, "strain 76"))
    ]  # fmt: skip
    points = [{"iterations": n, "gap": 1.0 / n, "ms": 40.0 + n} for n in (1, 2, 4)]
    rows.append({"solver": "xpbd", "label": "xpbd", "status": "ok", "reason": "", "points": points, "floor": 1e-9})
    found = {"scene": "a$^$.py", "frame": 1, "rate": 60.0, "dtype": "float64", "machine": machine.machine(), "rows": rows}
    said = [("newton, 2 settings", "refused: hard"), ("newton 8", "refused: soft"), ("admm 1", "refused: hard")]
    said.append(("pbd, 2 settings", "refused: strain 1.5e+03; the others alike"))
    assert without_point(found) == said
    pareto.plot_solver(tmp_path / "solver.png", found)
    (legend,) = (axes.get_legend() for axes in drawn[0].axes if axes.get_legend())
    assert [text.get_text() for text in legend.get_texts()] == ["xpbd", "rounding of the objective"]
    low, high = (ms := drawn[0].axes[1]).get_xlim()
    shown = [text.get_text() for text in ms.get_xticklabels() if low <= text.get_position()[0] <= high]
    assert sum(map(bool, shown)) > 1 and not any(text.get_text() for text in ms.get_xticklabels(minor=True))


def test_settings_that_are_not_usable_are_marked(tmp_path, drawn, monkeypatch, capsys):
    """By a cross over each of their points, and in texts; those without a grade are not."""
    rows = [
        {"solver": "xpbd", "options": {}, "label": f"xpbd {n}", "status": "ok", "reason": "", "error": error, "ms": n,
         "strain_error": error, "spread": [n, n], "ms_per_second": 60.0 * n, "machine": "m", **grade}
        for n, error, grade in ((1, 4e-3, {"grade": "not usable"}), (2, 2e-3, {"grade": "completed"}), (3, 1e-3, {}))
    ]  # fmt: skip
    found = {"scene": "hanging", "frames": 2, "dtype": "float32", "machine": machine.machine(), "rows": rows}
    for i in front(rows):
        rows[i]["front"] = True
    found["reference"] = {"error": 1e-5, "strain_error": 1e-5, "substeps": 8}
    monkeypatch.setattr(work_precision, "time_diagram", lambda *_, **options: found)
    assert main(["chart", "work-precision", "hanging", "-o", str(tmp_path / "a.png"), "--csv", str(tmp_path / "a.csv")]) == 0
    out = capsys.readouterr().out
    assert "3 settings, 3 ok; 1 of the ok are not usable" in out
    assert [line.split(": ")[1] for line in out.splitlines() if ", not usable: " in line] == ["xpbd 1", "xpbd 1"]
    assert [line["grade"] for line in table(tmp_path / "a.csv")] == ["not usable", "completed", ""]
    for panel in drawn[0].axes[:2]:
        crosses = [line.get_xydata().tolist() for line in panel.lines if line.get_marker() == "x"]
        assert crosses == [[[60.0, 4e-3]]]
    assert text_of(drawn[0]).count("xpbd 1, not usable") == 2 and "xpbd 2, not usable" not in text_of(drawn[0])


def test_below_the_error_of_the_reference_nothing_is_better():
    """Errors below that of the reference do not rank settings: such settings are ranked by time alone."""
    rows = [
        {"status": "ok", "ms_per_second": ms, "error": error, "solver": f"s{ms}"}
        for ms, error in ((1, 9), (2, 3), (3, 1), (4, 2))
    ]
    assert front(rows, 3.0) == [0, 1] and front(rows, 2.5) == [0, 1, 2] and front(rows) == [0, 1, 2]
    near = [row | {"error": 0.001 * row["error"]} for row in rows]
    assert [row["solver"] for row in cheapest(near, 0.0081)] == ["s3"] and len(cheapest(near)) == 4


def test_a_lead_within_the_spread_is_none():
    """If two settings are equally fast within the spread, only the one with the smaller error is kept; strains count apart."""
    rows = [
        {"status": "ok", "ms_per_second": 60.0 * ms, "ms": ms, "spread": [ms - off, ms + off], "error": a, "strain_error": b}
        for ms, off, a, b in ((1.0, 0.3, 4.0, 1.0), (1.2, 0.3, 2.0, 3.0), (2.0, 0.1, 1.0, 2.0), (2.3, 0.1, 0.5, 0.1))
    ]
    assert quartiles(rows[0]) == pytest.approx((42.0, 78.0)) and quartiles({"ms_per_second": 3.0}) == (3.0, 3.0)
    assert front(rows) == [1, 2, 3] and front(rows, name="strain_error") == [0, 3]
    rows[3]["spread"] = [2.0, 2.6]
    assert front(rows) == [1, 3]


def test_nothing_beats_the_front():
    """By the definition, among random rows with ties, and rows without an error."""
    random = np.random.default_rng(0)
    values = random.integers(1, 12, size=(60, 2)).tolist()
    rows = [{"status": "ok", "ms_per_second": ms, "error": error, "solver": f"s{ms % 3}"} for ms, error in values]
    rows += [{"status": "diverged", "ms_per_second": 0.5, "error": None, "solver": "s0"}]
    found = [values[i] for i in front(rows)]
    beaten = [any(a <= x and b <= y and [a, b] != [x, y] for a, b in values) for x, y in values]
    assert {tuple(v) for v in found} == {tuple(v) for v, lost in zip(values, beaten, strict=True) if not lost}
    assert len(found) == len({tuple(v) for v in found}) and found == sorted(found)
    near = [row | {"error": 0.001 * row["error"]} for row in rows[:-1]]
    for row in cheapest(near):
        others = [each["ms_per_second"] for each in near if each["solver"] == row["solver"] and each["error"] <= 0.01]
        assert row["error"] <= 0.01 and row["ms_per_second"] == min(others)


# --- whole diagrams


class Nobody:
    """An executor that must not be asked."""

    def submit(self, *_):
        raise AssertionError("measured again")


@pytest.fixture
def drawn(monkeypatch):
    """Figures that are saved."""
    figures = []
    save = style.save
    monkeypatch.setattr(style, "save", lambda figure, path: (figures.append(figure), save(figure, path)))
    return figures


def table(path):
    with open(path, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def floor_of(axes, label):
    """The height of the line of that name."""
    ((height, other),) = (line.get_ydata() for line in axes.lines if line.get_label() == label)
    assert height == other
    return height


def text_of(figure):
    return "\n".join(text.get_text() for axes in figure.axes for text in axes.texts)


@pytest.mark.slow
def test_time_diagram(device, tmp_path, drawn):
    """Errors of first and second order, the front, what diverges; the second time nothing is measured."""
    store, said = tmp_path / "store.jsonl", []
    options = {"solvers": ["explicit", "newton", "constrained-dynamics"], "frames": 12, "device": device}
    with ThreadPoolExecutor(1) as executor:
        found = time_diagram(SMALL, executor=executor, store=Store(store), progress=lambda *at: said.append(at), **options)
    again = time_diagram(SMALL, executor=Nobody(), store=Store(store), **options)
    assert again == json.loads(json.dumps(found, allow_nan=False)) and said[-1][0] == len(found["rows"]) == said[-1][1]
    rows = {row["label"]: row for row in found["rows"]}
    floor = found["reference"]["error"]
    assert floor < 1e-4 and found["machine"]["warp"] and found["seed"] is None
    # Of first order, 16 times the steps leave a sixteenth; of second, twice the steps a quarter.
    assert rows["newton 1"]["error"] / rows["newton 16"]["error"] == pytest.approx(16.0, rel=0.5)
    assert rows["newton bdf2 1"]["error"] > 2.0 * rows["newton bdf2 2"]["error"] > floor
    best = [row for row in found["rows"] if row.get("front")]
    assert best and all(row["status"] == "ok" for row in best)
    doubted = found["rows"][0] | {"grade": "not usable"}
    found["rows"][0] = doubted
    found["rows"][-1] |= {"status": "diverged", "reason": "diverged in frame 3", "error": None}
    found["rows"][-1].pop("front", None)
    name = found["rows"][-1]["label"]
    assert (name, "diverged: diverged in frame 3") in without_point(found)
    for every in (False, True):
        pareto.plot_time(tmp_path / "chart.png", found, every)
    write_csv(tmp_path / "chart.csv", found)
    lines = table(tmp_path / "chart.csv")
    assert [line["label"] for line in lines] == list(rows)
    assert (lines[-1]["error"], lines[-1]["reason"]) == ("", "diverged in frame 3")
    facts = {
        "scene": "hanging(n=6)",
        "seed": "",
        **{k: "" if v is None else str(v) for k, v in found["machine"].items()},
    }
    assert all(line[name] == value for line in lines for name, value in facts.items())
    double = ["newton"] if device == "cpu" else []  # by default
    assert all(line["dtype"] == ("float64" if line["solver"] in double else "float32") for line in lines)
    assert found["dtype"] == ("float32 and float64" if double else "float32")
    assert float(lines[0]["error"]) == found["rows"][0]["error"] and float(lines[0]["strain_error"]) > 0.0
    axes, strains, _notes = drawn[0].axes
    front_of = {name: front(found["rows"], found["reference"][name], name) for name in ("error", "strain_error")}
    text, good = text_of(drawn[0]), [row for row in found["rows"] if row["status"] == "ok"]
    assert all(f"%: {found['rows'][i]['label']}" in text for i in front_of["error"])
    assert f"without a result: {len(found['rows']) - len(good)}, see the table" in text
    shown = {label for _, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    solvers = set(options["solvers"])
    assert shown - {"not usable"} == solvers | {"error of the reference", "Pareto front", "scatter of the times"}
    assert drawn[0].texts[-1].get_text() == machine.in_words(found["machine"])
    assert not axes.texts and not strains.texts, "no letters among the points"
    for panel, dotted, name in zip((axes, strains), drawn[1].axes, ("error", "strain_error"), strict=False):
        floor, crossed = found["reference"][name], []
        for solver in solvers:
            mine = [row for row in good if row["solver"] == solver]
            best = [mine[i] for i in front(mine, floor, name)]
            (line,) = (line for line in panel.lines if line.get_label() == solver)
            assert line.get_xydata().tolist() == [[row["ms_per_second"], row[name]] for row in best]
            crossed += [[row["ms_per_second"], row[name]] for row in best if row["grade"] == "not usable"]
        crosses = [point for line in panel.lines if line.get_marker() == "x" for point in line.get_xydata().tolist()]
        assert sorted(crosses) == sorted(crossed)
        assert floor_of(panel, "error of the reference") == floor
        (joined,) = (line for line in panel.lines if line.get_label() == "Pareto front")
        assert joined.get_xydata().tolist() == [
            [found["rows"][i]["ms_per_second"], found["rows"][i][name]] for i in front_of[name]
        ]
        dots = np.concatenate([line.get_xydata() for line in dotted.lines if line.get_marker() == "."])
        assert sorted(map(tuple, dots)) == sorted((row["ms_per_second"], row[name]) for row in good)


@pytest.mark.slow
def test_time_diagram_of_contact(device):
    """A sheet that slides on a slope; PBD takes no friction."""
    with ThreadPoolExecutor(1) as executor:
        found = time_diagram(TOUCHING, ["explicit", "xpbd", "pbd"], frames=8, device=device, store=Store(), executor=executor)
    rows = {row["label"]: row for row in found["rows"]}
    assert {row["status"] for row in rows.values()} == {"ok", "refused"}
    assert all("friction" in row["reason"] for row in rows.values() if row["solver"] == "pbd")
    assert min(row["error"] for row in rows.values() if row["solver"] == "xpbd") < 0.01 > found["reference"]["error"]


def test_a_chart_of_errors_needs_motion(tmp_path):
    (tmp_path / "still.py").write_text(
        "import warpcloth as wc\n\ndef scene():\n    mesh = wc.Mesh.grid(3, 3)\n"
        "    return wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=10.0)], gravity=(0.0, 0.0, 0.0))\n"
    )
    with pytest.raises(ValueError, match=r"nothing moves in .*still\.py within 2 frames"):
        time_diagram(SceneRef(str(tmp_path / "still.py")), frames=2, executor=Nobody())


@pytest.mark.slow
def test_the_physics_diagram(tmp_path, monkeypatch):
    """The catenary is met with order 2, a chain to rounding; the picture and the table have all of it."""
    for name, resolutions in (("catenary", (8, 16, 32)), ("chain", (5, 40))):
        monkeypatch.setitem(work_precision.PHYSICS, name, (work_precision.PHYSICS[name][0], resolutions))
    found = work_precision.physics_diagram(SceneRef("catenary"), store=Store(), executor=ThreadPoolExecutor(1))
    errors = [row["error"] for row in found["rows"]]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.abs(orders - 2.0).max() < 0.15
    write_csv(tmp_path / "physics.csv", found)
    table = (tmp_path / "physics.csv").read_text().splitlines()
    assert len(table) == 4 and float(table[1].split(",")[table[0].split(",").index("error")]) == errors[0]
    chain = work_precision.physics_diagram(SceneRef("chain"), store=Store(), executor=ThreadPoolExecutor(1))
    assert all(row["error"] <= row["floor"] < 1e-12 for row in chain["rows"])
    assert float(table[1].split(",")[table[0].split(",").index("floor")]) == found["rows"][0]["floor"] < 1e-10
    for wrong in (SceneRef("hanging"), SceneRef("chain", {"links": 5})):
        with pytest.raises(ValueError, match="the diagram physics is of cantilever, chain, catenary, without parameters"):
            work_precision.physics_diagram(wrong)


@pytest.mark.slow
def test_solver_and_spectrum_diagrams(device, tmp_path, drawn):
    with ThreadPoolExecutor(1) as executor:
        run = {"executor": executor, "device": device, "limit": 0.5, "frames": 12}
        one = solver_diagram(SMALL, solvers=["newton", "admm"], **run)
        other = spectrum_diagram(SceneRef("hanging", {"n": 4}), **run)
    assert [row["label"] for row in one["rows"]] == ["newton", "admm", "admm weight=1"]
    assert one["rate"] == 240.0 and one["frame"] == 12 and one["seed"] == 0 and len(other["rows"]) == 5
    # Smaller steps are nearer to their matrix.
    assert np.all(np.diff([row["contraction"] for row in other["rows"]]) < 0.0)
    one["rows"][1] |= {"status": "diverged", "reason": "a gap of 1e+07 after 8 iterations"}
    pareto.plot_solver(tmp_path / "solver.png", one)
    pareto.plot_spectrum(tmp_path / "spectrum.png", other)
    iterations, ms, _ = drawn[0].axes
    for axes, name in ((iterations, "iterations"), (ms, "ms")):
        for line, row in zip(axes.lines, one["rows"], strict=False):
            gaps = [max(point["gap"], row["floor"]) for point in row["points"]]
            assert np.array_equal(line.get_xydata(), np.transpose([[point[name] for point in row["points"]], gaps]))
    assert "without a result: 1, see the table" in text_of(drawn[0])
    assert [list(line.get_ydata()) for line in drawn[1].axes[0].lines] == [row["eigenvalues"] for row in other["rows"]]
    floors = [line for line in drawn[1].axes[1].lines if line.get_label() == "rounding of the positions"]
    assert [line.get_ydata()[0] for line in floors] == [row["floor"] for row in other["rows"]]
    assert [line.get_color() for line in floors] == [line.get_color() for line in drawn[1].axes[0].lines]
    for axes in (iterations, ms):
        assert floor_of(axes, "rounding of the objective") == max(row["floor"] for row in one["rows"])
    write_csv(tmp_path / "solver.csv", one)
    lines = table(tmp_path / "solver.csv")
    assert len(lines) == sum(len(row["points"]) for row in one["rows"]) and float(lines[0]["gap"]) > 0.0
    assert {line["seed"] for line in lines} == {"0"}


# --- the command


@pytest.mark.slow
def test_command(tmp_path, monkeypatch, capsys):
    """Interrupted after two settings it says so and keeps them; the same command goes on."""
    monkeypatch.chdir(tmp_path)
    command = ["chart", "work-precision", "hanging", "-p", "n=4", "--frames", "2", "--solvers", "pbd", "--workers", "1"]
    real = campaign.sweep

    def interrupted(*given, **options):
        for done, each in enumerate(real(*given, **options), 1):
            yield each
            if done == 2:
                raise KeyboardInterrupt

    monkeypatch.setattr(campaign, "processes", lambda workers: ThreadPoolExecutor(1))
    monkeypatch.setattr(campaign, "sweep", interrupted)
    assert main(command) == 130
    assert "interrupted after 2 of 4 settings, which are kept" in capsys.readouterr().err
    assert len(Store(tmp_path / "cache" / "work-precision.jsonl")) >= 2  # and what was finished meanwhile
    monkeypatch.setattr(campaign, "sweep", real)
    assert main([*command, "-o", "chart.png", "--csv", "chart.csv"]) == 0
    said = capsys.readouterr().out
    assert "hanging(n=4): 4 settings, 4 ok" in said and "nothing beats" in said and "known to" in said
    assert (tmp_path / "chart.png").stat().st_size > 10_000 and len(table("chart.csv")) == 4
    assert main([*command, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["diagram"] == "time" and len(facts["rows"]) == 4 and facts["machine"]["source"]
    assert {row["machine"] for row in facts["rows"]} == {row["machine"] for row in table("chart.csv")} == {machine.name()}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["hanging", "--solvers", "pbd", "--diagram", "solver"], "solvers has 'pbd'"),
        (["hanging", "--solvers", "newtons"], "invalid choice: 'newtons'"),
        (["hanging", "--frames", "0"], "frames is 0"),
        (["hanging", "--workers", "0"], "workers is 0"),
        (["hanging", "--limit", "0"], "limit is 0"),
        (["hanging", "--limit", "nan", "--diagram", "solver"], "limit is nan"),
        (["chain", "--diagram", "physics", "--frames", "3"], "--solvers and --frames are for the others"),
        (["hanging", "--diagram", "physics"], "the diagram physics is of cantilever"),
        (["hanging", "--diagram", "spectrum", "--dtype", "float32"], "--solvers and --dtype are for the others"),
        (["hanging", "--with", "newton", "--diagram", "solver"], "--with is for the diagram time, not for solver"),
        (["hanging", "-o", "chart.gif"], "ending is '.gif'"),
        (["hanging", "--csv", "none/chart.csv"], "does not exist"),
        (["hanged"], "there is no scene 'hanged'"),
        (["hanging", "-p", "m=3"], "no parameter 'm'"),
    ],
)
def test_wrong_use_is_said_before_anything_is_measured(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(work_precision, "collect", lambda *_, **__: pytest.fail("measured"))
    monkeypatch.setattr(work_precision, "reference", lambda *_, **__: pytest.fail("measured"))
    assert main(["chart", "work-precision", *arguments]) == 2
    assert words in capsys.readouterr().err


def test_charts_are_listed(capsys):
    assert main(["chart"]) == 2
    assert "work-precision" in capsys.readouterr().err
