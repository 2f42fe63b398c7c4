"""Reference solutions and errors against them: bounds, orders, files, what is refused."""

import json
import warnings
from dataclasses import asdict, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy.integrate import solve_ivp

import warpcloth as wc
from support.rows import slow_but
from warpcloth.base.digest import scene_digest
from warpcloth.kernels.terms.spring import SPRING
from warpcloth.lab import own_reference as own_reference_module
from warpcloth.lab import reference as module
from warpcloth.lab import trajectory
from warpcloth.lab.clock import mean_time, time_spread
from warpcloth.lab.measurements import SceneRef, Setup
from warpcloth.lab.own_reference import CUT, of_own, own_facts, own_reference, own_references, words_of_own
from warpcloth.lab.reference import Reference, cloth_size, position_error, reference, strain_error
from warpcloth.lab.trajectory import measure

# Soft enough to be smooth in steps of 1/16 frame: ωh at most 0.1.
CHAIN = SceneRef("chain", {"links": 5, "stiffness": 20.0})
CLOTH = SceneRef("hanging", {"n": 8, "stiffness": 200.0, "density": 10.0})
FRAMES = 6


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A folder for the references of all tests that do not look into it."""
    return tmp_path_factory.mktemp("kept")


@pytest.fixture
def shared(kept, monkeypatch):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(kept))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where references are kept in this test alone."""
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    return tmp_path / "references"


@pytest.fixture
def runs(monkeypatch):
    """Substeps of all runs that references take."""
    taken, simulate = [], module.simulate
    monkeypatch.setattr(
        module, "simulate", lambda scene, solver, **rest: taken.append(solver) or simulate(scene, solver, **rest)
    )
    return taken


def written(path, body):
    """A scene of two masses on a string, of a file."""
    lines = [
        "import numpy as np",
        "import warpcloth as wc",
        "def scene():",
        "    mesh = wc.Mesh.chain(3, direction=(1.0, 0.0, 0.0))",
    ]
    path.write_text("\n".join([*lines, f"    return wc.Scene(mesh, masses=[0.1, 0.1, 0.1], pins=[0], {body})\n"]))
    return SceneRef(str(path))


@cache
def true_chain():
    """The motion of :data:`CHAIN` to 1e-11, without any of Warp, (FRAMES + 1, 6, 3)."""
    scene = CHAIN.load()
    k, lengths, masses = 20.0, scene.mesh.edge_lengths, scene.vertex_masses

    def rate(t, state):
        y, v = state.reshape(2, -1)
        stretch = k * (np.diff(y) + lengths)  # y falls along the chain
        force = -masses * 9.81
        force[:-1] += stretch
        force[1:] -= stretch
        return np.concatenate([v, np.where(np.arange(6) > 0, force / masses, 0.0)])

    start = np.concatenate([scene.positions[:, 1], np.zeros(6)])
    times = np.arange(FRAMES + 1) / scene.fps
    found = solve_ivp(rate, (0.0, times[-1]), start, method="DOP853", rtol=1e-12, atol=1e-13, t_eval=times)
    points = np.zeros((FRAMES + 1, 6, 3))
    points[..., 1] = found.y[:6].T
    return points


def errors(scene, solver, substeps, **options):
    """Errors of position and strain against a reference known to 1e-10, and its own, (S, 2) and (2,)."""
    exact = reference(scene, FRAMES, tolerance=1e-10)
    found = []
    for s in substeps:
        setup = {"solver": solver, "options": {"substeps": s, **options}}
        result = measure(asdict(scene), setup, reference=exact.path, dtype="float64")
        assert (result["status"], result["reason"], result["frames"]) == ("ok", "", FRAMES)
        found.append((result["error"], result["strain_error"]))
    return np.array(found), np.array([exact.error, exact.strain_error])


METHODS = {
    "newton euler": ("newton", {"integrator": "euler", "tolerance": 1e-9}, 1),
    "newton midpoint": ("newton", {"integrator": "midpoint", "tolerance": 1e-9}, 2),
    "newton bdf2": ("newton", {"integrator": "bdf2", "tolerance": 1e-9}, 2),
    "explicit": ("explicit", {}, 1),
    # All that minimise a step have the order of what they minimise, once they have.
    **{
        f"{solver} {integrator}": (solver, {"integrator": integrator, **solved}, order)
        for solver, solved in (
            ("projective-dynamics", {"iterations": 400, "tolerance": 1e-12, "acceleration": "none"}),
            ("admm", {"iterations": 400, "tolerance": 1e-12}),
            ("xpbd", {"iterations": 100}),
            ("constrained-dynamics", {"iterations": 50, "tolerance": 1e-10}),
        )
        for integrator, order in (("euler", 1), ("midpoint", 2), ("bdf2", 2))
    },
}


@pytest.mark.parametrize(
    ("scene", "method"),
    slow_but(
        [(CLOTH, method) for method in list(METHODS)[::3]],
        [*((CHAIN, method) for method in list(METHODS)[:4]), *((CLOTH, method) for method in METHODS)],
    ),
    ids=str,
)
def test_errors_fall_with_the_order_of_the_method(scene, method, shared):
    """As far as the reference is known, which no two methods agree on by chance: it is explicit and extrapolated."""
    solver, options, order = METHODS[method]
    found, floor = errors(scene, solver, (16, 32), **options)
    assert (found[-1] > 10.0 * floor).all()
    assert np.abs(np.log2(found[0] / found[1]) - order).max() < 0.15


@pytest.mark.slow
def test_contact_has_a_reference(shared):
    """A sheet that slides, once its anchors are stretched, by g(sin 30° − 0.3 cos 30°); others meet it, by first order."""
    scene = SceneRef("incline", {"n": 3})
    exact = reference(scene, 6, tolerance=1e-3)
    down = np.array([np.sqrt(0.75), -0.5, 0.0])
    along = ((exact.points - exact.points[0]) @ down).mean(axis=1)
    assert exact.method == "Newton" and np.diff(along[3:], 2) * 60.0**2 == pytest.approx(2.35629, rel=1e-3)
    for solver, options in (("explicit", {}), ("xpbd", {"integrator": "bdf2", "iterations": 20})):
        results = [
            measure(
                asdict(scene), {"solver": solver, "options": {"substeps": s, **options}}, reference=exact.path, dtype="float64"
            )
            for s in (20, 80)
        ]
        coarse, fine = (result["error"] for result in results)
        assert fine < 1e-3 and fine < 0.5 * coarse + exact.error


@wp.func
def spring_gradient_by_a_hundredth_too_large(y: Any, rest: Any):
    return y.dtype(1.01) * wp.static(SPRING.gradient)(y, rest)


def test_a_wrong_gradient_is_exposed(shared, monkeypatch):
    """Its error stays where it is, far above that of the reference; with the right one it falls by half."""
    substeps = (1024, 2048, 4096)
    right, floor = errors(CHAIN, "explicit", substeps)
    monkeypatch.setattr(wc.Spring, "term", replace(SPRING, name="Wrong", gradient=spring_gradient_by_a_hundredth_too_large))
    wrong, _ = errors(CHAIN, "explicit", substeps)
    assert np.allclose(right[1:], 0.5 * right[:-1], rtol=0.05)
    assert (wrong[-1] > 0.9 * wrong[-2]).all() and (wrong[-1] > 1e3 * floor).all() and (wrong[-1] > 10.0 * right[-1]).all()


# What e(h) − e(2h) is of the error of e(h), which is of order q: 2^q − 1. Symplectic Euler 2; BDF2 3, or 4 where terms cancel.
@pytest.mark.parametrize(("explicit", "least", "most"), [(4096, 2.8, 3.2), (0, 6.0, 16.0)], ids=["explicit", "newton"])
def test_the_error_is_a_bound(explicit, least, most, folder, monkeypatch):
    """Against an independent integration of the chain to 1e-11, and a reference of a hundredth of the error."""
    monkeypatch.setattr(module, "_MAX_EXPLICIT", explicit)
    for scene in (CHAIN, CLOTH):
        coarse = reference(scene, FRAMES, tolerance=1e-6)
        points = true_chain() if scene is CHAIN else reference(scene, FRAMES, tolerance=1e-2 * coarse.error).points
        mesh = scene.load().mesh
        for estimate, distance in ((coarse.error, position_error), (coarse.strain_error, strain_error)):
            assert least < estimate / distance(coarse.points[1:], points[1:], mesh) < most


def test_the_error_bounds_chaos_too(folder):
    """Cloth that swings through loses the order at first, but not the bound."""
    scene = SceneRef("hanging", {"n": 6})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        coarse, fine = (reference(scene, tolerance=tolerance) for tolerance in (1e-3, 1e-5))
    assert coarse.substeps < fine.substeps
    true = position_error(coarse.points[1:], fine.points[1:], scene.load().mesh)
    assert fine.error < true < coarse.error


def test_a_reference_is_found_again(folder, runs):
    said = []
    first = reference(CHAIN, 2, progress=lambda *state: said.append(state))
    taken = len(runs)
    assert taken >= 3 and said[0] == (runs[0].substeps, 0, 2) and said[-1] == (first.substeps, 2, 2)
    again = reference(SceneRef(CHAIN.name, {**CHAIN.parameters, "duration": 2.0}), 2)
    assert len(runs) == taken and again.path == first.path and again.seconds == first.seconds
    assert np.array_equal(again.points, first.points) and np.allclose(again.times, [0.0, 1 / 60, 2 / 60])
    assert first.points.dtype == np.float64 and np.array_equal(first.points[0], CHAIN.load().positions)
    assert [path.name for path in folder.iterdir()] == [f"{first.key}.npz"]
    reference(CHAIN, 2, tolerance=0.1 * first.error)
    assert len(runs) > taken, "a smaller tolerance needs new runs"
    taken = len(runs)
    reference(CHAIN, 2, tolerance=0.1 * first.error)
    assert len(runs) == taken and len(list(folder.iterdir())) == 1


def test_a_folder_that_cannot_be_made_is_said_before_minutes_of_runs(tmp_path, runs, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path / "file"))
    with pytest.raises(OSError, match="file"):
        reference(CHAIN, 2)
    assert not runs


def test_another_reference_is_not_found(folder, runs, monkeypatch):
    for scene, frames in ((CHAIN, 2), (SceneRef("chain", {"links": 5, "stiffness": 21.0}), 2), (CHAIN, 3), (CHAIN, 2)):
        if len(list(folder.glob("*"))) == 3:
            monkeypatch.setattr(module, "source_digest", lambda: "another")
        runs.clear()
        reference(scene, frames)
        assert runs
    assert len(list(folder.iterdir())) == 4


@pytest.mark.parametrize("broken", ["cut", "text", "empty", "another"])
def test_broken_files_are_replaced(broken, folder, runs):
    first = reference(CHAIN, 2)
    path = folder / f"{first.key}.npz"
    content = path.read_bytes()
    if broken == "another":
        replace(first, key="0" * 24).save()
    else:
        path.write_bytes({"cut": content[: len(content) // 2], "text": b"nothing", "empty": b""}[broken])
        with pytest.raises(ValueError, match=r"is no reference solution, or broken .*; remove it"):
            Reference.load(path)
    runs.clear()
    assert np.array_equal(reference(CHAIN, 2).points, first.points) and runs
    assert Reference.load(path).key == first.key
    with pytest.raises(FileNotFoundError):
        Reference.load(folder / "none.npz")


@pytest.mark.parametrize("when", ["running", "writing"])
def test_an_interrupt_leaves_nothing(when, folder, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    def half(file, **_):
        file.write(b"half")
        stop()

    if when == "writing":
        monkeypatch.setattr(np, "savez", half)
    with pytest.raises(KeyboardInterrupt):
        reference(CHAIN, 2, progress=stop if when == "running" else None)
    assert not list(folder.glob("*"))


def test_hard_constraints(folder, tmp_path):
    """A pendulum of two hard strings: by constrained dynamics, whose steps keep them."""
    string = "terms=[wc.Spring(stiffness=np.inf)], duration=0.2"
    found = reference(written(tmp_path / "hard.py", string))
    mesh = wc.Mesh.chain(3, direction=(1.0, 0.0, 0.0))
    assert found.method == "ConstrainedDynamics" and found.error < 1e-3
    # Each run keeps their length; of what is extrapolated the error is that of the rest.
    assert strain_error(found.points[1:], np.tile(mesh.points, (12, 1, 1)), mesh) < 3.0 * found.strain_error
    bodies = reference(SceneRef("mobile", {"n": 3}), 2)
    assert bodies.method == "ConstrainedDynamics" and bodies.error < 1e-3


def test_what_has_no_reference_says_so(folder, tmp_path):
    limit = "terms=[wc.Spring(stiffness=10.0), wc.StrainLimit(most=1.1)], density=0.1, fps=60.0"
    limited = tmp_path / "limit.py"
    limited.write_text(
        f"import warpcloth as wc\ndef scene():\n    return wc.Scene(wc.Mesh.grid(3, 3), name='limited', {limit})\n"
    )
    with pytest.raises(ValueError, match="no reference solution of limited: ConstrainedDynamics cannot take StrainLimit"):
        reference(SceneRef(str(limited)))
    with pytest.raises(ValueError, match="the reference of chain needs more than 1e-09 s; give it more time"):
        reference(CHAIN, limit=1e-9)
    with pytest.raises(ValueError, match="tolerance is 0"):
        reference(CHAIN, tolerance=0)
    with pytest.raises(ValueError, match="frames is 0"):
        reference(CHAIN, 0)
    assert not list(folder.glob("*"))


@pytest.mark.slow
def test_what_is_slow_or_not_known_warns(folder, tmp_path, monkeypatch):
    stiff = written(tmp_path / "stiff.py", "terms=[wc.RigidCluster(vertices=[[0, 1, 2]], stiffness=1e14)], duration=0.05")
    with pytest.warns(
        UserWarning, match=r"RigidCluster makes the reference of scene slow: .* below 20000 explicit steps a frame"
    ):
        assert reference(stiff).method == "Newton"
    with pytest.warns(UserWarning, match=r"chain.* is known to .* only, not to 1e-20: smaller steps make it no less, for"):
        assert reference(CHAIN, 2, tolerance=1e-20, limit=1e3).limit == np.inf
    monkeypatch.setattr(module, "_idle", lambda errors: False)
    with pytest.warns(
        UserWarning, match=r"reference of chain.* is known to .* only, not to 1e-20: give it more time, or fewer"
    ):
        found = reference(CHAIN, 1, tolerance=1e-20, limit=0.5)
    assert found.limit == 0.5
    with pytest.warns(UserWarning, match="is known to"):
        assert reference(CHAIN, 1, tolerance=1e-20, limit=0.4).seconds == found.seconds


def test_motion_that_no_step_resolves_ends_early(folder, monkeypatch):
    """Runs that differ by as much however small the step, as those of chaotic motion do."""
    scatter, simulate = np.random.default_rng(0), module.simulate

    def scattered(*arguments, **options):
        run = simulate(*arguments, **options)
        return replace(run, points=run.points + 1e-2 * scatter.normal(size=run.points.shape))

    monkeypatch.setattr(module, "simulate", scattered)
    with pytest.warns(UserWarning, match=r"only, not to 1e-09: smaller steps make it no less, for the motion is chaotic"):
        found = reference(CHAIN, 2, tolerance=1e-9)
    assert found.limit == np.inf and found.error > 1e-3


def test_motion_that_does_not_converge_is_not_extrapolated(folder, monkeypatch):
    """Runs at 0, 4, 5 and 9 cm, by turns: extrapolated, runs of 0, 4 and 5 cm give 8 and 6 cm, of 4, 5 and 9 cm 6 and 13 cm."""
    at, simulate = iter([0.0, 0.04, 0.05, 0.09]), module.simulate
    points, kept = None, []

    def shifted(*arguments, **options):
        nonlocal points
        run = simulate(*arguments, **options)
        points = run.points if points is None else points  # the first, so that nothing else differs
        kept.append(points + np.array([next(at), 0.0, 0.0]))
        return replace(run, points=kept[-1])

    monkeypatch.setattr(module, "simulate", shifted)
    monkeypatch.setattr(module, "_idle", lambda errors: len(errors) == 2)
    with pytest.warns(UserWarning, match="only, not to 1e-09"):
        found = reference(CHAIN, 2, tolerance=1e-9)
    np.testing.assert_array_equal(found.points, kept[-1])
    assert found.error == pytest.approx(0.04 / cloth_size(CHAIN.load().mesh), rel=1e-12)


def test_runs_that_diverge_are_left_out(folder, runs, monkeypatch):
    """4, 8 and 16 steps a frame are above the limit, 2/ω of about 0.7 ms; the next three runs are the first to count."""
    monkeypatch.setattr(module, "step_limits", lambda model: (1.0, 1.0))
    monkeypatch.setattr(module, "Explicit", lambda substeps: wc.Explicit(substeps=substeps, above_limit="allow"))
    scene = SceneRef("chain", {"links": 5, "stiffness": 2e4})
    found = reference(scene, FRAMES)
    assert [run.substeps for run in runs] == [4, 8, 16, 32, 64, 128] and found.substeps == 128 and found.error < 1e-3


@pytest.mark.parametrize(
    "change",
    [
        {"mesh": wc.Mesh.grid(3, 3, size=1.1)},
        {"masses": np.full(9, 0.2)},
        {"positions": wc.Mesh.grid(3, 3).points * 1.1},
        {"velocities": np.full((9, 3), 0.1)},
        {"terms": [wc.Spring(pairs="structural", stiffness=11.0)]},
        {"terms": [wc.Spring(pairs=("structural",), stiffness=10.0, damping=0.1)]},
        {"terms": [wc.Spring(pairs="edges", stiffness=10.0)]},
        {"terms": [wc.SpringLimit(pairs="structural", stiffness=10.0, most=1.1)]},
        {"terms": [wc.Spring(pairs="structural", stiffness=10.0)] * 2},
        {"pins": [0]},
        {"pins": wc.Pins([0, 2], np.tile(wc.Mesh.grid(3, 3).points[[0, 2]], (1, 1, 1)))},
        {"gravity": (0.0, -9.0, 0.0)},
        {"free_axes": np.arange(27).reshape(9, 3) != 4},
        {"fps": 30.0},
    ],
    ids=lambda change: next(iter(change)),
)
def test_all_that_motion_depends_on_is_in_the_key(change):
    terms = [wc.Spring(pairs="structural", stiffness=10.0)]
    scene = wc.Scene(wc.Mesh.grid(3, 3), masses=np.full(9, 0.1), terms=terms, pins=[0, 2])
    assert scene_digest(scene) == scene_digest(replace(scene, name="another", duration=2.0))
    assert scene_digest(scene) != scene_digest(replace(scene, **change))


def test_terms_of_the_same_numbers_have_keys_of_their_own():
    mesh = wc.Mesh.grid(3, 3)
    kinds = (wc.StVKMembrane, wc.NeoHookeanMembrane)
    scenes = [wc.Scene(mesh, density=0.1, terms=[kind(stiffness=10.0, poisson_ratio=0.3)]) for kind in kinds]
    assert scene_digest(scenes[0]) != scene_digest(scenes[1])


def blowing(speed):
    @wp.func
    def called(position: wp.vec3):
        return wp.vec3(speed, position[0], 0.0)

    @wp.func
    def blow(position: wp.vec3, _time: float):
        return called(position)

    return wc.Scene(wc.Mesh.grid(3, 3), density=0.1, air=wc.Air(wind=blow, max_speed=4.0))


def test_winds_of_the_same_source_have_keys_of_their_own():
    """A function calls another, which has a value from outside."""
    keys = [scene_digest(blowing(speed)) for speed in (1.0, 1.0, 3.0)]
    assert keys[0] == keys[1] != keys[2]


def test_a_key_says_that_warp_has_no_hash_of_functions(monkeypatch):
    scene = blowing(1.0)
    monkeypatch.delattr(wp._src.context, "ModuleHasher")
    with pytest.raises(ValueError, match=r"this version of Warp, .* gives no hash of functions"):
        scene_digest(scene)


def test_a_key_is_of_data():
    term = wc.Spring(pairs="structural", stiffness=10.0)
    object.__setattr__(term, "stiffness", object())
    scene = wc.Scene(wc.Mesh.grid(3, 3), density=0.1)
    object.__setattr__(scene, "terms", (term,))
    with pytest.raises(ValueError, match="a key needs numbers"):
        scene_digest(scene)


def test_errors_in_closed_form():
    """A chain of length 2 whose end is displaced by 0.3 along it in one frame of two."""
    mesh = wc.Mesh.chain(3, length=2.0)
    points = np.stack([mesh.points, mesh.points])
    others = points.copy()
    along = mesh.points[2] - mesh.points[1]
    others[1, 2] += 0.3 * along
    assert cloth_size(mesh) == 2.0
    assert position_error(points, others, mesh) == pytest.approx(0.3 / np.sqrt(6.0) / 2.0, rel=1e-12)
    assert strain_error(points, others, mesh) == pytest.approx(np.percentile([0.0, 0.0, 0.0, 0.3], 99), rel=1e-12)


def measured(solver, frames=3, **options):
    limits = {name: options.pop(name) for name in ("limit", "repeats", "reference") if name in options}
    found = measure(asdict(SceneRef("hanging", {"n": 4})), {"solver": solver, "options": options}, frames, **limits)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    return found


def test_how_a_measurement_ends(device):
    well = measured("newton", substeps=2, repeats=3)
    assert (well["status"], well["reason"], well["frames"], well["error"]) == ("ok", "", 3, None)
    assert 0.0 < well["spread"][0] <= well["ms"] <= well["spread"][1] and well["ms_per_second"] == 60.0 * well["ms"]
    assert well["compile_s"] > 0.0 and well["factorise_s"] == 0.0 and well["residual"] > 0.0 and "converged" in well["message"]
    assert measured("projective-dynamics", substeps=2)["factorise_s"] > 0.0 < measured("admm", substeps=2)["factorise_s"]
    slow = measured("newton", substeps=64, frames=60, limit=1e-3)
    assert slow["status"] == "slow" and slow["frames"] < 60 and slow["error"] is None and slow["ms"] > 0.0
    assert f"{slow['frames']} of 60 frames took" in slow["reason"] and "more than 0.001 s" in slow["reason"]
    refused = measured("explicit", substeps=1)
    assert refused["status"] == "refused" and "stable below" in refused["reason"] and refused["ms"] is None
    diverged = measured("explicit", substeps=4, above_limit="allow", frames=20)
    assert diverged["status"] == "diverged" and "diverged in frame" in diverged["reason"] and diverged["error"] is None
    assert diverged["frames"] < 20
    assert "in motion" in measured("explicit", substeps=10)["message"], "warnings are part of it"


def test_one_frame_is_timed_warm(monkeypatch):
    """By the next, of which nothing else is told."""
    runs, real = [], trajectory.simulate
    monkeypatch.setattr(trajectory, "simulate", lambda *given, **rest: runs.append(real(*given, **rest)) or runs[-1])
    exact = reference(SceneRef("hanging", {"n": 4}), 1)
    found = measured("newton", substeps=2, frames=1, reference=exact.path)
    assert found["ms"] == 1e3 * runs[0].timings["frames"][1] and found["frames"] == 1 and found["error"] < 1e-2
    assert found["error"] == position_error(runs[0].points[1:2], exact.points[1:], SceneRef("hanging", {"n": 4}).load().mesh)


def test_the_first_frame_of_a_run_is_not_timed():
    found = trajectory._times([[9.0, 0.1, 0.1], [7.0, 0.3, 0.4, 0.5]], 50.0)
    assert found["ms"] == pytest.approx(280.0) and found["ms_per_second"] == pytest.approx(14000.0)
    assert trajectory._times([[0.2]], 50.0)["ms"] == 200.0, "unless there is no other"


def test_the_time_of_a_motion_counts_all_frames_and_hardly_an_interruption():
    """20 frames of 1 ms and 10 of 7 ms; one of 1 s, first, amid or last; work in every fourth frame; scatter of 10 %."""
    times = np.repeat([1.0, 7.0], [20, 10])
    assert mean_time(times) == pytest.approx(3.0) and time_spread(times) == (1.0, 1.0)
    for frame, counts in ((0, 10.0), (1, 10.0), (5, 10.0), (28, 70.0), (29, 70.0)):
        interrupted = times.copy()
        interrupted[frame] = 1e3
        assert mean_time(interrupted) == pytest.approx(3.0 + (counts - times[frame]) / 30.0)
    assert mean_time([1.0, 1.0, 1.0, 9.0] * 5) == pytest.approx(3.0)
    assert mean_time([2.0]) == 2.0 and time_spread([2.0, 5.0]) == time_spread([0.0, 0.0, 0.0]) == (1.0, 1.0)
    assert time_spread(1.0 + 0.1 * (np.arange(31) % 2)) == pytest.approx((1.1**-2, 1.0))


def test_a_second_run_may_be_left_out():
    """The time is up amid the second: what the first gave is kept."""
    once = measured("newton", substeps=32, frames=10)
    total = 1e-3 * once["ms"] * 10
    assert measured("newton", substeps=32, frames=10, limit=10.0 * total, repeats=1000)["status"] == "ok"


def test_a_measurement_needs_its_reference(shared):
    exact = reference(CHAIN, 3)
    setup = {"solver": "newton", "options": {"substeps": 4}}
    assert measure(asdict(CHAIN), setup, reference=exact.path)["frames"] == 3
    fewer = measure(asdict(CHAIN), setup, 2, exact.path)
    assert fewer["frames"] == 2 and 0.0 < fewer["error"] < 1e-2
    for wrong, words in (
        (lambda: measure(asdict(CLOTH), setup, reference=exact.path), "is the reference of another scene than hanging"),
        (lambda: measure(asdict(CHAIN), setup, 4, exact.path), "frames is 4; .* has 3"),
        (lambda: measure(asdict(CHAIN), setup, limit=0.0), "limit is 0"),
        (lambda: measure(asdict(CHAIN), setup, repeats=0), "repeats is 0"),
        (lambda: measure(asdict(CHAIN), {"solver": "newton", "options": {"steps": 1}}), "steps"),
    ):
        with pytest.raises(ValueError, match=words):
            wrong()


# Moves of doublings from 2 substeps on, of a motion known to 1e-3 at most: substeps of the motion that is taken, and its error.
MOVES = [
    ((8e-4, 4e-4, 2e-4, 1e-4, 5e-5, 2e-5), 128, 5e-5),
    ((3e-2, 2e-5, 1e-5), 16, 2e-5),
    ((3e-4, 7e-4, 2e-3), 4, np.inf),  # hardly moved by the first doublings, and far from its limit
    ((5e-5, 2e-5, 1e-5), 8, 5e-5),
    ((3e-5, 9e-5), 8, 9e-5),  # below the tolerance rounding may move it
    ((4e-4, 2e-4, 3e-4, 6e-4), 8, 4e-4),  # later doublings only round it
]


@pytest.mark.parametrize(("moves", "substeps", "error"), MOVES)
def test_a_motion_converges_by_two_successive_doublings(moves, substeps, error, tmp_path, monkeypatch):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    mesh = CHAIN.load().mesh
    offsets = dict(zip([2 * 2**k for k in range(len(moves) + 1)], np.cumsum([0.0, *moves]) * cloth_size(mesh), strict=True))

    def ran(scene, record, device, frames, watch):
        if record.substeps not in offsets:
            raise ValueError("as much as was asked for")
        points = np.tile(scene.mesh.points, (frames + 1, 1, 1)) + np.array([offsets[record.substeps], 0.0, 0.0])
        return SimpleNamespace(points=points, status=SimpleNamespace(complete=True))

    monkeypatch.setattr(own_reference_module, "run_other", ran)
    found = own_reference(CHAIN, [Setup("newton-vbd", {"substeps": 2, "iterations": 2})], 2, tolerance=1e-4)
    facts = own_facts(found, found, mesh, 1e-3)
    assert (found.substeps, found.error) == (substeps, pytest.approx(error)) and facts["converged"] == (error <= 1e-3)
    assert ("two doublings up to" if facts["converged"] else "no doubling moved it less") in words_of_own(facts)


def test_own_motions_end_at_the_total_time(tmp_path, monkeypatch):
    """The time is used up in the second run of the first of two solvers: neither has a motion, and nothing is stored."""
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    ran = []

    def run(scene, record, device, frames, watch):
        for frame in range(frames + 1):
            monkeypatch.setattr(own_reference_module.time, "perf_counter", lambda: float(len(ran)))
            watch(frame, frames)
        ran.append(record.substeps)
        points = np.tile(scene.mesh.points, (frames + 1, 1, 1))
        return SimpleNamespace(points=points, status=SimpleNamespace(complete=True))

    monkeypatch.setattr(own_reference_module, "run_other", run)
    setups = [Setup(name, {"substeps": 2, "iterations": 2}) for name in ("newton-vbd", "newton-xpbd")]
    found = own_references(CHAIN, setups, 2, "cpu", 1e-4, 10.0, until=1.0)
    assert found == {"newton-vbd": CUT, "newton-xpbd": CUT} and ran == [2] and not list(tmp_path.rglob("*.npz"))
    facts = own_facts(CUT, None, None, 1e-3)
    assert words_of_own(facts) == "not known: the total time was used up" and of_own(CUT, 1e-3) == {}
