"""Maps of stability: what is measured on them meets theory, and what theory does not explain is not there."""

import csv
import json
import re
import shlex
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

import warpcloth as wc
from support.rows import slow_but
from warpcloth.chart.maps import _PLAIN, plot_maps, write_csv
from warpcloth.cli import _parser, main
from warpcloth.cli.stability import _survey
from warpcloth.lab import campaign, machine, stability
from warpcloth.lab.axes import AXES, FIXED
from warpcloth.lab.campaign import Store, sweep
from warpcloth.lab.cells import applied, record_at, scene_at, vary
from warpcloth.lab.failures import FAILURES
from warpcloth.lab.measurements import SceneRef, Setup
from warpcloth.lab.stability import Survey, boundary, measure
from warpcloth.lab.stability_limits import (
    DIVERGES,
    GROWTH,
    KNOWN,
    concave_rate,
    largest_ordered,
    largest_relaxation,
    limit_ratios,
    rings,
)
from warpcloth.solvers import SOLVERS
from warpcloth.solvers.explicit import step_limits

pytestmark = pytest.mark.host

DOCS = Path(__file__).parents[2] / "docs" / "stability.md"
HANGING = SceneRef("hanging", {"n": 5})
DECADES = tuple(10.0**e for e in range(-4, 5))  # times 1e3 N/m
STEPS = (1e-4, 1e-3, 1e-2, 1e-1)
# What bisection stops at.
WIDTH = 1e-3
# How far from theory a limit may be. Runs at both ends of this bracket tell it, without bisection between them.
WITHIN = 0.01


def net(kind, n=10, stiffness=1.0):
    return SceneRef("net", {"n": n, "kind": kind, "stiffness": stiffness})


def mapped(scene, setups, x, xs, y, ys, steps=40, fixed=None, duration=None, **options):
    """Cells (setup, y, x) of a map, compared over as many steps of 1/60 s if not over a duration."""
    survey = Survey(scene, tuple(setups), x, y, tuple(xs), tuple(ys), fixed or {}, steps, duration or steps / 60)
    return survey.table((task, task.run()) for task in survey.tasks(**options))


def check_limit(scene, setup, axis, limit, steps, **options):
    """Checks that runs diverge on one side of a limit and hold on the other, :data:`WITHIN` it."""
    boundary(scene, setup, axis, limit / (1.0 + WITHIN), limit * (1.0 + WITHIN), steps, accuracy=3.0 * WITHIN, **options)


def verdicts(rows):
    return [[cell["verdict"] for cell in row] for row in rows]


def flat(cells):
    return [cell for rows in cells for row in rows for cell in row]


# --- Limits along an edge of a map.


@pytest.mark.parametrize("kind", ["structural", "shear", "bending"])
def test_explicit_diverges_above_its_limit(kind, device):
    """Symplectic Euler: 2/ω_max to 1 %, along the step and along the stiffness, k = 4/(h² ω²_max/k).

    At 1 + δ of the limit a mode grows by e^√(8δ) a step, in 400 steps of δ = 1e-3 by e^35.
    """
    limit, _ = step_limits(net(kind).load().build(device=device, dtype="float64"))
    found = boundary(net(kind), Setup("explicit"), "dt", 0.5 * limit, 2.0 * limit, steps=400, accuracy=WIDTH, device=device)
    assert found == pytest.approx(limit, rel=0.01)
    found = boundary(net(kind), Setup("explicit"), "stiffness", 0.1, 10.0, steps=400, fixed={"dt": limit}, device=device)
    assert found == pytest.approx(1.0, rel=0.02)  # the step goes as its root


JACOBI = [("pbd", "jacobi"), ("pbd", "vertex-averaged"), ("pbd", "constraint-averaged"), ("xpbd", "constraint-averaged")]


@pytest.mark.parametrize(
    ("kind", "iterations"), slow_but([("shear", 4)], [("structural", 1), ("structural", 20), ("shear", 1), ("shear", 4)])
)
@pytest.mark.parametrize(("solver", "sweep"), JACOBI)
def test_jacobi_diverges_above_its_limit(kind, solver, sweep, iterations, device):
    """ω λ_max = 2 to 1 % of an even number of sweeps; of an odd number n, 1 + 3^(−1/n), for steps have velocities."""
    hard, setup = net(kind, 8, "inf"), Setup(solver, {"sweep": sweep})
    fixed = {**FIXED, "iterations": iterations}
    limit = largest_relaxation(scene_at(hard, fixed, 1), fixed["dt"], record_at(setup, fixed))
    # Amplitudes at the limit of an odd number go as z = −1 − 4δ a step.
    check_limit(hard, setup, "relaxation", limit, 600, fixed=fixed, device=device)


@pytest.mark.parametrize("iterations", slow_but([1, 2], [1, 2, 20]))
@pytest.mark.parametrize("solver", ["pbd", "xpbd"])
def test_gauss_seidel_diverges_above_its_limit(solver, iterations, device):
    """(1 − ω)ⁿ of structural springs is the multiplier q of n sweeps, z² − 2qz + q = 0 that of steps: |z| > 1 iff q < −1/3."""
    limit = 1.0 + 3.0 ** (-1.0 / iterations)
    fixed = {"iterations": iterations}
    check_limit(net("structural", 8, "inf"), Setup(solver), "relaxation", limit, 600, fixed=fixed, device=device)


def test_compliance_makes_jacobi_more_stable(device):
    """D + α̃ in place of D, α̃ = 1/(kh²): of soft springs a larger relaxation holds, by what theory says."""
    fixed, setup = {"dt": 1.5, "iterations": 4}, Setup("pbd", {"sweep": "jacobi"})
    limits = []
    for stiffness in (1.0, "inf"):
        scene = net("shear", 8, stiffness)
        limits.append(largest_relaxation(scene_at(scene, fixed, 1), fixed["dt"], record_at(setup, fixed)))
    check_limit(net("shear", 8), setup, "relaxation", limits[0], 600, fixed=fixed, device=device)
    assert limits[0] > 1.1 * limits[1]


SOFT_JACOBI = [
    ("xpbd", {"sweep": "constraint-averaged"}),
    ("xpbd", {"sweep": "constraint-averaged", "integrator": "midpoint"}),
    ("xpbd", {"sweep": "constraint-averaged", "integrator": "bdf2"}),
    ("pbd", {"sweep": "jacobi", "correction": "per-step"}),
    ("pbd", {"sweep": "constraint-averaged"}),
]


@pytest.mark.parametrize("iterations", slow_but([4], [1, 4, 5]))
@pytest.mark.parametrize(("solver", "options"), SOFT_JACOBI)
def test_limits_of_jacobi_with_compliance(solver, options, iterations, device):
    """α̃ = 1/(khₑ²) of XPBD counts twice, in D + α̃ and with λ, each integrator has its least q; "per-step" spreads it."""
    fixed, setup, scene = {"dt": 1.0, "iterations": iterations}, Setup(solver, options), net("shear", 8)
    limit = (
        record_at(setup, fixed).relaxation / limit_ratios(scene_at(scene, fixed, 1), record_at(setup, fixed), 1)["ω λ_max = 2"]
    )
    # The mode that decides about odd numbers is taken for that which decides about even ones.
    check_limit(scene, setup, "relaxation", limit, 600, fixed=fixed, device=device)


ORDERED = [
    ("structural", "pbd", {}, 4, 1.0),
    ("structural", "xpbd", {}, 4, 1.0),
    ("structural", "xpbd", {}, 4, 1e4),
    ("shear", "pbd", {"sweep": "sequential"}, 1, 1.0),
    ("shear", "pbd", {"sweep": "sequential"}, 5, 1e4),
    ("shear", "pbd", {}, 1, 1e4),
    ("shear", "pbd", {}, 4, 1.0),
    ("shear", "xpbd", {"sweep": "sequential"}, 4, 1e4),
    ("shear", "xpbd", {"integrator": "bdf2"}, 5, 1e4),
    ("shear", "xpbd", {"integrator": "midpoint"}, 2, 1.0),
]


@pytest.mark.parametrize(("kind", "solver", "options", "iterations", "stiffness"), slow_but(ORDERED[::3], ORDERED))
def test_limits_of_gauss_seidel_in_its_order(kind, solver, options, iterations, stiffness, device):
    """The eigenvalues of sweeps in the order in which they go, soft and stiff (kh² of 1 and 1e4 times the mass)."""
    fixed, setup, scene = {"dt": 1.0, "iterations": iterations}, Setup(solver, options), net(kind, 8, stiffness)
    ratios = limit_ratios(scene_at(scene, fixed, 1), record_at(setup, fixed), 600)
    limit = 1.0 / ratios["Gauss–Seidel, |z| = 1"]
    check_limit(scene, setup, "relaxation", limit, 600, fixed=fixed, device=device)


@pytest.mark.parametrize(("stiffness", "pins"), [(0.0, ()), (1.0, "all")], ids=["no stiffness", "all pinned"])
@pytest.mark.parametrize("sweep", ["sequential", "coloured", "jacobi", "vertex-averaged"])
def test_a_net_that_no_spring_moves_has_no_limit(stiffness, pins, sweep):
    declared = replace(net("shear", 4, stiffness).load(), pins=pins)
    ratios = limit_ratios(declared, wc.PBD(substeps=1, iterations=1, sweep=sweep), 100)
    assert "Gauss–Seidel, |z| = 1" not in ratios and ratios.get("ω λ_max = 2", 0.0) == 0.0


def test_an_order_moves_the_limit_of_gauss_seidel():
    """With shear springs one sweep in one order for all holds for ω < 1.07, by colour up to 1.36; structural ones for 4/3."""
    limits = {
        (kind, sweep): largest_ordered(net(kind, 8, "inf").load(), 1.0, wc.PBD(dt=1.0, iterations=1, sweep=sweep), 10**4)
        for kind in ("structural", "shear")
        for sweep in ("sequential", "coloured")
    }
    assert limits["structural", "sequential"] == pytest.approx(4 / 3, rel=1e-3)
    assert limits["structural", "coloured"] == pytest.approx(4 / 3, rel=1e-3)
    assert limits["shear", "sequential"] < 1.1 < 1.3 < limits["shear", "coloured"]
    assert largest_ordered(net("shear", 20).load(), 1.0, wc.PBD(dt=1.0), 100) is None, "of too many springs none is sought"


@pytest.mark.filterwarnings("error")
def test_a_spring_between_two_pins_limits_nothing():
    scene = replace(net("shear", 6, "inf").load(), pins="z == 0")
    setup = record_at(Setup("pbd", {"sweep": "jacobi"}), {"iterations": 4})
    assert 0.4 < largest_relaxation(scene, FIXED["dt"], setup) < 0.7


def test_no_line_is_drawn_where_damping_moves_it(device):
    """Forward Euler holds small steps with damping: |z|² = 1 − hβω² + h²ω² of β times the stiffness."""
    scene = net("shear", 6).load()
    damped = replace(scene, terms=[replace(term, damping=1.0) for term in scene.terms])
    for setup in (Setup("explicit", {"scheme": "forward"}), Setup("pbd"), Setup("xpbd", {"sweep": "constraint-averaged"})):
        names = [set(limit_ratios(one, record_at(setup, {}), 100)) & set(DIVERGES) for one in (scene, damped)]
        assert len(names[0]) == 1 and not names[1]


@pytest.mark.parametrize(("integrator", "part"), [("euler", 1.0), ("midpoint", 0.5), ("bdf2", 2 / 3)])
def test_rules_of_integrators_are_of_their_effective_step(integrator, part):
    values = {"dt": 0.02, "compression": 0.2}
    ref = SceneRef("chain", {"links": 1, "stiffness": 100.0, "mass": 0.01})
    found = limit_ratios(scene_at(ref, values, 4), record_at(Setup("newton", {"integrator": integrator}), values), 4)
    assert found["h² = m/(k(L/l − 1))"] == pytest.approx(part * 0.02 * 50.0, rel=1e-4)


@pytest.mark.parametrize(("compression", "most"), [(0.0, 0.0), (0.2, 2.9315)])
def test_the_concave_rate_of_many_vertices(compression, most):
    """Of a flat net, whose least eigenvalues are a multitude about 0, and of a compressed one, that of the dense matrix."""
    model = scene_at(net("shear", 12), {"dt": 0.1, "compression": compression}, 4).build(dtype="float64")
    assert concave_rate(model) == pytest.approx(most, rel=1e-3, abs=1e-4)


def test_forward_euler_diverges_at_any_step(device):
    """By (1 + h²ω²) a step the energy of the fastest mode grows tenfold, within 0.5 to 2.5 of the steps of theory.

    Noise has a part in 3n² alone in that mode, so that it must grow by more than the whole does.
    """
    setup, limit = Setup("explicit", {"scheme": "forward"}), step_limits(net("shear").load().build(dtype="float64"))[0]
    for part in (0.03, 0.1, 0.3):
        h = part * limit
        needed = np.log(GROWTH) / np.log1p((2.0 * part) ** 2)
        steps = round(3.0 * needed)
        ((cell,),) = measure(asdict(net("shear")), [asdict(setup)], {}, "dt", [h], steps, device=device, reference=False)
        assert cell["verdict"] == "diverged" and 0.5 * needed < cell["step"] < 2.5 * needed
        assert cell["rules"]["forward Euler"] == pytest.approx(cell["steps"] / needed, rel=1e-3)


def test_rounding_is_not_divergence(device):
    """In float32 a net at rest gains some eighty times the energy of its noise, by a walk; above the limit it diverges."""
    limit, _ = step_limits(net("shear", 12).load().build(dtype="float64"))
    for part, verdict in ((0.7, "stable"), (1.01, "diverged")):
        given = {"device": device, "dtype": "float32", "reference": False}
        ((cell,),) = measure(asdict(net("shear", 12)), [asdict(Setup("explicit"))], {}, "dt", [part * limit], 4000, **given)
        assert cell["verdict"] == verdict and (verdict == "diverged" or cell["growth"] < 1.0)


def test_rules_of_one_spring():
    """h² = m/(k(L/l − 1)) of one compressed spring with a fixed end; Σk h²/m; rings of a chain."""
    ref = SceneRef("chain", {"links": 1, "stiffness": 100.0, "mass": 0.01})
    values = {"dt": 0.02, "compression": 0.2}
    scene, newton = scene_at(ref, values, 4), record_at(Setup("newton"), values)
    # Noise of the start is 1e-6 of the length.
    assert concave_rate(scene.build(dtype="float64")) == pytest.approx(100.0 * (1 / 0.8 - 1) / 0.01, rel=1e-4)
    assert limit_ratios(scene, newton, 4)["h² = m/(k(L/l − 1))"] == pytest.approx(0.02 * np.sqrt(2500.0), rel=1e-4)
    plain = record_at(Setup("projective-dynamics", {"acceleration": "none"}), {**values, "iterations": 5})
    # Gershgorin's sum over a row counts the pin too.
    needed = limit_ratios(scene, plain, 4)["1 + Σk h²/m iterations"] * 5
    assert 1.0 + 100.0 * 0.02**2 / 0.01 <= needed * (1 + 1e-9) <= 1.0 + 2 * 100.0 * 0.02**2 / 0.01 * (1 + 1e-9)
    assert rings(SceneRef("chain", {"links": 7}).load()) == 7


# --- Maps.


def unexplained(cells):
    """Cells that diverged although no rule for that is above its limit."""
    return [
        cell
        for cell in flat(cells)
        if cell["verdict"] == "diverged" and not any((cell["rules"].get(name) or 0.0) > 1.0 for name in DIVERGES)
    ]


IMPLICIT = [Setup("newton", {"hessian": "clamp"}), Setup("newton"), Setup("projective-dynamics")]
OTHERS = [Setup(name) for name in ("explicit", "xpbd", "pbd", "admm", "hierarchical-pbd")]


@pytest.mark.slow
def test_implicit_euler_never_diverges(device):
    """8 decades of stiffness, 0.1 to 1e7 N/m, and the ends of 4 of the step; the others diverge where a rule says so."""
    cells = mapped(
        HANGING,
        IMPLICIT[::2] + OTHERS,
        "stiffness",
        DECADES,
        "dt",
        STEPS[::3],
        20,
        duration=1e-4,
        device=device,
        reference=False,
    )
    assert {cell["verdict"] for cell in flat(cells[:2])} <= {"stable", "stalled"}
    assert not unexplained(cells)
    (explicit,) = verdicts(cells[2:3][0][:1])
    limit = step_limits(HANGING.load().build(dtype="float64"))[0]
    assert explicit == ["stable" if STEPS[0] * np.sqrt(k) < limit else "diverged" for k in DECADES]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameters", "fixed"), [("hanging", {}, {"compression": 0.3}), ("net", {"stiffness": 1e3}, {})]
)
def test_implicit_euler_never_diverges_on_full_maps(name, parameters, fixed, device):
    """Every second decade with steps between and beyond those of the test above, and the start compressed too."""
    scene, steps = SceneRef(name, {"n": 6, **parameters}), (1e-3, 1e-2, 1.0)
    methods = IMPLICIT if fixed else IMPLICIT + OTHERS
    cells = mapped(scene, methods, "stiffness", DECADES[::2], "dt", steps, 12, fixed, 1e-4, device=device, reference=False)
    assert {cell["verdict"] for cell in flat(cells[:3])} <= {"stable", "stalled"}
    assert not unexplained(cells)


@pytest.mark.slow
def test_jacobi_limits_of_the_known_nets(device):
    """40 × 40 vertices: 2/λ_max of the table, 1.997 and 5.05, and ω²_max·m/k, 3.99 and 10.09; test_failures.py has all."""
    for kind, frequency, value in (("structural", 3.99, 1.997), ("bending", 10.09, 5.05)):
        setup = Setup("pbd", {"sweep": "jacobi"})
        hard, fixed = net(kind, 40, "inf"), {"iterations": 20}
        check_limit(hard, setup, "relaxation", 2.0 / value, 200, fixed=fixed, device=device)
        check_limit(net(kind, 40), Setup("explicit"), "dt", 2.0 / np.sqrt(frequency), 1000, device=device)


def test_cells_are_compared_over_the_same_time(device):
    """Halving the step halves the error of Euler and quarters that of BDF2, of one motion; runs are of 40 steps at least.

    Of as many steps each, they would be errors of motions of other lengths.
    """
    setups = [asdict(Setup("newton")), asdict(Setup("newton", {"integrator": "bdf2"}))]
    values = [2e-3, 4e-3, 2e-2]
    rows = measure(asdict(HANGING), setups, {"stiffness": 0.01}, "dt", values, 40, duration=0.2, device=device)
    for row, factor in zip(rows, (2.0, 4.0), strict=True):
        assert row[1]["error"] / row[0]["error"] == pytest.approx(factor, rel=0.25)
        assert [cell["steps"] for cell in row] == [100, 50, 40]


@pytest.mark.parametrize(
    ("dt", "steps", "run", "reference"), [(1e-3, 10, 504, 2016), (1e-4, 10, 5056, 2048), (0.1, 10, 10, 20)]
)
def test_the_cost_of_a_cell_is_bounded(dt, steps, run, reference, device, monkeypatch):
    """Half a second: a run has the steps that takes, or those asked for; the reference 4 times as many, or about 2000."""
    asked = []
    monkeypatch.setattr(
        stability, "run", lambda scene, record, *_, **__: asked.append(scene.frames * record.per_frame(scene.fps))
    )
    monkeypatch.setattr(stability, "_judge", lambda *_: stability._cell("stable", ""))
    measure(asdict(HANGING), [asdict(Setup("pbd"))], {"dt": dt}, "stiffness", [1.0], steps, duration=0.5, device=device)
    assert asked == [reference // 2, reference, run]


# --- Failures as maps show them; docs/stability.md says which.


@pytest.mark.slow
def test_02_a_raw_hessian_stalls_in_compression(device):
    """Newton with the raw Hessian, factorised, stalls in its first step beyond h² = m/(k(L/l − 1)) and nowhere before.

    Later steps compress springs further than the start. Clamped it never stalls.
    """
    soft = SceneRef("hanging", {"n": 5, "stiffness": 10.0})
    setups = [Setup("newton", {"hessian": kind, "linear": "factorised"}) for kind in ("raw", "clamp")]
    cells = mapped(
        soft, setups, "compression", [0.0, 0.2, 0.4, 0.8], "dt", [1e-3, 1e-2, 1e-1], 1, device=device, reference=False
    )
    raw, clamped = (flat([rows]) for rows in cells)
    stalled = [cell for cell in raw if cell["verdict"] == "stalled"]
    assert len(stalled) >= 3 and all(cell["rules"]["h² = m/(k(L/l − 1))"] > 1.0 for cell in stalled)
    assert all("energy" in cell["reason"] or "balance" in cell["reason"] for cell in stalled)
    assert "stalled" not in {cell["verdict"] for cell in clamped}


@pytest.mark.slow
def test_03_stiffness_of_pbd_depends_on_iterations(device):
    """A soft mass on a spring: each sweep adds to the stiffness of PBD, 1 to 64 of them; XPBD keeps that of the material."""
    spring = SceneRef("chain", {"links": 1, "stiffness": 1.0, "mass": 0.01})
    cells = mapped(
        spring,
        [Setup("pbd"), Setup("xpbd")],
        "stiffness",
        [0.3, 1.0],
        "iterations",
        [1, 8, 64],
        200,
        {"dt": 1 / 240},
        device=device,
        accuracy=0.05,
    )
    pbd, xpbd = (np.array([[cell["error"] for cell in row] for row in rows]) for rows in cells)
    assert (pbd[2] > 5.0 * pbd[0]).all() and verdicts(cells[0])[2] == ["inaccurate"] * 2
    assert np.ptp(xpbd, axis=0).max() < 1e-6 and verdicts(cells[1]) == [["stable"] * 2] * 3


@pytest.mark.slow
def test_06_and_08_few_iterations_fall_behind_as_stiffness_grows(device):
    """Of 8 iterations projective dynamics, plain and accelerated, stays behind by far where Σk h²/m is above them; so ADMM."""
    plain = Setup("projective-dynamics", {"acceleration": "none"})
    setups = [plain, Setup("projective-dynamics"), Setup("admm")]
    cells = mapped(HANGING, setups, "stiffness", [1e-3, 1.0, 1e3], "iterations", [8, 64], 30, device=device, accuracy=0.25)
    for rows in cells:
        assert verdicts(rows)[0][0] == "stable" and verdicts(rows)[0][2] == "inaccurate"
        assert rows[1][1]["error"] < 0.6 * rows[0][1]["error"], "more iterations cure it"
    name = "1 + Σk h²/m iterations"
    assert [cell["rules"][name] > 1.0 for cell in cells[0][0]] == [False, True, True]
    assert all(a["rules"][name] < b["rules"][name] for a, b in zip(cells[1][0], cells[0][0], strict=True))


@pytest.mark.slow
def test_07_weights_of_admm(device):
    """The error has its minimum between a weight that is too small and one that stalls, within the grid's factor at the line.

    The line goes down with the root of the stiffness.
    """
    weights, given = [1e-3, 3e-2, 1.0, 30.0], {"fixed": {"iterations": 50}, "device": device}
    (rows,) = mapped(HANGING, [Setup("admm")], "stiffness", [1e-2, 1.0, 30.0], "weight", weights, 24, duration=0.4, **given)
    best = np.array([[cell["error"] for cell in row] for row in rows]).argmin(axis=0)
    assert best.tolist() == sorted(best, reverse=True) and best[0] > best[-1]
    ratios = np.array([[cell["rules"]["r = 1/(2hω)"] for cell in row] for row in rows])
    assert all(1.0 / 30.0 < ratios[i, k] < 30.0 for k, i in enumerate(best))
    assert ratios[0] / ratios[0, 0] == pytest.approx(np.sqrt([1.0, 100.0, 3000.0]), rel=1e-6)
    assert ratios[:, 0] / ratios[0, 0] == pytest.approx(np.array(weights) / weights[0], rel=1e-6)
    assert "r = 1/(2hω)" not in limit_ratios(HANGING.load(), wc.ADMM(dt=1 / 60), 10), "which auto is on by itself"


@pytest.mark.parametrize("solver", slow_but(["pbd"], ["pbd", "xpbd"]))
def test_14_information_moves_a_ring_an_iteration(solver, device):
    """A chain from the pin down: at fixed sweeps the error grows with its links, at fixed links it falls with sweeps."""
    setup = Setup(solver, {"sweep": "sequential"})
    (rows,) = mapped(SceneRef("chain"), [setup], "resolution", [5, 10, 20], "iterations", [1, 4, 16], 30, device=device)
    errors = np.array([[cell["error"] for cell in row] for row in rows])
    assert (np.diff(errors, axis=1) > 0.0).all() and (np.diff(errors, axis=0) < 0.0).all()
    assert rows[0][1]["rules"]["a ring an iteration"] == 10.0


def test_each_failure_is_in_a_chart():
    """Each row names a command that parses, whose axes, methods and scene exist."""
    text = DOCS.read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| [^|]+ \| `([^`]+)`[^|]*\|$", text, re.MULTILINE)
    assert [number for number, _ in rows] == [str(i) for i in range(1, 18)]
    for _, command in rows:
        given = _parser().parse_args(["chart", *shlex.split(command)])
        if "failure" not in given:
            survey = _survey(given)
            assert survey.scene.load().frames and survey.tasks()
    assert {given.split()[1] for _, given in rows if given.startswith("failure ")} == set(FAILURES)


# --- What a map is made of.


@pytest.mark.slow
def test_rows_are_copies_and_either_axis_can_be_a_row(device):
    """A cell in a row is the cell by itself, and a map turned over is the same map."""
    setups = [Setup("newton"), Setup("explicit")]
    factors, steps = (0.1, 1.0, 1e3), (1e-3, 1e-2)
    first = mapped(HANGING, setups, "stiffness", factors, "dt", steps, 12, device=device)
    turned = mapped(HANGING, setups, "dt", steps, "stiffness", factors, 12, device=device)
    for a, b in zip(first, turned, strict=True):
        assert a == [list(column) for column in zip(*b, strict=True)]
    for i, setup in enumerate(setups):
        given = {"device": device, "duration": 0.2}
        alone = measure(asdict(HANGING), [asdict(setup)], {"stiffness": 1e3}, "dt", [1e-2], 12, **given)[0][0]
        within = first[i][1][2]
        assert alone["verdict"] == within["verdict"] and alone["step"] == within["step"]
        assert alone["growth"] == pytest.approx(within["growth"], rel=1e-9)


@pytest.mark.parametrize("name", slow_but(("explicit", "newton", "xpbd"), SOLVERS))
def test_a_row_of_copies_is_its_cells(name, device):
    """Of each method, though some copies diverge or take many more iterations than others."""
    setup, factors = [asdict(Setup(name))], [1e-2, 1.0, 1e4]
    given = {"steps": 12, "reference": False, "device": device}
    (row,) = measure(asdict(HANGING), setup, {"dt": 1e-2}, "stiffness", factors, **given)
    cells = [measure(asdict(HANGING), setup, {"stiffness": factor}, "dt", [1e-2], **given)[0][0] for factor in factors]
    for within, alone in zip(row, cells, strict=True):
        # Levels of a hierarchy and factors of all copies at once are of other rounding.
        assert within == {**alone, "growth": pytest.approx(alone["growth"], rel=1e-9)}
    assert [cell["status"] for cell in row] == (["ok", *["diverged"] * 2] if name == "explicit" else ["ok"] * 3)


@pytest.mark.parametrize("name", ["stiffness", "mass-ratio", "compression"])
def test_what_copies_differ_in(name, device):
    """The model of copies has what each scene by itself has."""
    scene = scene_at(HANGING, {"dt": 1e-2}, 4)
    values = [0.3, 0.5]
    model = scene.build(device=device, dtype="float64", copies=2, vary=vary(scene, name, values))
    for copy, value in enumerate(values):
        one = applied(scene, name, value).build(device=device, dtype="float64")
        n = one.per_copy
        for field in ("positions", "mass"):
            assert np.array_equal(getattr(model, field).numpy()[copy * n : (copy + 1) * n], getattr(one, field).numpy())
        for many, single in zip(model.terms, one.terms, strict=True):
            assert many.stiffness.numpy()[copy * many.per_copy] == single.stiffness.numpy()[0]
    changed = {
        "stiffness": applied(scene, name, 0.5).terms[0].stiffness == 0.5 * scene.terms[0].stiffness,
        "mass-ratio": (applied(scene, name, 0.5).vertex_masses != scene.vertex_masses).sum() == 1,
        "compression": np.ptp(applied(scene, name, 0.5).positions[:, 2]) == pytest.approx(0.5, rel=1e-4),
    }
    assert changed[name]


def test_refused_and_slow_cells_say_why(device):
    cells = mapped(
        SceneRef("hanging", {"n": 4, "stiffness": "inf"}),
        [Setup("newton"), Setup("pbd"), Setup("projective-dynamics")],
        "dt",
        [1e-2],
        "relaxation",
        [0.5, 1.0],
        8,
        device=device,
    )
    assert verdicts(cells[0]) == [["refused"]] * 2 and "no relaxation" in cells[0][0][0]["reason"]
    assert verdicts(cells[1]) == [["stable"]] * 2 and cells[1][0][0]["error"] is None
    slow = mapped(HANGING, [Setup("xpbd")], "dt", [1e-2], "iterations", [3], 40, device=device, limit=1e-9, reference=False)
    assert slow[0][0][0]["verdict"] == slow[0][0][0]["status"] == "slow" and "stopped after 1e-09 s" in slow[0][0][0]["reason"]
    (cell,) = flat(mapped(SceneRef("hanging", {"stiffness": "inf"}), [Setup("admm")], "dt", [1e-2], "iterations", [3], 4))
    assert cell["status"] == "refused" and "infinite stiffness" in cell["reason"] and json.dumps(cell, allow_nan=False)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: AXES["dt"].values(0.0, 1.0, 3), "low is 0.0; it must be a number above 0"),
        (lambda: AXES["dt"].values(1.0, 0.5, 3), "high is 0.5; it must be a number of 1 or more"),
        (lambda: AXES["dt"].values(1.0, 2.0, 0), "count is 0"),
        (lambda: Survey(HANGING, (), "dt", "dt", (1,), (1,), {}), "each must be another"),
        (lambda: Survey(HANGING, (), "dt", "weight", (1,), (1,), {"dt": 1.0}), "each must be another"),
        (lambda: Survey(HANGING, (), "dt", "height", (1,), (1,), {}), "axis is 'height'; it must be one of"),
        (lambda: Survey(HANGING, (Setup("newton", {"dt": 1.0}),), "dt", "weight", (1,), (1,), {}), "the map sets the step"),
        (lambda: scene_at(SceneRef("flag"), {"dt": 0.1}, 4), "its pins move"),
        (lambda: scene_at(SceneRef("net.txt"), {"dt": 0.1, "resolution": 4}, 4), "net.txt"),
        (lambda: boundary(HANGING, Setup("newton"), "dt", 1e-3, 1e-2, steps=4), "both ends hold"),
    ],
)
def test_wrong_values_are_refused(make, words):
    with pytest.raises((ValueError, FileNotFoundError), match=words):
        make()


def test_a_map_refuses_colliders_that_move(tmp_path):
    (tmp_path / "lift.py").write_text(
        "import warpcloth as wc\n"
        "def scene():\n"
        "    ball = wc.Sphere(radius=0.1, position=[(0, -1, 0), (0, -0.9, 0)], name='ball')\n"
        "    return wc.Scene(wc.Mesh.grid(3, 3), density=0.1, terms=[wc.Spring(stiffness=1.0)], colliders=[ball])\n"
    )
    with pytest.raises(ValueError, match="the collider ball moves, frame by frame; a map needs colliders at rest"):
        scene_at(SceneRef(str(tmp_path / "lift.py")), {"dt": 0.1}, 4)


def test_values_of_axes():
    assert AXES["iterations"].values(1, 8, 10) == [1, 2, 3, 4, 5, 6, 8]
    assert AXES["dt"].values(1e-4, 1e-1, 4) == [1e-4, 1e-3, 1e-2, 1e-1]
    assert AXES["compression"].values(0.0, 0.9, 4) == [0.0, 0.3, 0.6, 0.9]


def test_what_is_measured_is_kept(tmp_path, monkeypatch):
    survey = Survey(HANGING, (Setup("explicit"),), "stiffness", "dt", (0.1, 1.0), (1e-3, 1e-2), {}, 8)
    tasks = survey.tasks(reference=False)
    assert len(tasks) == 2 and all(task.arguments["axis"] == "stiffness" for task in tasks)
    with ThreadPoolExecutor(1) as executor:
        first = survey.table(sweep(tasks, executor, Store(tmp_path / "s.jsonl")))
        monkeypatch.setattr(stability, "run", None)
        assert survey.table(sweep(survey.tasks(reference=False), executor, Store(tmp_path / "s.jsonl"))) == first


SCENE = """
import warpcloth as wc
def scene(n: int = 4, k: float = 1e3):
    terms = [wc.Spring(pairs=("structural", "shear"), stiffness=FACTOR * k)]
    return wc.Scene(wc.Mesh.grid(n, n), density=0.1, terms=terms, pins="corners and z == 0", duration=0.1)
"""


@pytest.mark.parametrize("axis", ["dt", "resolution"])
def test_a_scene_that_was_changed_is_measured_again(axis, tmp_path):
    keys = []
    for factor in (1.0, 1.0, 1e-4):
        (tmp_path / "mine.py").write_text(SCENE.replace("FACTOR", str(factor)))
        xs = (1e-3, 1e-2) if axis == "dt" else (3, 5)
        survey = Survey(SceneRef(str(tmp_path / "mine.py")), (Setup("pbd"),), axis, "stiffness", xs, (1.0, 2.0), {}, 8)
        keys.append([task.key for task in survey.tasks(reference=False)])
    assert keys[0] == keys[1] and not set(keys[0]) & set(keys[2])


# --- Pictures, tables, command line.


def test_the_reference_is_known_to_what_halving_its_step_changes(device):
    """The floor bounds its distance to a run of an eighth of the step, and falls with the square of the step."""
    survey = {"fixed": {"stiffness": 1.0}, "axis": "dt", "values": [2e-3, 4e-3], "steps": 40, "device": device}
    ((fine, coarse),) = measure(asdict(HANGING), [asdict(Setup("newton", {"integrator": "bdf2"}))], **survey)
    assert fine["error"] > fine["floor"] > 0.0 and coarse["floor"] > 2.0 * fine["floor"]
    scene = scene_at(HANGING, {"stiffness": 1.0, "dt": 4e-3}, 40)
    runs = [stability.run(scene, wc.Newton(substeps=k, integrator="bdf2", tolerance=1e-6), device=device) for k in (2, 4, 16)]
    before, after = (stability._apart(runs[i], runs[i + 1], 0) for i in (0, 1))
    assert coarse["floor"] == pytest.approx(before, rel=1e-6) and after < before


@pytest.mark.parametrize(
    ("floor", "error", "verdict"),
    [
        (0.001, 0.005, "stable"),
        (0.004, 0.007, "unsure"),
        (0.004, 0.013, "unsure"),
        (0.004, 0.015, "inaccurate"),
        (0.02, 0.1, "inaccurate"),
    ],
)
def test_no_verdict_that_the_reference_does_not_bear(floor, error, verdict):
    """Errors about an accuracy of 0.01: points of one vertex that moves along an edge of 1 m."""
    x = np.zeros((2, 1, 2, 3))
    x[:, :, 1, 0] = 1.0

    def trial(off):
        # RMS over two frames and two vertices: all are off.
        return stability.BatchRun(x + np.array([0.0, off, 0.0]), np.array([1]), np.ones(1), [""], [None])

    cell = stability._judge(trial(error), 0, [trial(floor), trial(0.0)], 0.01)
    assert cell["verdict"] == verdict and cell["status"] == "ok"
    assert (cell["error"], cell["floor"]) == pytest.approx((error, floor))
    assert cell["reason"] == "" if verdict == "stable" else f"known to {100.0 * floor:.2g} %" in cell["reason"]
    assert stability._judge(trial(error), 0, None, 0.01)["verdict"] == "stable"
    lost = stability._judge(trial(error), 0, "no reference: stopped after 1 s", 0.01)
    assert lost["verdict"] == "unsure" and lost["error"] is None and lost["reason"].startswith("no reference")


def test_options_of_methods_share_a_reference(device, monkeypatch):
    """Which has neither; where the step varies each has its own."""
    real, asked = stability._reference, []
    monkeypatch.setattr(stability, "_reference", lambda *given: (asked.append(given), real(*given))[1])
    for axis, values, count in (("iterations", [1, 2, 3], 1), ("dt", [1e-3, 2e-3], 2)):
        asked.clear()
        fixed = {**FIXED} if axis != "dt" else {}
        rows = measure(asdict(HANGING), [asdict(Setup("xpbd"))], fixed, axis, values, 4, device=device)
        assert len(asked) == count and all(cell["floor"] > 0.0 for cell in rows[0])


def made_up():
    """A survey of 4 × 2 cells, with a line from 0.1 to 10, and one of each verdict."""
    survey = Survey(HANGING, (Setup("newton"),), "dt", "stiffness", (1e-3, 1e-2, 1e-1, 1.0), (1.0, 10.0), {"iterations": 3})

    def cell(verdict, ratio, step=None):
        return stability._cell(verdict, "why, indeed", step=step, steps=40, floor=0.002) | {
            "rules": {"2/ω_max": ratio, KNOWN: ratio}
        }

    top = [cell("diverged", 10.0, 1), cell("diverged", 20.0, 40), cell("refused", None), cell("slow", None)]
    return survey, [[[cell("stable", 0.1), cell("inaccurate", 0.2), cell("stalled", 0.4), cell("unsure", 0.4)], top]]


def test_a_map_is_drawn(tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    kept = []
    saving = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (kept.append(self), saving(self, *a, **k)))
    survey, cells = made_up()
    survey = replace(survey, scene=SceneRef("a$^$.py"))
    plot_maps(tmp_path / "map.png", survey, cells, 0.01)
    (axes,) = kept[0].axes
    mesh, line, known = axes.collections
    colours = np.asarray(mesh.get_array())
    assert np.array_equal(colours[0], [_PLAIN[name] for name in ("stable", "inaccurate", "stalled", "stable")])
    assert colours[1, 0].sum() < colours[1, 1].sum() and np.array_equal(colours[1, 2], _PLAIN["refused"])
    (hatched,) = axes.patches
    assert hatched.get_hatch() and hatched.get_bbox().bounds == pytest.approx((-0.5, -0.5, 1.0, 1.0))
    assert np.array_equal(hatched.get_edgecolor()[:3], _PLAIN["inaccurate"])
    # The ratio is 0.1 in the lower cells and 10 in the upper: 1 half-way, on the logarithm.
    path = line.get_paths()[0].vertices
    assert path[np.isclose(path[:, 0], -3.0)][:, 1] == pytest.approx(0.5)
    assert np.array_equal(known.get_paths()[0].vertices, path), "the line beyond which the reference is not known"
    texts = {text.get_text() for text in kept[0].legends[0].get_texts()}
    named = {"stable", "inaccurate: off by more than 1 % of the size", "stalled", "stable or inaccurate, not known", "refused"}
    named |= {"slow", "diverged at once", "diverged in the end", "2/ω_max: largest stable step about the rest shape"}
    assert texts == named | {f"{KNOWN}: beyond, the reference is less accurate"}
    assert [label.get_text() for label in axes.get_xticklabels()] == ["0.001", "0.01", "0.1", "1"]
    assert "iterations 3" in kept[0]._suptitle.get_text() and axes.get_title() == "newton"
    for ending in ("svg", "pdf"):
        plot_maps(tmp_path / f"map.{ending}", survey, cells)
        before = (tmp_path / f"map.{ending}").read_bytes()
        plot_maps(tmp_path / f"map.{ending}", survey, cells)
        assert (tmp_path / f"map.{ending}").read_bytes() == before
    with pytest.raises(ValueError, match="the ending is"):
        plot_maps(tmp_path / "map.txt", survey, cells)


def test_a_table_has_a_line_for_each_cell(tmp_path):
    survey, cells = made_up()
    write_csv(tmp_path / "map.csv", survey, cells)
    with open(tmp_path / "map.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8 and rows[4]["verdict"] == "diverged" and rows[4]["step"] == "1" and rows[0]["step"] == ""
    assert [float(row["dt"]) for row in rows[:4]] == list(survey.xs) and rows[7]["2/ω_max"] == ""
    assert {row["floor"] for row in rows} == {"0.002"} and rows[1][KNOWN] == "0.2"
    assert rows[1]["reason"] == "why, indeed"


def run(capfd, *words):
    code = main(["chart", "stability", *map(str, words)])
    out, err = capfd.readouterr()
    return code, out, err


@pytest.mark.slow
def test_the_command(tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(campaign, "processes", lambda workers: ThreadPoolExecutor(1))
    given = ["hanging", "-p", "n=4", "--x", "dt", "--x-range", 1e-3, 1e-1, 3, "--y", "stiffness", "--y-range", 1, 100, 2]
    given += ["--steps", 8, "--duration", 0.1, "--workers", 1, "--solvers", "explicit", "pbd:iterations=4,sweep=sequential"]
    code, out, err = run(capfd, *given, "-o", tmp_path / "m.png", "--csv", tmp_path / "m.csv")
    assert code == 0, err
    assert re.match(r"explicit: \d stable, .*\d diverged\npbd iterations=4 sweep=sequential: ", out)
    assert (tmp_path / "m.png").stat().st_size > 1000 and (tmp_path / "m.csv").read_text().count("\n") == 13
    assert len((tmp_path / "cache" / "stability.jsonl").read_text().splitlines()) == 3
    code, out, err = run(capfd, *given, "--json")
    facts = json.loads(out)
    assert code == 0 and facts["axes"]["dt"] == [1e-3, 1e-2, 1e-1] and len(facts["maps"]["explicit"]) == 2
    assert facts["fixed"] == {} and facts["seed"] == 0 and facts["dtype"] == "float64" and facts["accuracy"] == 0.01
    assert facts["machine"]["source"] and facts["maps"]["explicit"][0][0]["machine"] == machine.name()
    with open(tmp_path / "m.csv", encoding="utf-8") as file:
        assert {row["machine"] for row in csv.DictReader(file)} == {machine.name()}
    assert len((tmp_path / "cache" / "stability.jsonl").read_text().splitlines()) == 3


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("--x dt --y dt", "each must be another"),
        ("--x dt --y height", "invalid choice: 'height'"),
        ("--x dt --y stiffness --solvers newtons", "solver is 'newtons'"),
        ("--x dt --y stiffness --solvers newton:dt=0.1", "the map sets the step"),
        ("--x dt --y stiffness --solvers newton newton", "a method stands twice"),
        ("--x dt --y stiffness --solvers newton:depth=2", "has no option 'depth'"),
        ("--x dt --y stiffness --at height=2", "--at has no axis 'height'"),
        ("--x dt --y stiffness --x-range 0 1 3", "low is 0"),
        ("--x iterations --y stiffness --at dt=0", "dt is 0"),
        ("--x iterations --y stiffness --at dt=-1/60", "dt is -0.01"),
        ("--x dt --y stiffness -p m=3", "no parameter 'm'"),
        ("--x dt --y stiffness --steps 0", "steps is 0"),
        ("--x dt --y stiffness --limit 0", "limit is 0"),
        ("--x dt --y stiffness --duration 0", "duration is 0"),
        ("--x dt --y stiffness -o map.doc", "the ending is '.doc'"),
        ("--x dt --y stiffness --csv nowhere/map.csv", "nowhere does not exist"),
        ("--x dt --y stiffness -o map.png --csv map.png", "is given for two outputs"),
        ("--x dt --y stiffness --workers 0", "workers is 0"),
        ("--x dt --y stiffness --device cuda:9", "device is 'cuda:9'"),
        ("--y stiffness", "required: --x"),
    ],
)
def test_wrong_use_is_said_in_a_line(words, says, capfd, tmp_path, monkeypatch):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    monkeypatch.setattr("warpcloth.lab.campaign.sweep", None)  # nothing is measured before
    code, out, err = run(capfd, "hanging", *words.split())
    assert code == 2 and says in err and err.count("\n") == 1 and not out
