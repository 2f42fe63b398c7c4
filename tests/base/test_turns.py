"""Threads of one process simulate, deform and measure at once: each waits for its turn and gets its own result."""

import threading
from concurrent.futures import ThreadPoolExecutor
from functools import wraps

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from warpcloth.base.turns import TURN
from warpcloth.core.capture import Segment
from warpcloth.mesh.distances import surface_distances
from warpcloth.scenes import drape, hanging
from warpcloth.solvers.explicit import step_limits

MESH = wc.Mesh.grid(4, 4)
MOVED = MESH.points + np.array([0.3, 0.1, 0.0]) * MESH.points[:, :1] ** 2
TURNED = np.linalg.qr(np.random.default_rng(0).normal(size=(5, 3, 3)))[0]


def scene():
    return hanging.scene(n=5)


def pins():
    return wc.Pins(np.arange(4), keyframes=np.stack([MESH.points[:4], MESH.points[:4] + 0.1]))


# Uses of Warp, as (function that prepares the arguments, function that is called with them).
CALLS = {
    "build": (lambda: None, lambda _: scene().build().positions.numpy()),
    "bind": (lambda: scene().build(), lambda model: wc.Newton(substeps=1).bind(model).state.x.numpy()),
    "limits": (lambda: scene().build(), step_limits),
    "step": (lambda: wc.XPBD(substeps=2).bind(scene().build()), lambda stepper: stepper.step()),
    "frame": (lambda: wc.Explicit(substeps=40).bind(scene().build()), lambda stepper: stepper.frame()),
    "threads": (
        lambda: wc.PBD(substeps=2, iterations=2).bind(scene().build(copies=2, threads=2)),
        lambda stepper: stepper.frame(),
    ),
    "reset": (lambda: wc.XPBD(substeps=2).bind(scene().build()), lambda stepper: stepper.reset()),
    "simulate": (lambda: None, lambda _: wc.simulate(scene(), wc.Newton(substeps=1), frames=2).points),
    "record": (
        lambda: None,
        lambda _: wc.simulate(
            drape.scene(n=4, self_contact=True), wc.XPBD(substeps=2), frames=2, record=("energies", "reactions")
        ),
    ),
    "equilibrium": (scene, lambda declared: wc.equilibrium(declared, tolerance=1e-3).points),
    "arap": (lambda: None, lambda _: wc.Arap(MESH, np.arange(4)).solve(MESH.points[:4]).points),
    "deform": (pins, lambda moved: wc.deform(MESH, moved, fps=24).points),
    "analyze": (lambda: None, lambda _: wc.analyze([MESH.points, MOVED], MESH, dt=1.0)),
    "distances": (lambda: None, lambda _: surface_distances(MOVED, MESH.points, MESH.triangles)),
    "svd": (lambda: TURNED, wc.svd),
    "polar": (lambda: TURNED, wc.polar),
    "kabsch": (lambda: (MESH.points, MOVED), lambda both: wc.kabsch(*both)),
}


@pytest.mark.parametrize("name", CALLS)
def test_all_that_uses_warp_waits_until_a_graph_is_recorded(name, device):
    """Without turns, a call beside a recording would be recorded in part, or end the process."""
    prepare, call = CALLS[name]
    prepared, ended, model = prepare(), threading.Event(), scene().build(device=device)
    vectors = model.vectors()

    def record():
        vectors.zero_()
        other.start()
        assert not ended.wait(0.3)

    def run():
        call(prepared)
        ended.set()

    other = threading.Thread(target=run, daemon=True)
    Segment(model.device, record)()
    other.join(60.0)
    assert ended.is_set()


@pytest.mark.parametrize(
    ("solver", "options"),
    [
        (wc.Newton(substeps=1), {}),
        (wc.Newton(substeps=1), {"output": "{}.usdc"}),
        (wc.XPBD(substeps=1, iterations=3), {"copies": 2, "threads": 2}),
    ],
    ids=["memory", "file", "threads"],
)
def test_runs_in_several_threads_are_what_each_is_alone(solver, options, device, tmp_path):
    if "threads" in options and device != "cpu":
        pytest.skip("threads of one run are for the CPU")

    def run(number):
        given = {name: str(tmp_path / value.format(number)) if name == "output" else value for name, value in options.items()}
        return np.asarray(wc.simulate(scene(), solver, frames=6, device=device, **given).points)

    alone = run(0)
    with ThreadPoolExecutor(4) as pool:
        for points in pool.map(run, range(1, 9)):
            np.testing.assert_array_equal(points, alone)


def test_steppers_in_several_threads_go_as_they_do_alone(device):
    """Bound and stepped by hand; the graph of a frame is recorded when it is first asked for."""

    def run(record):
        stepper = record.bind(scene().build(device=device))
        for _ in range(10):
            stepper.step()
            stepper.frame()
        with TURN:  # Warp reads by another stream of the device, which it sets for all threads
            return stepper.state.x.numpy().copy()

    records = [wc.Explicit(substeps=40), wc.ADMM(substeps=1), wc.ProjectiveDynamics(substeps=1), wc.XPBD(substeps=2)]
    alone = [run(record) for record in records]
    with ThreadPoolExecutor(len(records)) as pool:
        for now, before in zip(pool.map(run, records), alone, strict=True):
            np.testing.assert_array_equal(now, before)


def test_a_run_within_the_progress_of_a_run(device, tmp_path):
    """A thread may begin another run within its own, and so may a thread that it waits for."""
    inner = []

    def run(output=None, progress=None):
        return np.asarray(
            wc.simulate(scene(), wc.Explicit(substeps=40), frames=3, device=device, output=output, progress=progress).points
        )

    def progress(frame, _frames):
        if frame == 1:
            inner.append(run())
            with ThreadPoolExecutor(1) as pool:
                inner.append(pool.submit(run).result(60.0))

    outer = run(str(tmp_path / "out.usdc"), progress)
    for points in inner:
        np.testing.assert_array_equal(points, run())
    np.testing.assert_array_equal(outer, inner[0])


@pytest.mark.parametrize("name", CALLS)
def test_all_of_a_call_holds_the_lock(name, device, monkeypatch):
    """Whatever it launches, allocates, copies and replays, not only its first use of Warp."""
    apart, (prepare, call) = [], CALLS[name]

    def noting(function):
        @wraps(function)
        def noted(*args, **options):
            if not TURN.held:
                apart.append(function.__name__)
            return function(*args, **options)

        return noted

    prepared = prepare()
    for use in ("launch", "zeros", "empty", "clone", "copy", "capture_launch", "capture_while"):
        monkeypatch.setattr(wp, use, noting(getattr(wp, use)))
    monkeypatch.setattr(wp.Module, "load", noting(wp.Module.load))
    call(prepared)
    assert not apart
