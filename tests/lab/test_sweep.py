"""Sweeps: every task once, what is finished is kept, any executor."""

import json
import multiprocessing
import os
import platform
import select
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import warpcloth as wc
from support.rows import slow_but
from warpcloth.base import extensions
from warpcloth.base.digest import source_digest
from warpcloth.lab import measurements as listed
from warpcloth.lab.campaign import Store, cache_folder, kept_store, sweep
from warpcloth.lab.machine import machine, name
from warpcloth.lab.measurements import SceneRef, Setup, Task, run, task
from warpcloth.lab.work_precision import time_diagram
from warpcloth.solvers import SOLVERS


def square(x, folder=None):
    """x², and a mark in a folder that it was measured."""
    if x < 0:
        raise ValueError(f"x is {x}; it must be 0 or more")
    if folder:
        with open(os.path.join(folder, f"{x}-{time.time_ns()}"), "w"):
            pass
    return {"square": x * x, "threads": os.environ.get("OMP_NUM_THREADS"), "process": os.getpid()}


def squares(count, folder=None):
    return [task(square, x=x, folder=str(folder) if folder else None) for x in range(count)]


@pytest.mark.parametrize("threads", slow_but([True], [False, True]))
def test_every_task_once(threads, tmp_path):
    said = []
    tasks = squares(5, tmp_path)
    executor = ThreadPoolExecutor(2) if threads else None
    before = dict(os.environ)
    found = list(sweep([*tasks, tasks[2]], executor, progress=lambda *state: said.append(state)))
    assert sorted(result["square"] for _, result in found) == [0, 1, 4, 9, 16]
    assert all(result["square"] == each.arguments["x"] ** 2 for each, result in found)
    assert len(list(tmp_path.iterdir())) == 5 and dict(os.environ) == before
    if not threads:
        assert {result["threads"] for _, result in found} == {"1"}
        assert os.getpid() not in {result["process"] for _, result in found}
    assert said[0][0] == 1 and said[-1][:2] == (6, 6) and said[-1][2] == 0.0
    assert [done for done, _, _ in said] == [1, 2, 3, 4, 5, 6]


def test_what_is_finished_is_not_measured_again(tmp_path):
    """After an error amid the tasks, and after a crash amid a line."""
    marks = tmp_path / "marks"
    marks.mkdir()
    path = tmp_path / "results" / "store.jsonl"
    tasks = squares(3, marks)
    with ThreadPoolExecutor(1) as executor, pytest.raises(ValueError, match="x is -1"):
        list(sweep([*tasks, task(square, x=-1)], executor, Store(path)))
    with path.open("a") as file:
        file.write('{"key": "half')
    store = Store(path)
    assert len(store) == 3 and tasks[1] in store
    found = dict_of(sweep(squares(4, marks), ThreadPoolExecutor(1), store))
    assert found == {0: 0, 1: 1, 2: 4, 3: 9} and len(list(marks.iterdir())) == 4
    lines = path.read_text().splitlines()
    assert sorted(json.loads(line)["result"]["square"] for line in lines if line != '{"key": "half') == [0, 1, 4, 9]


@pytest.mark.parametrize("left", ['{"key": "half', '{"k', "\0\0\0", '{"key": "é'.encode()[:-1].decode("latin1"), "whole"])
def test_a_line_that_was_cut_costs_no_other(left, tmp_path):
    """Those before it and those that are added after it stay, also one that lacks its end alone."""
    path, tasks = tmp_path / "store.jsonl", squares(3)
    Store(path).keep(tasks[0], 0, "a")
    content = path.read_bytes()
    path.write_bytes(content[:-1] if left == "whole" else content + left.encode("latin1"))
    store = Store(path)
    assert len(store) == 1
    for x, each in enumerate(tasks[1:], 1):
        store.keep(each, x, "a")
    again = Store(path)
    assert [again[each] for each in tasks] == [0, 1, 2]


def test_a_store_that_another_process_adds_to_is_left_as_it_is(tmp_path):
    """Opened while the other is amid a line, it does not touch that."""
    path, tasks = tmp_path / "store.jsonl", squares(3)
    Store(path).keep(tasks[0], 0, "a")
    line = json.dumps({"key": tasks[1].key, "result": 1}) + "\n"
    with path.open("a") as other:
        other.write(line[:20])
        other.flush()
        assert len(Store(path)) == 1
        other.write(line[20:])
    Store(path).keep(tasks[2], 2, "a")
    assert len(Store(path)) == 3


def test_a_full_disk_is_said_and_leaves_what_is_kept(tmp_path):
    """The second line does not fit; once there is room again it does."""
    resource = pytest.importorskip("resource")
    path, tasks = tmp_path / "store.jsonl", squares(3)
    store = Store(path)
    store.keep(tasks[0], 0, "a")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 30, limits[1]))
    try:
        with pytest.raises(OSError, match=r"store\.jsonl"):
            store.keep(tasks[1], 1, "a")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert len(Store(path)) == 1
    store.keep(tasks[2], 2, "a")
    assert len(Store(path)) == 2


def dict_of(results):
    return {each.arguments["x"]: result["square"] for each, result in results}


def die(after):
    """Waits until a named pipe is closed, then ends its process as a lack of memory does."""
    if after:
        Path(after).read_bytes()
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_a_process_that_is_killed_is_said(tmp_path):
    """Finished tasks are kept."""
    store, pipe = tmp_path / "store.jsonl", tmp_path / "pipe"
    os.mkfifo(pipe)
    tasks = [*squares(2), task(die, after=str(pipe))]
    with pytest.raises(ChildProcessError, match=r"ended: killed, as for want of memory, .* what is finished is kept"):
        for done, _ in enumerate(sweep(tasks, store=Store(store), workers=2), 1):
            if done == 2:
                pipe.write_bytes(b"")
    assert len(Store(store)) == 2


def test_an_interruption_keeps_what_is_finished(tmp_path):
    store = Store(tmp_path / "store.jsonl")
    with ThreadPoolExecutor(1) as executor:
        for done, _ in enumerate(sweep(squares(4), executor, store), 1):
            if done == 2:
                break
    assert len(Store(tmp_path / "store.jsonl")) >= 2


class AtOnce(Executor):
    """Has all results before the first is asked for."""

    def submit(self, function, *arguments):
        future = Future()
        try:
            future.set_result(function(*arguments))
        except ValueError as error:
            future.set_exception(error)
        return future


def test_an_error_keeps_what_is_finished():
    """Whichever of them is looked at first."""
    store = Store()
    with pytest.raises(ValueError, match="x is -1"):
        list(sweep([task(square, x=-1), *squares(5)], AtOnce(), store))
    assert len(store) == 5


def alone(x):
    """Whether nothing else is measured in this process meanwhile."""
    global _measuring
    _measuring += 1
    time.sleep(0.01)
    found, _measuring = _measuring == 1, _measuring - 1
    return found


_measuring = 0


def test_threads_measure_one_after_another():
    """Side by side they would slow one another."""
    with ThreadPoolExecutor(4) as executor:
        assert all(result for _, result in sweep([task(alone, x=x) for x in range(8)], executor))


def test_other_code_is_refused_and_the_machine_kept(tmp_path):
    """In another process, for here both are the same."""
    each = task(square, x=2)
    with pytest.raises(ValueError, match=r"the process that asks another; install the same"):
        run(each, "another", tuple(extensions.extensions()))
    path = tmp_path / "store.jsonl"
    list(sweep([each], AtOnce(), Store(path)))
    assert Store(path).machine(each) == name() and platform.node() in name()


CLOTH = """
import warpcloth as wc


def scene(n: int = 4):
    springs = wc.Spring(pairs="structural", stiffness=100.0)
    return wc.Scene(wc.Mesh.grid(n, n), density=0.1, terms=[springs], pins="corners and z == 0", duration=0.1)
"""
OWN = """
import warpcloth as wc


@wc.solvers.register
class Own(wc.Explicit):
    name = "own"
"""


def found(name):
    """The working directory of a process, and its file of a solver."""
    return [os.getcwd(), sys.modules[SOLVERS[name].__module__].__file__]


@pytest.fixture
def pool(tmp_path):
    """A process that starts in another folder, with nothing of this one."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, initializer=os.chdir, initargs=(elsewhere,)) as made:
        yield made


def test_a_process_elsewhere_measures_scenes_and_solvers_of_files(pool, tmp_path, monkeypatch):
    """Errors and residuals are those of this process. The scenes are a path and a name here, and so is the cache."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WARPCLOTH_CACHE", "cache")
    monkeypatch.setattr(extensions, "_names", set())
    Path("scenes").mkdir()
    for path in ("cloth.py", "scenes/sheet.py"):
        Path(path).write_text(CLOTH, encoding="utf-8")
    Path("own_solver.py").write_text(OWN, encoding="utf-8")
    extensions.load_extension("own_solver.py")
    try:
        ((_, (folder, file)),) = sweep([task(found, name="own")], pool)
        assert folder == str(tmp_path / "elsewhere") and file == str(tmp_path / "own_solver.py")
        for name in ("cloth.py", "sheet"):
            given = {"scene": SceneRef(name, {"n": 3}), "solvers": ["own"], "frames": 3}
            with ThreadPoolExecutor(1) as executor:
                here = time_diagram(**given, executor=executor, store=Store())
            there = time_diagram(**given, executor=pool)
            assert len(here["rows"]) == len(there["rows"]) > 0
            for one, other in zip(here["rows"], there["rows"], strict=True):
                assert one["status"] == "ok" and one["error"] is not None
                for column in ("label", "status", "error", "strain_error", "residual", "machine"):
                    assert one[column] == other[column], column
    finally:
        del SOLVERS["own"], sys.modules["own_solver"]


def test_a_process_measures_for_several_others_in_turn(pool, tmp_path, monkeypatch):
    """Each with a solver of its own; one whose file has changed since it was loaded is refused."""

    def measured(name, text):
        path = tmp_path / f"{name}_solver.py"
        path.write_text(text, encoding="utf-8")
        monkeypatch.setattr(extensions, "_names", set())
        extensions.load_extension(str(path))
        try:
            ((_, (_, file)),) = sweep([task(found, name=name)], pool)
            assert file == str(path)
        finally:
            del SOLVERS[name], sys.modules[path.stem]

    measured("own", OWN)
    measured("other", OWN.replace('"own"', '"other"'))
    measured("own", OWN)
    with pytest.raises(ValueError, match="install the same on all machines and start the workers again"):
        measured("own", OWN + "# changed\n")


def test_times_of_other_machines_are_kept_apart(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    with ThreadPoolExecutor(1) as threads:
        here = {kept_store("a", executor).path for executor in (None, threads)}
    assert len(here | {kept_store("a", AtOnce()).path}) == 2 and len(here) == 1


SCRIPT = """
import sys, threading
from warpcloth.lab.campaign import sweep
from warpcloth.lab.measurements import task

def wait(pipe):
    with open(pipe, "wb", buffering=0) as file:
        file.write(b"here")
        threading.Event().wait()

if __name__ == "__main__":
    import waits
    list(sweep([task(waits.wait, pipe=sys.argv[1])], workers=1))
"""


def test_processes_end_with_the_one_that_started_them(tmp_path):
    """Killed, it tells them nothing. Their end of a pipe is closed when they end."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "waits.py").write_text(SCRIPT)
    root = str(Path(wc.__file__).parents[1])
    path = os.pathsep.join([root, str(tmp_path), os.environ.get("PYTHONPATH", "")])
    parent = subprocess.Popen([sys.executable, "waits.py", "pipe"], cwd=tmp_path, env={**os.environ, "PYTHONPATH": path})
    with open(os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK), "rb", buffering=0) as pipe:
        try:
            assert read(pipe) == b"here"
        finally:
            parent.kill()
            parent.wait()
        assert read(pipe) == b""


def read(pipe):
    """Returns the next bytes, b"" once nobody has the other end; a wait of five minutes counts as a hang."""
    assert select.select([pipe], [], [], 300.0)[0]
    return pipe.read(4)


def test_a_file_that_is_no_store_is_refused(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("a\nb\n")
    with pytest.raises(ValueError, match=r"notes.txt, line 1: is no result"):
        Store(path)
    assert path.read_text() == "a\nb\n"
    with pytest.raises(ValueError, match="is no file"):
        Store(tmp_path)


def test_keys_are_of_what_is_measured_and_of_the_code(monkeypatch):
    one = task(square, x=1)
    assert one.key == Task(one.function, dict(one.arguments)).key
    assert one.key != replace(one, arguments={"x": 2}).key
    before = one.key
    monkeypatch.setattr("warpcloth.lab.measurements.source_digest", lambda: "another")
    assert one.key != before and len(source_digest()) == 16


@pytest.mark.parametrize("changed", ["processor", "cores", "device", "warp", "numpy"])
def test_times_of_another_machine_are_not_found(changed, monkeypatch):
    """A folder of caches may be shared, and what computes may be replaced."""
    one, facts = task(square, x=1, device="cpu"), machine()
    before = one.key
    monkeypatch.setattr("warpcloth.lab.machine.machine", lambda device: facts | {changed: "another"})
    listed._machine.cache_clear()
    after = one.key
    listed._machine.cache_clear()
    assert after != before


def test_scenes_and_setups_as_data():
    scene = SceneRef("hanging", {"n": 4}).load()
    assert len(scene.mesh.points) == 16 and str(SceneRef("hanging", {"n": 4})) == "hanging(n=4)"
    assert Setup("xpbd", {"substeps": 8}).record() == wc.XPBD(substeps=8) and str(Setup("pbd", {"dt": 0.1})) == "pbd dt=0.1"
    for wrong, words in (
        (lambda: SceneRef("hanging", {"m": 4}).load(), "no parameter 'm', only n,"),
        (lambda: SceneRef("hanged").load(), "no scene 'hanged'"),
        (lambda: Setup("newtons").record(), "solver is 'newtons'; it must be one of"),
        (lambda: Setup("newton", {"steps": 1}).record(), "steps"),
        (lambda: Setup("newton", {"substeps": 0}).record(), "substeps"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=words):
            wrong()


def test_the_machine_is_named(monkeypatch, tmp_path):
    facts = machine()
    assert facts["numpy"] == np.__version__ and facts["cores"] >= 1 and facts["device"] == "cpu" and facts["processor"]
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
