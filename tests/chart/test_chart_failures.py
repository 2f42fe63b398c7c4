"""Charts of failures: what is measured meets the closed forms, and fails where theory says so."""

import csv
import json
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import pytest

from support.rows import slow_but
from warpcloth.chart.failures import plot_failure
from warpcloth.cli import main
from warpcloth.lab import campaign, cotangents, crossing, friction, isometry, locking, physics, rank, tunnelling
from warpcloth.lab.campaign import Store
from warpcloth.lab.failures import COLUMNS, FAILURES, failure_chart, write_csv
from warpcloth.lab.panels import Map, point

pytestmark = pytest.mark.host
EPS = np.finfo(np.float64).eps


@pytest.fixture(autouse=True)
def solved_once(monkeypatch):
    """No rest shape is solved for again for its time, nor moved for its floor, which no test here reads."""
    monkeypatch.setattr(physics, "_BRIEF", 0.0)
    monkeypatch.setattr(physics, "_moves", lambda scene, size: np.zeros((1, *scene.positions.shape)))


def of(points, panel, series):
    """x and value of a series, sorted by x."""
    found = sorted((p["x"], p["value"]) for p in points if (p["panel"], p["series"]) == (panel, series))
    assert found, series
    return np.array(found).T


# --- 9. Locking.


def test_an_imposed_cylinder_costs_its_chords(device):
    """K(κ²h²/24)²/2 over ½Dκ² is κ²h⁴K/576D: bent and fine or stiff and coarse are one; 1 where strain costs as much.

    Chords are shorter by 1 − 2 sin(κh/2)/κh = κ²h²/24·(1 − κ²h²/80 + …).
    """
    x, cost = of(locking.imposed(device), "cost", "threads round it, imposed")
    assert len(x) == 18 and x[0] < 1e-5 and x[-1] > 10.0
    assert np.abs(cost / x - 1.0).max() < 2.0 * (locking.CURVATURE / 8) ** 2 / 80.0
    assert ((cost > 1.0) == (x > 1.0)).all()


@pytest.mark.slow
def test_irregular_nets_lose_curvature_where_theory_says(device):
    """Of a sheet at rest when rolled up: nothing is lost below κ²h⁴K/576D = 1e-2, and by regular nets nowhere.

    There the strain is that of the shape, so that its cost goes as K, but for the softest parts, which give way by an eighth at
    4e-3; far above it is relieved.
    """
    moduli = [1e3, 3e3, 1e4, 1e9, 1e10]
    nets = {pattern: locking.relaxed(pattern, 8, moduli, device) for pattern in locking.NETS}
    kept = {pattern: of(points, "kept", f"{pattern}, h = 1/8 m") for pattern, points in nets.items()}
    cost = {pattern: of(points, "cost", f"{pattern}, h = 1/8 m") for pattern, points in nets.items()}
    h = locking.CURVATURE / 8
    assert np.abs(kept["equilateral"][1] - 1.0).max() < h**4 and cost["equilateral"][1].max() < 1e-6
    for pattern, most in (("jittered", 0.95), ("alternating", 0.75)):
        x, part = kept[pattern]
        assert (np.abs(part[x < 1e-2] - 1.0) < 0.02).all() and (part[x > 100.0] < most).all() and part.min() > 0.5
        soft, stiff = cost[pattern][1][x < 1e-2] / x[x < 1e-2], cost[pattern][1][x > 100.0]
        assert len(soft) == 3 and np.ptp(soft) < 0.15 * soft.max() and (np.diff(stiff) < 0.0).all()


@pytest.mark.slow
def test_a_cantilever_locks_apart_from_its_pattern(device):
    """Jittered nets of hinges are stiffer than D while the membrane is soft, which refinement leaves; locking falls with it."""
    stiffness = {}
    for pattern, bending in (("equilateral", "dihedral"), ("jittered", "dihedral"), ("jittered", "plate")):
        series = pattern if bending == "dihedral" else f"{pattern}, {bending}"
        for elements in (6, 12):
            points = locking.cantilever(pattern, elements, device, bending)
            for name in ("1e4", "1e8"):
                ((_, value),) = of(points, "refined", f"{series}, KL²/D = {name}").T
                stiffness[series, elements, name] = value
    coarse, fine = (stiffness["jittered, plate", n, "1e4"] - 1.0 for n in (6, 12))
    assert abs(fine) < abs(coarse) / 3.0 and abs(fine) < 0.06
    for elements in (6, 12):
        assert abs(stiffness["equilateral", elements, "1e4"] - 1.0) < 0.05 < 0.1 < stiffness["jittered", elements, "1e4"] - 1.0
    for pattern in ("equilateral", "jittered"):
        # Over the soft one: by κ²h⁴K/576D = 33 and 2.
        coarse, fine = (stiffness[pattern, n, "1e8"] / stiffness[pattern, n, "1e4"] - 1.0 for n in (6, 12))
        assert coarse > 0.5 and fine < coarse / 3.0
    assert stiffness["jittered", 6, "1e8"] > 1.2 * stiffness["equilateral", 6, "1e8"]


@pytest.mark.slow
def test_locking_alone_is_over_the_same_net_with_a_soft_membrane(device, monkeypatch):
    monkeypatch.setitem(locking._DECADES, 8, (4, 6, 8, 10))
    points = locking.cantilever("alternating", 8, device)
    x, value = of(points, "apparent", "alternating")
    at, alone = of(points, "locking", "alternating, h = L/8")
    assert x[0] == locking.SOFT and alone == pytest.approx(value / value[0], rel=1e-12)
    # The free length is not quite 1.
    assert at == pytest.approx(locking.ratio(0.5 * locking.GAMMA, 1 / 8, x), rel=0.5)
    rolled = of(points, "apparent", "alternating, rolled up, without membrane")[1]
    assert rolled == pytest.approx(1.5, rel=0.01) and value[0] < rolled[0]


@pytest.mark.parametrize("holding", locking._HOLDING)
def test_what_stiff_edges_leave_free_is_counted(holding):
    """3 + boundary edges, a vertex each of rows and columns, or rigid motion alone."""
    panel = next(panel for panel in locking.PANELS if panel.key == "freedom")
    law = panel.laws[panel.follows[holding]]
    for n in locking._COUNTED[:4]:
        ((boundary, left),) = of(locking.counted(holding, n), "freedom", holding).T
        assert left == law(boundary)


@pytest.mark.slow
def test_a_net_that_has_no_freedom_left_keeps_its_curvature_along_its_lines_alone(device):
    """Turned from them it loses the more; regular edges of triangles and rows bend in any direction, irregular ones do not."""
    kept = {}
    for holding in locking._HOLDING:
        for degrees in (0.0, 45.0):
            ((left, kept[holding, degrees]),) = of(locking.nearly_rigid(holding, degrees, device), "left", holding).T
            assert left < {"rows and columns": 1.3, "both diagonals": 0.03}.get(holding, 0.4)
    for loose in ("rows and columns", "edges"):
        assert [kept[loose, degrees] for degrees in (0.0, 45.0)] == pytest.approx([1.0, 1.0], abs=1e-4)
    assert max(kept["edges, jittered", degrees] for degrees in (0.0, 45.0)) < 0.95
    assert kept["both diagonals", 0.0] == pytest.approx(1.0, abs=1e-4) and kept["both diagonals", 45.0] < 0.5


@pytest.mark.slow
def test_what_has_no_stiffness_slides_on(device, monkeypatch):
    """Springs alone: three lengths of edge keep the curvature to (κh)², others lose more and more of it."""
    h, simulate = locking.CURVATURE / 10, locking.simulate

    def let_go(pattern, degrees, series, frames):
        monkeypatch.setattr(locking, "simulate", lambda *given, **options: simulate(*given, **options, frames=frames))
        return of(locking.let_go(pattern, degrees, device), "time", series)

    assert np.abs(let_go("equilateral", 0.0, "equilateral", 300)[1] - 1.0).max() < h**2
    t, kept = let_go("jittered", 40.0, "jittered, turned by 40°", 600)
    assert t[-1] == 10.0 and kept[-1] < 0.7 and kept[t < 0.2].min() > 0.9


# --- 10. to 13., which are measured at once.


@pytest.fixture(scope="module")
def charts(device):
    """Measures a chart by name, once."""

    @cache
    def chart(name):
        with ThreadPoolExecutor(1) as executor:
            return failure_chart(name, device, store=Store(), executor=executor)

    return chart


def laws(found, panel):
    """x, value and what the law expects, of all points of a panel that follow one, with their number."""
    rows = [row for row in found["rows"] if row["panel"] == panel and row["law"] is not None]
    return np.array([(row["x"], row["value"], row["expected"]) for row in rows]).T


@pytest.mark.slow
def test_quadratic_bending_holds_on_isometries_of_flat_sheets(charts):
    """x → x + εx² costs ½D(2ε)², exact for quadratic functions; a rest curvature is not seen. Angles see what bends.

    Rolled up a hinge of edge h turns by θ ≤ κh, and 2 sin(θ/2) is θ to θ²/24.
    """
    x, value, expected = laws(charts("isometry"), "stretch")
    h = isometry._H
    # Up to the rounding of y, eps|x|, against 2ε h².
    assert np.abs(value - expected).max() < 64 * EPS / h**2 and value.max() == pytest.approx(0.5 * 0.6**2)
    for panel in ("flat", "curved"):
        x, value, expected = laws(charts("isometry"), panel)
        curvature = np.maximum(np.abs(x), isometry.REST)
        assert (np.abs(value - expected) < (curvature * h) ** 2 / 6.0 * curvature**2).all()
    rows = charts("isometry")["rows"]
    at_rest = {name: value for name in physics.BENDING for x, value in of(rows, "curved", name).T if x == isometry.REST}
    for name in ("quadratic", "plate"):
        assert at_rest[name] == pytest.approx(0.5, rel=0.01), name
    assert abs(at_rest["dihedral"]) < EPS


def test_slivers_are_stiff_without_bound_down_to_the_guard(charts):
    """|∇θ| = 1/height, the same at any scale; 0 at 1e-6 of the longest side and below; the step goes as the height."""
    for size in ("1 m", "1 mm"):
        for dtype in ("float32", "float64"):
            x, value = of(charts("slivers")["rows"], "gradient", f"edge {size}, {dtype}")
            alive = x > 1e-6
            assert 0 < alive.sum() < len(x) and not value[~alive].any()
            # The height itself is rounded, and a dozen numbers lie between.
            assert np.abs(value[alive] * x[alive] - 1.0).max() < 16 * float(np.finfo(dtype).eps)
    x, value, expected = laws(charts("slivers"), "step")
    assert value == pytest.approx(expected, rel=1e-9)
    # ω² = cD|∇θ|²/m, where |∇θ|² = (1 + ½)/h² and c = 2/√¾ of a hinge one of whose triangles is a sliver.
    assert value[x < 1e-4] == pytest.approx(x[x < 1e-4] * 2.0 / np.sqrt(1.5 * 2.0 / np.sqrt(0.75)), rel=1e-3)


def test_a_hinge_folded_flat_turns_round(charts):
    """θ − θ̄ in (−π, π]: energy ½c(θ − θ̄)² and torque c(θ − θ̄), which jumps by 2π at θ̄ + π; quadratic 2c sin²(θ/2)."""
    for panel in ("energy", "torque"):
        _, value, expected = laws(charts("slivers"), panel)
        assert len(value) == 108 and np.abs(value - expected).max() < 64 * EPS
    for series, jump in (("dihedral, 0° at rest", 180.0), ("dihedral, 90° at rest", 270.0), ("quadratic", None)):
        x, torque = of(charts("slivers")["rows"], "torque", series)
        steps = np.diff(torque)
        assert (0.5 * (x[1:] + x[:-1]))[steps < -1.0].tolist() == ([jump] if jump else [])
        if jump:
            # Samples are 10° apart.
            assert steps.min() == pytest.approx(np.radians(10.0) - 2.0 * np.pi, rel=1e-12)


def test_cotangent_weights_are_negative_beyond_180_degrees(charts):
    """cot((α + β)/2) of two equal triangles, −.176 of two apexes of 100°; clamped and intrinsic ones are 0 there."""
    _, value, expected = laws(charts("cotangents"), "weight")
    # cot changes by 1/sin² of half the sum, 1.7 at most, times the rounding of angles.
    assert len(value) == 51 and np.abs(value - expected).max() < 64 * EPS
    rows = charts("cotangents")["rows"]
    weights = {name: dict(of(rows, "weight", name).T) for name in ("cotangent", "clamped", "intrinsic Delaunay")}
    assert weights["cotangent"][200.0] == pytest.approx(-0.17632698, rel=1e-7)
    assert weights["clamped"][200.0] == weights["intrinsic Delaunay"][200.0] == 0.0
    _, value, expected = laws(charts("cotangents"), "precision")
    assert len(value) == 45 and np.abs(value - expected).max() < 256 * EPS and expected.max() > 1.0


def test_negative_weights_tear_a_sheet_apart(charts):
    """Spokes end below 0 as soon as a weight is negative; clamped, intrinsic inside, and rims do not.

    Those end within 10 times what the tolerance of 1e-6 leaves of edges of 1.
    """
    rows = charts("cotangents")["rows"]
    for name in cotangents.CHOICES:
        x, energy = of(rows, "energy", name)
        failed = x > 180.0 if name == "cotangent" else np.zeros(len(x), dtype=bool)
        assert (energy[failed] < -1e-3).all() and (np.abs(energy[~failed]) < 100 * 1e-12).all()
        negative, stretch = of(rows, "bend", name)
        # The boundary of a mesh has negative weights in any triangulation.
        assert (stretch[negative > 12.0] > 1.5).all() if "tan" in name or "Delaunay" in name else (stretch < 1.25).all()


def test_rotations_are_known_to_their_rank(charts):
    """To ε(σ₁/σ₂)² about the line of the points, and the line itself to rounding."""
    rows = charts("rank")["rows"]
    for dtype, eps in rank.EPS.items():
        x, error = of(rows, "line", f"{dtype}: the rotation")
        law = np.array([rank.known(ratio, dtype) for ratio in x])
        # Twenty points are added.
        assert (error < 20.0 * law).all() and (error > law / 20.0).all()
        assert of(rows, "line", f"{dtype}: where the line goes")[1].max() < 20.0 * eps
        x, share = of(rows, "reflection", f"U Vᵀ, {dtype}")
        assert not share[x > 2.0 * np.sqrt(eps)].any() and (share[x < 0.1 * np.sqrt(eps)] > 20.0).all()
        assert not of(rows, "reflection", f"kabsch, {dtype}")[1].any()


def test_what_a_line_keeps_of_a_turn(charts):
    """A plane the turn, a line the angle between itself and where it goes, a point nothing."""
    x, value, expected = laws(charts("rank"), "turn")
    # cos of the angle of a rotation is that of a sum of three numbers; near 180° its root is lost, half the digits.
    assert len(x) == 57 and np.radians(np.abs(value - expected)).max() < 4.0 * np.sqrt(EPS)
    assert of(charts("rank")["rows"], "turn", "on a line")[1].max() == pytest.approx(90.0, abs=1e-6)
    assert not of(charts("rank")["rows"], "turn", "in one place")[1].any()


# --- 15. Tunnelling.


def shares(solver, wall, step, speeds, device):
    """Of each speed the share of the vertices that pass the wall, or with the filter that are cut [%]; and the series."""
    points = tunnelling.measure(solver, wall, [step], speeds, device)
    assert [(p["x"], p["y"]) for p in points] == [(step, v) for v in speeds]
    return [p["value"] for p in points], {p["series"] for p in points}


@pytest.mark.parametrize("solver", ["explicit", "xpbd"])
def test_no_vertex_passes_triangles(solver, device):
    """Also those that need several rounds of the filter, and those that begin far from the wall."""
    passed, _cut = tunnelling.flights(solver, "filter, triangles", 1e-3, [1.0, 10.0, 100.0], device)
    assert not passed.any()


def test_lines_of_tunnelling():
    """r = 1 mm, ω = √(98 100)/s: ωr = .3132 m/s; the logarithm down to r/1000 holds √(2(2 + ln 500))/2 = 2.027 times that."""
    (h,) = {panel.laws["v h = r"](2e-3) for panel in tunnelling.PANELS}
    assert h == 0.5 and {panel.laws["v h = 2r"](2e-3) for panel in tunnelling.PANELS} == {1.0}
    by_key = {panel.key: panel.laws for panel in tunnelling.PANELS}
    for key, most in (("explicit, energy alone", 0.31321), ("newton, energy alone", 0.63481), ("newton, filter", 24.525)):
        assert list(by_key[key].values())[2](1e-3) == pytest.approx(most, rel=1e-4)
    assert len(by_key["pbd, filter"]) == 2 and len(by_key) == 16


@pytest.mark.slow
def test_contact_alone_passes_where_theory_says(device):
    """Speeds of 0.9 and more than 1 or 2 times each line; of a step of 1 ms the energy is what gives way."""
    assert shares("explicit", "energy alone", 1e-3, [0.28, 0.35], device) == ([0.0, 100.0], {"stays outside", "passes"})
    few, some = shares("newton", "energy alone", 0.02, [0.045, 0.11], device)[0]
    assert (few, some) == (0.0, 100.0)
    assert 0.0 < shares("newton", "energy alone", 0.02, [0.075], device)[0][0] < 100.0  # by the phase
    points = tunnelling.measure("explicit", "energy alone", [0.02], [1.0, 2.0], device)
    assert all(p["value"] is None and p["series"] == "refused" and "stable below 0.0062958 s" in p["reason"] for p in points)


@pytest.mark.slow
def test_the_filter_cuts_what_theory_says(device):
    """Explicit steps where the energy gives way, implicit ones where the minimiser of a step is nearer than r/1000."""
    assert shares("explicit", "filter", 1e-3, [0.28, 0.35, 50.0], device) == ([0.0, 100.0, 100.0], {"stays outside"})
    # The prediction is beyond the wall by up to v h, as the phase is: all are cut only above the line. Iterates stay apart from
    # triangles, so that no move is left to be cut.
    none, some = shares("newton", "filter", 1e-3, [20.0, 60.0], device)[0]
    assert none == 0.0 and some > 50.0
    assert shares("newton", "filter, triangles", 1e-3, [20.0, 60.0], device) == ([0.0, 0.0], {"stays outside"})


@pytest.fixture(scope="module")
def tunnels(device):
    """The chart of two steps and two speeds."""
    with ThreadPoolExecutor(1) as executor, pytest.MonkeyPatch.context() as patch:
        for name, values in (("STEPS", [2e-3, 1 / 24]), ("SPEEDS", [1.0, 100.0]), ("PHASES", [0.0, 0.5])):
            patch.setattr(tunnelling, name, np.array(values))
        return failure_chart("tunnelling", device, store=Store(), executor=executor)


@pytest.mark.slow
def test_no_solver_lets_a_sheet_pass(tunnels):
    """At 1 and 100 m/s, of steps to 1/24 s, a box of 1 µm and triangles."""
    kept = [row for row in tunnels["rows"] if "filter" in row["panel"]]
    assert len(kept) == 48 and {row["series"] for row in kept} == {"stays outside", "refused"}
    assert {row["panel"] for row in kept if row["series"] == "refused"} == {"explicit, filter", "explicit, filter, triangles"}


# --- 16. Friction.


def test_laws_of_friction():
    panels = {panel.key: panel for panel in friction.PANELS}
    (slides,) = panels["acceleration"].laws.values()
    assert [slides(30.0), slides(16.0)] == [pytest.approx(2.35629, rel=1e-5), 0.0]
    anchored, smooth, huber = panels["creep"].laws.values()
    assert [anchored(0.9), smooth(0.9), huber(0.9)] == pytest.approx([0.0, 0.68377, 0.9], rel=1e-4)  # [mm/s]
    assert panels["newton"].laws["tan θ = μ"](16.699) == pytest.approx(0.3, rel=1e-4)
    assert {panel.key for panel in friction.PANELS if isinstance(panel, Map)} == set(friction.TAKERS)
    assert set(friction.TAKERS) == set(friction.SETTINGS)


def test_kinds_of_motion():
    """As IPC's smoothing creeps at tan θ = 0.9 μ; a swing of 1e-5 m/s is none; a speed gained within a third is a slide."""
    assert friction.kind(0.684e-3, 0.0) == "creeps" and friction.kind(-0.684e-3, 0.0) == "creeps"
    assert friction.kind(1e-5, 0.0) == "sticks" and friction.kind(1e-5, -1e-2) == "sticks"
    assert friction.kind(0.01, 0.028) == "slides"


slow = pytest.mark.slow


@pytest.mark.parametrize("solver", [pytest.param(s, marks=[slow] * (s != "xpbd")) for s in friction.TAKERS])
def test_sheets_stick_below_the_line_and_slide_above_it(solver, device):
    """tan θ = 0.9 and 1.1 μ, and 30°. What iterations leave of a step is 1e-6 of gravity, or less."""
    slopes = [*np.degrees(np.arctan([0.27, 0.33])).tolist(), 30.0]
    points = friction.mapped(solver, 0.3, device, slopes)
    assert [p["series"] for p in points[:3]] == ["sticks", "slides", "slides"]
    x, a = of(points, "acceleration", solver)
    law = [friction.acceleration(slope) for slope in x]
    assert np.abs(a - law).max() < 1e-5 * 9.81 and law[0] == 0.0
    ((_, creep),) = of(friction.sticking(solver, [0.9], device), "creep", solver).T
    assert abs(creep) < (1e-2 if solver == "explicit" else 1e-6)  # [mm/s]; explicit steps swing


def test_few_iterations_mistake_friction(device):
    _x, found = of(friction.iterated("admm", [5, 300], device), "iterations", "admm")
    assert abs(found[0] - 0.3) > 0.1 and found[1] == pytest.approx(0.3, abs=1e-3)


# --- 17. Sheets that cross one another.


def test_lines_of_crossing():
    """Energy stops √2 times the speed that it stops at a wall."""
    by_key = {panel.key: panel.laws for panel in crossing.PANELS}
    assert by_key["explicit, without"]["½ρv² = kr²"](1e-3) == pytest.approx(0.44294, rel=1e-4)
    assert by_key["newton, filter"]["ρv² = kr²(2 + ln r/2δ)"](1e-3) == pytest.approx(0.63481 * 2.0**0.5, rel=1e-4)
    assert by_key["pbd, filter"]["v h = r + skin"](1e-2) == pytest.approx(100.0 * (1e-3 + 0.35 * 0.05 * 2.0**0.5))
    assert len(by_key["pbd, filter"]) == 1 and len(by_key) == 12


@pytest.mark.slow
def test_sheets_cross_without_the_filter_where_theory_says(device):
    """In short steps by their energy, in steps of 20 ms from r/h = 0.05 m/s on in some phases; with sweeps from 1.29 m/s on.

    Pairs of edges, which have a common vertex if one sheet is put upon the other, add Σ k(π/2)bb′φ to Σ kAφ of Newton's method.
    """

    def crossed(solver, step, speeds):
        return [p["value"] for p in crossing.measure(solver, "without", [step], speeds, device)]

    mesh = crossing.Mesh.grid(3, 3, size=crossing.SIDE)
    meet = (mesh.edges[:, None, :, None] == mesh.edges[None, :, None, :]).any(axis=(2, 3))
    of_edges = (mesh.vertex_areas / np.bincount(mesh.edges.ravel()))[mesh.edges].sum(axis=1) / mesh.edge_lengths
    more = 0.5 * np.pi * (of_edges @ meet @ of_edges) / mesh.vertex_areas.sum()
    most = 0.63481 * np.sqrt(2.0 * (1.0 + more))
    assert crossed("explicit", 1e-4, [0.95 * 0.44294, 1.05 * 0.44294]) == [0.0, 100.0]
    few, some, none = crossed("newton", 0.02, [0.045, 0.11, 0.5])
    assert few == 0.0 and some == none == 100.0
    assert crossed("newton", 2.5e-4, [0.5, 1.05 * most]) == [0.0, 100.0]
    for solver in ("pbd", "xpbd"):
        slow, slower, some = crossed(solver, 0.02, [0.05, 1.2, 4.0])
        assert slow == slower == 0.0 and some >= 25.0


@pytest.fixture(scope="module")
def crossings(device):
    """The chart of two steps and three speeds."""
    with ThreadPoolExecutor(1) as executor, pytest.MonkeyPatch.context() as patch:
        for name, values in (("STEPS", [2e-3, 1 / 24]), ("SPEEDS", [1.0, 21.5, 100.0]), ("PHASES", [0.0, 0.5])):
            patch.setattr(crossing, name, np.array(values))
        return failure_chart("crossing", device, store=Store(), executor=executor)


@pytest.mark.slow
def test_no_solver_lets_sheets_cross(crossings):
    """At 1 to 100 m/s, with steps of up to 1/24 s. Without the filter, sheets cross with each solver that is shown.

    At 21.5 m/s, a step of `Newton` would end with each sheet beyond the other if they could pass beside each other.
    """
    kept = [row for row in crossings["rows"] if "filter" in row["panel"]]
    assert len(kept) == 48 and {row["series"] for row in kept} == {"stays apart", "refused"}
    assert {row["panel"] for row in kept if row["series"] == "refused"} == {"explicit, filter"}
    left = {row["panel"] for row in crossings["rows"] if row["series"] == "crosses"}
    assert left == {f"{solver}, without" for solver in crossing.SHOWN["without"]}


def test_edges_that_go_through_triangles():
    """One sheet above another, through it, and beside it."""
    grid = crossing.sheets(1e-2, 0.0).mesh
    below, triangles = grid.points[:9], grid.triangles[:8]
    tilted = below @ np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    moves = np.array([[0.01, 0.01, 0.0], [0.003, 0.004, 0.002], [0.2, 0.0, 0.0]])
    others = np.stack([below, tilted, tilted]) + moves[:, None]
    assert crossing.cross(np.stack([below] * 3), others, triangles).tolist() == [False, True, False]


# --- Tables, pictures, command.

MEASURED = pytest.mark.parametrize("name", slow_but(["rank"], ["isometry", "slivers", "cotangents", "rank"]))


@MEASURED
def test_rows_have_their_laws_and_a_table_a_line_for_each(name, charts, tmp_path):
    found = charts(name)
    assert found["failure"] == name and json.dumps(found, allow_nan=False)
    panels = {panel.key: panel for panel in FAILURES[name].PANELS}
    assert {row["panel"] for row in found["rows"]} == set(panels) == set(found["panels"])
    for panel in panels.values():
        series = {row["series"] for row in found["rows"] if row["panel"] == panel.key}
        assert set(panel.follows) <= series and set(panel.follows.values()) <= set(panel.laws)
    write_csv(tmp_path / "t.csv", found)
    with open(tmp_path / "t.csv", encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert tuple(table[0]) == COLUMNS and len(table) == len(found["rows"])
    assert [float(row["x"]) for row in table] == [row["x"] for row in found["rows"]]


@MEASURED
def test_points_and_laws_are_drawn(name, charts, tmp_path, monkeypatch):
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    kept, saving = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (kept.append(self), saving(self, *a, **k)))
    if name != "rank":  # half of the time is for places of axes, at which nothing here looks
        monkeypatch.setattr(ConstrainedLayoutEngine, "execute", lambda *given: None)
    plot_failure(tmp_path / "a.svg", charts(name))
    if name == "rank":
        plot_failure(tmp_path / "b.svg", charts(name))
        assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert len(kept[0].axes) == len(FAILURES[name].PANELS)
    for axes, panel in zip(kept[0].axes, FAILURES[name].PANELS, strict=True):
        lines = {line.get_label(): line for line in axes.lines}
        assert set(panel.laws) <= set(lines) and axes.get_xlabel() == panel.x and axes.get_title(loc="left") == panel.title
        for row in charts(name)["rows"]:
            if row["panel"] == panel.key:
                assert row["value"] in lines[row["series"]].get_ydata(orig=True)
        for series, law in panel.follows.items():
            assert lines[series].get_linewidth() == 0.0 and panel.laws[law](1.0) is not None


@pytest.mark.slow
def test_maps_are_drawn(tunnels, tmp_path, monkeypatch):
    """A cell for each point, its lines, a cross where a sheet passes, and each key once."""
    from matplotlib.figure import Figure

    kept, saving = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (kept.append(self), saving(self, *a, **k)))
    few = [panel for panel in tunnelling.PANELS if panel.key in ("newton, energy alone", "newton, filter", "explicit, filter")]
    monkeypatch.setattr(tunnelling, "PANELS", few)
    monkeypatch.setattr(friction, "PANELS", [panel for panel in friction.PANELS if panel.key in ("xpbd", "creep")])
    row = next(row for row in tunnels["rows"] if row["panel"] == "newton, filter")
    passing = [{**each, "series": "passes"} if each is row else each for each in tunnels["rows"]]
    plot_failure(tmp_path / "a.svg", {**tunnels, "rows": passing})
    (figure,) = kept
    for axes, panel in zip(figure.axes, few, strict=False):
        (cells,) = axes.collections
        shown = [r["value"] for r in tunnels["rows"] if r["panel"] == panel.key]
        assert sorted(cells.get_array().compressed()) == sorted(value for value in shown if value is not None)
        assert len(axes.lines) == len(panel.laws) + (panel.key == "newton, filter")
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words[-2:] == ["a sheet passes", "refused"] and set(words[:-2]) == set(tunnelling.LAWS)
    of_friction = [point("xpbd", kind, x, 0.0, y=0.3) for x, kind in enumerate(friction.KINDS)]
    of_friction.append(point("creep", "xpbd", 0.5, 0.0))
    plot_failure(tmp_path / "b.svg", {**tunnels, "failure": "friction", "title": friction.TITLE, "rows": of_friction})
    assert kept[1].axes[0].collections[0].get_array().tolist() == [[0.0, 1.0, 2.0]]
    assert [text.get_text() for text in kept[1].legends[0].get_texts()] == ["tan θ = μ", *friction.KINDS]


def test_a_point_without_a_value_is_left_out_and_said(charts, tmp_path, capsys, monkeypatch):
    lost = {**charts("rank"), "rows": [*charts("rank")["rows"], point("turn", "on a line", 9.0, None, "too slow")]}
    lost["rows"][-1] |= {"law": None, "expected": None}
    plot_failure(tmp_path / "a.png", lost)
    monkeypatch.setattr("warpcloth.lab.failures.failure_chart", lambda *a, **k: lost)
    assert main(["chart", "failure", "rank"]) == 0
    out = capsys.readouterr().out
    assert "no value      on a line, 9: too slow" in out and "turn          58 points, 57 of them off their law by" in out


def test_without_libigl_it_says_what_is_missing(device):
    rows = cotangents.measure(device, libigl=False)
    lost = [row for row in rows if row["series"] == "intrinsic Delaunay"]
    assert len(lost) == 4 and all(row["value"] is None and "pip install" in row["reason"] for row in lost)


@pytest.mark.slow
def test_the_command(tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(campaign, "processes", lambda workers: ThreadPoolExecutor(1))
    given = ["chart", "failure", "isometry", "--workers", "1"]
    assert main([*given, "-o", str(tmp_path / "i.png"), "--csv", str(tmp_path / "i.csv")]) == 0
    out = capfd.readouterr().out
    assert out.startswith("10. Quadratic and plate bending") and "off their law by" in out
    assert (tmp_path / "i.png").stat().st_size > 1000 and (tmp_path / "i.csv").is_file()
    assert len((tmp_path / "cache" / "failures.jsonl").read_text().splitlines()) == 1
    assert main([*given, "--json"]) == 0
    facts = json.loads(capfd.readouterr().out)
    assert len(facts["rows"]) == 117 and facts["machine"]["source"] and len(facts["panels"]) == 3


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("wrinkles", "invalid choice: 'wrinkles'"),
        ("", "required: FAILURE"),
        ("rank -o map.doc", "the ending is '.doc'"),
        ("rank --csv nowhere/a.csv", "nowhere"),
        ("rank -o a.png --csv a.png", "a.png"),
        ("rank --workers 0", "workers is 0"),
        ("rank --device cuda:9", "device is 'cuda:9'"),
        ("rank -p n=4", "unrecognized arguments"),
    ],
)
def test_wrong_use_is_said_in_a_line(words, says, capfd):
    assert main(["chart", "failure", *words.split()]) == 2
    out, err = capfd.readouterr()
    assert says in err and err.count("\n") == 1 and not out


def test_an_unknown_failure_is_refused():
    with pytest.raises(ValueError, match="failure is 'wrinkles'; it must be one of 'locking', 'isometry'"):
        failure_chart("wrinkles")
