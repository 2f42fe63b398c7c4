"""Threads: the copies that they share out are to the bit those of one; failures and interrupts come back."""

import gc
import json
import os
import select
import signal
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.rows import table
from support.setups import SOLVERS, allocated, square
from support.sheets import SPRINGS, declared
from support.steps import after_frames
from warpcloth.cli import main
from warpcloth.core.thread_pool import ThreadPool
from warpcloth.lab import benchmarks
from warpcloth.model.threads import threads_on

pytestmark = pytest.mark.filterwarnings("ignore:threads is . on . cores")
VARY = {"Spring.stiffness": [50.0, 80.0, 100.0], "gravity": [[0.0, -9.8, 0.0], [0.0, -5.0, 1.0], [2.0, -3.0, 0.0]]}


@pytest.fixture(autouse=True)
def _cpu(device):
    if not wp.get_device(device).is_cpu:
        pytest.skip("threads are for the CPU")


def bits(stepper):
    return [array.numpy().copy() for array in stepper.state] + [stepper.residual]


def same(steppers):
    expected, *others = [bits(stepper) for stepper in steppers]
    return all(np.array_equal(a, b) for other in others for a, b in zip(expected, other, strict=True))


@table("name", ("xpbd",), SOLVERS)
def test_copies_shared_out_are_those_of_one_thread(name, device):
    """To the bit, of uneven shares and of more threads than copies; when some are put back, too."""
    record = replace(SOLVERS[name], substeps=2)
    scene = square(solver=record, damping=0.01, fps=300.0, pins="corners")
    given = {"positions": None if "bdf2" in name else np.tile(scene.mesh.points + 0.01, (3, 1, 1))}
    steppers = [after_frames(scene, record, 1, 1, device=device, copies=3, vary=VARY, threads=each) for each in (1, 2, 5)]
    for stepper in steppers:
        stepper.reset(np.array([True, False, True]), **given)
        stepper.step()
    assert same(steppers)
    for stepper in steppers[1:]:
        assert stepper.results == steppers[0].results and stepper.iterations == steppers[0].iterations
        assert (stepper.h, stepper.steps_per_frame) == (steppers[0].h, 2)


def test_copies_of_stiffness_by_element_are_those_of_one_thread(device):
    """To the bit, though what cancels in the matrix of one copy does not in that of another."""
    scene, random = declared([wc.QuadraticBending(stiffness=1e-3)], fps=60.0), np.random.default_rng(5)
    values = 1e-3 * np.ones((3, scene.build(device=device).terms[0].per_copy))
    values[1] *= random.uniform(0.5, 2.0, values[1].shape)
    values[2, ::2] = 0.0
    vary = {"QuadraticBending.stiffness": values}
    record, build = wc.Explicit(substeps=8, above_limit="allow"), {"device": device, "copies": 3, "vary": vary}
    assert same([after_frames(scene, record, 1, threads=threads, **build) for threads in (1, 2, 3)])


@pytest.mark.parametrize("name", ["explicit", "xpbd"])
@pytest.mark.slow
def test_threads_allocate_nothing(name, device):
    record = replace(SOLVERS[name], substeps=2)
    stepper = after_frames(square(solver=record, damping=0.01, fps=300.0), record, 1, device=device, copies=2, threads=2)
    assert allocated(lambda: [stepper.frame() for _ in range(2)], device) == 0


@pytest.mark.parametrize("order", [1, -1])
def test_what_a_thread_raises_reaches_the_caller(order, device):
    """When all have ended; afterwards all is as before."""
    pool, ended = ThreadPool(2), []

    def fail():
        raise ArithmeticError("of a thread")

    def late():
        threading.Event().wait(0.05)
        ended.append(True)

    for tries in range(1, 4):
        with pytest.raises(ArithmeticError, match="of a thread"):
            pool.run([late, fail][::order])
        assert len(ended) == tries
    pool.run([late, late])
    assert len(ended) == 5


def test_an_interrupt_waits_for_the_threads(device):
    """It comes when all have ended, and the next frame runs."""
    pool, ended, started = ThreadPool(2), [], threading.Event()

    def late():
        started.wait(10.0)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        threading.Event().wait(0.2)  # while the main thread has it
        ended.append(True)

    def early():
        started.set()
        ended.append(True)

    with pytest.raises(KeyboardInterrupt):
        pool.run([early, late])
    assert len(ended) == 2
    pool.run([early, early])
    assert len(ended) == 4


def test_a_second_interrupt_leaves_the_threads_to_the_next_call(device):
    """It comes at once; what runs then ends before anything else begins."""
    pool, ended, interrupt = ThreadPool(3), [], threading.main_thread().ident

    def late():
        for _ in range(2):
            threading.Event().wait(0.2)  # while the main thread waits, or has the first
            signal.pthread_kill(interrupt, signal.SIGINT)
        threading.Event().wait(0.2)
        ended.append(True)

    with pytest.raises(KeyboardInterrupt):
        pool.run([late])
    left, found = list(ended), []
    pool.run([lambda: found.append(list(ended))])
    assert not left and found == [[True]]


def test_steppers_of_one_model_have_threads_of_their_own(device):
    """Whoever calls them."""
    model = declared([SPRINGS], fps=60.0).build(device=device, copies=2, threads=2)
    steppers = [wc.PBD(substeps=4, iterations=2).bind(model) for _ in range(2)]
    callers = [threading.Thread(target=lambda s=s: [s.frame() for _ in range(50)], daemon=True) for s in steppers]
    for stepper in steppers:
        stepper.frame()
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(20.0)
        assert not caller.is_alive()
    assert same(steppers)


def test_threads_that_nobody_needs_end(device):
    before = threading.enumerate()
    stepper = after_frames(square(), wc.PBD(substeps=1), 1, device=device, threads=2, copies=2)
    started = [thread for thread in threading.enumerate() if thread not in before]
    assert started
    del stepper
    gc.collect()
    for thread in started:
        thread.join(10.0)
        assert not thread.is_alive()


def test_more_threads_than_cores_warn(device):
    with pytest.warns(UserWarning, match="threads is 1000 on .* cores; more threads than cores are slower"):
        square().build(device=device, copies=2, threads=1000)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: threads_on(SimpleNamespace(is_cpu=False), 2), "threads is 2 on .*; more than 1 is for device='cpu'"),
        (lambda: square().build(threads=0), "threads is 0; it must be a whole number of 1 or more"),
        (lambda: square().build(threads=2), "threads is 2 with one copy; it must be 1, because threads share out the copies"),
        (lambda: wc.simulate(square(), wc.PBD(substeps=1), frames=1, threads=2), "threads is 2 with one copy; it must be 1"),
    ],
)
def test_what_threads_cannot_do_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_debug_mode_has_one_thread(device, monkeypatch):
    """Two would end the process: on x86 Warp keeps one pointer to the tiles of a kernel on the CPU."""
    monkeypatch.setattr(wp.config, "mode", "debug")
    with pytest.raises(ValueError, match="threads is 2 in Warp's debug mode"):
        square().build(device=device, copies=2, threads=2)
    square().build(device=device, copies=2, threads=1)
    monkeypatch.setattr(wp.config, "enable_tiles_in_stack_memory", False)
    square().build(device=device, copies=2, threads=2)


def test_simulate_and_bench_take_threads(device, capsys, monkeypatch):
    scene, record = square(pins="corners", fps=300.0), wc.XPBD(substeps=2, iterations=3)
    one, two = (wc.simulate(scene, record, device=device, frames=3, copies=2, threads=threads) for threads in (1, 2))
    assert np.array_equal(one.points, two.points)
    command = ["bench", "hanging", "-p", "n=5", "--solver", "explicit", "--frames", "2", "--json", "--threads", "2"]
    monkeypatch.setattr(benchmarks, "_alone", lambda asked: asked.run())  # in this process, which has the kernels
    assert main([*command, "--copies", "2"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["threads"] == 2 and row["launches"] > 1.0 and main(command) == 2
    assert "threads is 2 with one copy; it must be 1" in capsys.readouterr().err


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork")
def test_a_forked_process_has_threads_of_its_own(device):
    """Those of its parent are not there."""
    record = wc.Explicit(substeps=8, above_limit="allow")
    stepper = after_frames(declared([SPRINGS]), record, 1, device=device, copies=2, threads=2)
    ours, theirs = os.pipe()  # the child's end is closed when it ends
    child = os.fork()
    if child == 0:
        stepper.frame()
        os._exit(0 if np.isfinite(stepper.state.x.numpy()).all() else 1)
    os.close(theirs)
    ended, _, _ = select.select([ours], [], [], 300.0)
    os.close(ours)
    if not ended:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    assert ended, "the forked process hangs"
    assert os.waitstatus_to_exitcode(status) == 0
