"""Threads: what they share is to the bit what one makes, or the same in every run; failures and interrupts come back."""

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
from support.rows import slow_but
from support.setups import SOLVERS, allocations, square
from support.sheets import SPRINGS, TERMS, declared, precisions
from warpcloth.cli import main
from warpcloth.core.capture import Segment
from warpcloth.core.thread_pool import ThreadPool
from warpcloth.lab import benchmarks
from warpcloth.lab.counts import launches_of
from warpcloth.model.threads import threads_on
from warpcloth.solvers import solver as solvers

pytestmark = pytest.mark.filterwarnings("ignore:threads is . on . cores")
VARY = {"Spring.stiffness": [50.0, 80.0, 100.0], "gravity": [[0.0, -9.8, 0.0], [0.0, -5.0, 1.0], [2.0, -3.0, 0.0]]}
HARD = wc.Spring(stiffness=np.inf)
# What steps of one cloth are divided by, colours of sweeps or ranges of vertices, and the cloth that they are of.
DIVIDED = {
    "explicit": (wc.Explicit(substeps=8), [SPRINGS]),
    "pbd": (wc.PBD(substeps=3, iterations=4), [SPRINGS, wc.DihedralBending(stiffness=1e-3)]),
    "pbd with clusters": (wc.PBD(substeps=3, iterations=4), [HARD, wc.RigidCluster(vertices=[[0, 1, 2, 7]], stiffness=np.inf)]),
    "hierarchical pbd": (wc.HierarchicalPBD(substeps=3, iterations=2, coarse_iterations=2), [SPRINGS]),
    "xpbd": (wc.XPBD(substeps=3, iterations=4), [replace(SPRINGS, damping=0.01), wc.QuadraticBending(stiffness=1e-4)]),
    "xpbd hard": (wc.XPBD(substeps=3, iterations=4), [HARD]),
    "xpbd midpoint": (wc.XPBD(substeps=3, iterations=4, integrator="midpoint"), [SPRINGS]),
    "xpbd bdf2": (wc.XPBD(substeps=3, iterations=4, integrator="bdf2"), [SPRINGS]),
}


@pytest.fixture(autouse=True)
def _cpu(device):
    if not wp.get_device(device).is_cpu:
        pytest.skip("threads are for the CPU")


def bits(stepper):
    return [array.numpy().copy() for array in stepper.state] + [stepper.residual]


def same(steppers):
    expected, *others = [bits(stepper) for stepper in steppers]
    return all(np.array_equal(a, b) for other in others for a, b in zip(expected, other, strict=True))


@pytest.mark.parametrize("name", slow_but(("xpbd",), SOLVERS))
def test_copies_shared_out_are_those_of_one_thread(name, device):
    """To the bit, of uneven shares and of more threads than copies; when some are put back, too."""
    record = replace(SOLVERS[name], substeps=2)
    scene = square(solver=record, damping=0.01, fps=300.0, pins="corners")
    steppers = [record.bind(scene.build(device=device, copies=3, vary=VARY, threads=threads)) for threads in (1, 2, 5)]
    places = np.tile(scene.mesh.points + 0.01, (3, 1, 1))
    given = {"positions": None if "bdf2" in name else places}
    for stepper in steppers:
        stepper.frame()
        stepper.step()
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
    record = wc.Explicit(substeps=8, above_limit="allow")
    steppers = [record.bind(scene.build(device=device, copies=3, vary=vary, threads=threads)) for threads in (1, 2, 3)]
    for stepper in steppers:
        stepper.frame()
    assert same(steppers)


@pytest.mark.parametrize("launches", [1, 10_000])
@pytest.mark.parametrize("name", slow_but(["xpbd hard"], [name for name in DIVIDED if name != "explicit"]))
def test_colours_shared_out_are_those_of_one_thread(name, launches, device, monkeypatch):
    """To the bit, with more threads than the smaller colours have elements, and pins that move."""
    monkeypatch.setattr(solvers, "LAUNCHES", launches)
    record, terms = DIVIDED[name]
    steppers = [record.bind(declared(terms, fps=60.0).build(device=device, threads=threads)) for threads in (1, 2, 3)]
    for stepper in steppers:
        for _ in range(2):
            stepper.frame()
        stepper.step()
    assert same(steppers)


# How many launches are captured at once does not depend on what they are of.
@pytest.mark.parametrize(
    ("name", "dtype", "launches"),
    slow_but(
        [*((*row, 20) for row in precisions(["nothing", "springs", "attachments"])), ("springs", "float32", 1)],
        [
            *(
                (*row, 20)
                for row in precisions([each for each in TERMS if each not in ("clusters", "plate bending", "several")])
            ),
            *((*row, 1) for row in precisions(["springs"])),
        ],
    ),
)
def test_ranges_move_as_the_whole(name, dtype, launches, device, monkeypatch):
    """The same but for the order of sums, and in every run the same bits; with pins that move, and from any place."""
    monkeypatch.setattr(solvers, "LAUNCHES", launches)
    scene, record = declared(TERMS[name], fps=50.0), wc.Explicit(substeps=20, above_limit="allow")
    steppers = [record.bind(scene.build(device=device, dtype=dtype, threads=threads)) for threads in (1, 2, 2, 3)]
    places = scene.positions[None] + 0.002 * np.sin(np.arange(scene.positions.size)).reshape(1, -1, 3)
    for stepper in steppers:
        stepper.frame()
        stepper.step()
        stepper.reset(positions=places)
        stepper.step()
        stepper.step()
        stepper.frame()
    assert same(steppers[1:3])
    # As in test_backends, of 43 steps.
    tolerance = 43 * 64 * np.finfo(dtype).eps / steppers[0].h
    for stepper in steppers[1:]:
        assert np.abs(stepper.state.v.numpy() - steppers[0].state.v.numpy()).max() < tolerance
        assert np.abs(stepper.state.x.numpy() - steppers[0].state.x.numpy()).max() < 43 * stepper.h * tolerance


@pytest.mark.slow
def test_ranges_far_from_the_origin_move_as_the_whole(device):
    """They too keep places to more digits than x has, those of ghosts as well, and start again."""
    sheet = wc.Mesh.grid(17, 17)
    terms = [wc.Spring(stiffness=100.0), wc.QuadraticBending(stiffness=1e-5)]
    scene = wc.Scene(wc.Mesh(sheet.points + 128.0, sheet.triangles), density=0.1, terms=terms, pins=[0, 16], duration=1.0)
    steppers = [wc.Explicit(substeps=64).bind(scene.build(device=device, threads=threads)) for threads in (1, 2, 3, 3)]
    for stepper in steppers:
        for _ in range(8):
            stepper.frame()
    one, two, three, other = (stepper.state.x.numpy().copy() for stepper in steppers)
    # As in test_backends, each within two roundings of x.
    assert all(np.abs(x - one).max() < 4.0 * np.spacing(np.float32(128.0)) for x in (two, three))
    assert np.array_equal(three, other)
    steppers[2].reset()
    for _ in range(8 * 64):
        steppers[2].step()
    assert np.array_equal(three, steppers[2].state.x.numpy())


@pytest.mark.parametrize("name", DIVIDED)
@pytest.mark.slow
def test_threads_allocate_nothing(name, device):
    record, terms = DIVIDED[name]
    for copies in (1, 2):
        stepper = record.bind(declared(terms, fps=60.0).build(device=device, copies=copies, threads=2))
        stepper.frame()
        with wp.ScopedMemoryTracker("frames", print=False) as tracker:
            assert allocations(tracker, lambda stepper=stepper: [stepper.frame() for _ in range(2)]) == 0


@pytest.mark.parametrize("record", [wc.PBD(substeps=1, iterations=5), wc.XPBD(substeps=1, iterations=5)])
def test_threads_wait_for_what_is_refreshed_once_a_step(record, device):
    """Damping is set where a step begins, by one thread, and sweeps have no further barrier for it."""

    def launches(threads, **fields):
        scene = declared([replace(SPRINGS, **fields)], fps=60.0)
        stepper = record.bind(scene.build(device=device, threads=threads))
        return launches_of(stepper.step)

    more = [launches(threads, damping=0.01) - launches(threads) for threads in (1, 2)]
    assert more[0] == more[1] > 0


def failing(pool, model):
    """What waits for all threads, and what fails before it does."""
    segment = Segment(model.device, lambda: pool.launch_barrier(model))

    def fail():
        raise ArithmeticError("of a thread")

    return [segment, fail]


@pytest.mark.parametrize("order", [1, -1])
def test_what_a_thread_raises_reaches_the_caller(order, device):
    """And whoever waits for it is let go; afterwards all is as before."""
    pool = ThreadPool(2)
    wait, fail = failing(pool, square().build(device=device))
    for _ in range(3):
        with pytest.raises(ArithmeticError, match="of a thread"):
            pool.run([wait, fail][::order])
        pool.run([wait, wait])


def test_an_interrupt_waits_for_the_threads(device):
    """It comes when all have ended, whoever waits for whom, and the next frame runs."""
    pool, ended, started = ThreadPool(2), [], threading.Event()
    wait, _fail = failing(pool, square().build(device=device))

    def late():
        started.wait(10.0)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        threading.Event().wait(0.2)  # while the main thread has it
        wait()
        ended.append(True)

    def early():
        started.set()
        wait()
        ended.append(True)

    with pytest.raises(KeyboardInterrupt):
        pool.run([early, late])
    assert len(ended) == 2
    pool.run([wait, wait])


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


@pytest.mark.parametrize("copies", [1, 2])
def test_steppers_of_one_model_have_threads_of_their_own(copies, device):
    """Whoever calls them."""
    model = declared([SPRINGS], fps=60.0).build(device=device, copies=copies, threads=2)
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
    model = square().build(device=device, threads=2, copies=2)
    stepper = wc.PBD(substeps=1).bind(model)
    stepper.frame()
    started = [thread for thread in threading.enumerate() if thread not in before]
    assert started
    del stepper
    gc.collect()
    for thread in started:
        thread.join(10.0)
        assert not thread.is_alive()


def test_more_threads_than_cores_warn(device):
    with pytest.warns(UserWarning, match="threads is 1000 on .* cores; more threads than cores are slower"):
        square().build(device=device, threads=1000)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: threads_on(SimpleNamespace(is_cpu=False), 2), "threads is 2 on .*; more than 1 is for device='cpu'"),
        (lambda: square().build(threads=0), "threads is 0; it must be a whole number of 1 or more"),
        (lambda: wc.Newton(substeps=1).bind(square().build(threads=2)), "one copy, whose steps Newton cannot divide"),
        (
            lambda: wc.XPBD(substeps=1, sweep="constraint-averaged").bind(square().build(threads=2)),
            "PBD, HierarchicalPBD, XPBD can as they are by default",
        ),
        (
            lambda: wc.Explicit(substeps=500).bind(declared(TERMS["clusters"]).build(threads=2)),
            "whose RigidCluster Explicit cannot divide",
        ),
        (lambda: wc.Explicit(substeps=500).bind(square(2).build(threads=5)), "threads is 5 for 4 vertices"),
        (lambda: wc.PBD(substeps=1).bind(square(2).build(threads=5)), "threads is 5 for 4 vertices"),
    ],
)
def test_what_threads_cannot_do_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_debug_mode_has_one_thread(device, monkeypatch):
    """Two would end the process: on x86 Warp keeps one pointer to the tiles of a kernel on the CPU."""
    monkeypatch.setattr(wp.config, "mode", "debug")
    with pytest.raises(ValueError, match="threads is 2 in Warp's debug mode"):
        square().build(device=device, threads=2)
    square().build(device=device, threads=1)
    monkeypatch.setattr(wp.config, "enable_tiles_in_stack_memory", False)
    square().build(device=device, threads=2)


def test_simulate_and_the_commands_take_threads(device, tmp_path, capsys, monkeypatch):
    scene = square(pins="corners", fps=300.0)
    record = wc.XPBD(substeps=2, iterations=3)
    one, two = (wc.simulate(scene, record, device=device, frames=3, threads=threads) for threads in (1, 2))
    assert np.array_equal(one.points, two.points)
    command = ["-p", "n=5", "--solver", "explicit", "--frames", "2", "--json", "--threads", "2"]
    assert main(["run", "hanging", *command, "-o", str(tmp_path / "out.usdc")]) == 0
    out = capsys.readouterr().out
    assert json.loads(out[out.index("{") :])["threads"] == 2
    assert main(["run", "hanging", *[word for word in command if word != "--json"], "-o", str(tmp_path / "out.usdc")]) == 0
    assert "cpu, float32, 2 threads" in capsys.readouterr().out
    monkeypatch.setattr(benchmarks, "_alone", lambda asked: asked.run())  # in this process, which has the kernels
    assert main(["bench", "hanging", *command]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["threads"] == 2 and row["launches"] > 1.0
    assert main(["run", "hanging", "-p", "n=5", "--threads", "2", "-o", str(tmp_path / "no.usdc")]) == 2
    assert "Newton cannot divide" in capsys.readouterr().err


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork")
def test_a_forked_process_has_threads_of_its_own(device):
    """Those of its parent are not there."""
    stepper = wc.Explicit(substeps=8, above_limit="allow").bind(declared([SPRINGS]).build(device=device, threads=2))
    stepper.frame()
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
