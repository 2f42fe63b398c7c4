"""Frames computed ahead of who takes them: the same to the bit, and nothing lost or written wrongly where a run ends early."""

import threading
from contextlib import closing
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from warpcloth.base.turns import TURN
from warpcloth.mesh.ordering import near_order
from warpcloth.run.frames_ahead import frames_of, state_of
from warpcloth.scenes import flag, hanging, ring
from warpcloth.usd import FrameSequence, chunks

SOLVERS = {
    "explicit": wc.Explicit(substeps=32),
    "newton": wc.Newton(substeps=1, iterations=2),
    "xpbd": wc.XPBD(substeps=4, iterations=4),
}


def bound(device, solver="explicit", order=None, **build):
    return SOLVERS[solver].bind(hanging.scene(n=8).build(device=device, order=order, **build))


def threads():
    return [thread for thread in threading.enumerate() if thread.name.startswith("frames")]


def look_ahead(monkeypatch, frames):
    """Lets runs compute so many frames ahead, on the CPU too."""
    module = import_module("warpcloth.run.watch")
    monkeypatch.setattr(module, "frames_of", lambda stepper, count, _ahead, *more: frames_of(stepper, count, frames, *more))


@pytest.mark.parametrize(
    ("solver", "order"),
    [(name, order) for name, record in SOLVERS.items() for order in (False, True) if not (order and record.ordered)],
)
def test_frames_and_what_is_said_of_them_are_those_of_each(solver, order, device):
    """A frame has its own result and residual, though the stepper has gone on; and B copies their own places."""
    build = {"copies": 2, "vary": {"Spring.stiffness": [100.0, 200.0]}}
    places = near_order(hanging.scene(n=8).mesh) if order else None
    plain = bound(device, solver, places, **build)
    expected = []
    for _ in range(5):
        plain.frame()
        expected.append((*state_of(plain), list(plain.results), plain.residual.copy()))
    for many, count in ((0, 5), (1, 1), (1, 5), (2, 2), (2, 5), (7, 5)):
        stepper = bound(device, solver, places, **build)
        with closing(frames_of(stepper, count, many)) as frames:
            found = list(frames)
        assert len(found) == count
        assert np.array_equal(state_of(stepper)[0], found[-1].points)  # nothing is computed that nobody takes
        for frame, each in zip(found, expected, strict=False):
            for here, there in zip(frame[:4], each, strict=True):
                assert np.array_equal(here, there)
            assert frame.points.base is None and frame.velocities.base is None
            assert frame.seconds > 0.0
    assert not threads()


def test_the_next_frames_come_while_one_is_in_use(device):
    """And no more of them than was said."""
    stepper, computed = bound(device), threading.Semaphore(0)
    frame, count = stepper.frame, [0]

    def counted():
        frame()
        count[0] += 1
        computed.release()

    stepper.frame = counted
    with closing(frames_of(stepper, 10, 2)) as frames:
        next(frames)
        for _ in range(3):
            assert computed.acquire(timeout=600.0)  # the one in use and two more
        assert count[0] == 3 and not computed.acquire(timeout=0.05)
        next(frames)
        assert computed.acquire(timeout=600.0)
    assert count[0] <= 4 and not threads()


def test_what_is_said_of_a_frame_stays(device):
    """Steppers change their lists and arrays in place."""
    stepper, frame = bound(device), 0
    compute = stepper.frame

    def noting():
        nonlocal frame
        compute()
        frame += 1
        stepper.results[0], stepper.residual[0] = frame, frame

    stepper.frame = noting
    with closing(frames_of(stepper, 5, 2)) as frames:
        found = list(frames)
    assert [(each.results, each.residual.tolist()) for each in found] == [([k], [k]) for k in range(1, 6)]


def test_closing_waits_for_the_frame_that_is_being_computed_and_for_no_other(device):
    stepper, gate, count = bound(device), threading.Event(), [0]
    frame = stepper.frame

    def held():
        count[0] += 1
        assert count[0] == 1 or gate.wait(60.0)
        frame()

    stepper.frame = held
    with closing(frames_of(stepper, 10, 2)) as frames:
        next(frames)
        threading.Timer(0.1, gate.set).start()
    assert count[0] <= 2 and not threads()


def test_an_error_in_a_frame_comes_after_those_before_it(device):
    stepper, count = bound(device), [0]
    frame = stepper.frame

    def failing():
        count[0] += 1
        if count[0] == 4:
            raise RuntimeError("out of memory")
        frame()

    stepper.frame = failing
    found = []
    with pytest.raises(RuntimeError, match="out of memory"), closing(frames_of(stepper, 10, 2)) as frames:
        for each in frames:
            found.append(each)
    assert len(found) == 3 and not threads()


@pytest.mark.parametrize("output", [None, "out.usdc"])
@pytest.mark.parametrize(
    "solver",
    [wc.Explicit(substeps=18, above_limit="allow"), wc.XPBD(substeps=4, iterations=4, relaxation=2.0)],
    ids=["no residual", "a residual that grows"],
)
def test_a_run_that_diverges_ends_as_without(solver, output, tmp_path, device, monkeypatch):
    """What is computed beyond the frame that diverged, which is NaN, is neither kept nor said anything of."""
    runs = []
    for ahead in (0, 2):
        path = None if output is None else str(tmp_path / f"{ahead}-{output}")
        look_ahead(monkeypatch, ahead)
        runs.append(wc.simulate(hanging.scene(n=8), solver, output=path, device=device))
    one, other = runs
    assert not one.status.ok and 0 < one.status.frame < 50
    for name in ("result", "frame", "residual", "message"):
        assert getattr(one.status, name) == getattr(other.status, name)
    assert len(other.points) == one.status.frame + 1 and np.isfinite(np.asarray(other.points)).all()
    assert np.array_equal(one.points, other.points) and np.array_equal(one.velocities, other.velocities)
    assert len(other.timings["frames"]) == one.status.frame + 1


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(flag.scene(nx=6, ny=4), id="moving pins"),
        pytest.param(ring.scene(elements=12), id="moving colliders", marks=pytest.mark.slow),
    ],
)
def test_nothing_reads_a_device_beside_the_frames(scene, device, monkeypatch):
    """Warp changes the stream of a device while it reads an array: two threads that read at once may leave a wrong stream."""
    read, apart = wp.array.numpy, []

    def numpy(array, **options):
        if threads() and not TURN.held and array.device == wp.get_device(device):
            apart.append(threading.current_thread().name)
        return read(array, **options)

    look_ahead(monkeypatch, 2)
    monkeypatch.setattr(wp.array, "numpy", numpy)
    wc.simulate(scene, wc.XPBD(substeps=4), frames=4, device=device, dtype="float64", record=("energies", "reactions"))
    assert not apart


def test_a_full_disk_is_said_with_the_file(tmp_path, device, monkeypatch):
    """The frames of the chunks before stay."""
    look_ahead(monkeypatch, 2)
    export = chunks._export

    def full(layer, file, meant=None):
        if meant is not None and meant.name == "frames_000001.usdc":
            raise OSError(f"{meant}: could not be written: no space left on device")
        export(layer, file, meant)

    monkeypatch.setattr(chunks, "_export", full)
    output = tmp_path / "out.usdc"
    with pytest.raises(OSError, match=r"frames_000001\.usdc: could not be written"):
        wc.simulate(hanging.scene(n=8), SOLVERS["explicit"], output=str(output), device=device, frames=40)
    assert len(FrameSequence(output)) == 10 and not threads()


@pytest.mark.parametrize("frame", [0, 1, 12])
def test_an_interrupt_keeps_the_frames_until_then(frame, tmp_path, device, monkeypatch):
    look_ahead(monkeypatch, 2)
    output = tmp_path / "out.usdc"

    def interrupted(now, _frames):
        if now == frame:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        wc.simulate(hanging.scene(n=8), SOLVERS["explicit"], output=str(output), device=device, progress=interrupted)
    assert len(FrameSequence(output)) == frame + 1 and not threads()


@pytest.mark.parametrize(("output", "cores", "expected"), [(None, 2, 0), ("out.usdc", 2, 1), ("out.usdc", 1, 0)])
def test_a_thread_needs_a_file_to_write_and_a_core(output, cores, expected, tmp_path, device, monkeypatch):
    """On CUDA frames are computed ahead in any case."""
    asked, module = [], import_module("warpcloth.run.simulate")
    monkeypatch.setattr(module.os, "sched_getaffinity", lambda _process: set(range(cores)), raising=False)
    monkeypatch.setattr(
        import_module("warpcloth.run.watch"),
        "frames_of",
        lambda stepper, count, ahead, *more: asked.append(ahead) or frames_of(stepper, count, ahead, *more),
    )
    path = None if output is None else str(tmp_path / output)
    wc.simulate(hanging.scene(n=8), SOLVERS["explicit"], output=path, device=device, frames=2)
    assert asked == [module.FRAMES if device.startswith("cuda") else expected]


@pytest.mark.parametrize(
    ("count", "free", "expected"),
    [(64, 2**37, 1000), (2**18, 2**37, 170), (2**18, 2**30, 42), (2**22, 2**30, 2), (2**26, 0, 2)],
)
def test_frames_ahead_leave_memory_to_others(count, free, expected):
    """A GiB of frames of 24 bytes a vertex, or a quarter of what the device has free; two where not even these fit."""
    model = SimpleNamespace(device=SimpleNamespace(is_cuda=True, free_memory=free), count=count, vec3=wp.vec3)
    assert import_module("warpcloth.run.simulate")._ahead(model, None) == expected
