"""Sweeps on a Dask cluster of two workers of this machine: each task once, with its files, as by processes."""

import asyncio
import os
import re
import socket
import subprocess
import sys
import time
import warnings
from concurrent.futures import CancelledError, Future
from hashlib import sha256
from pathlib import Path

import pytest

from warpcloth.base import extensions
from warpcloth.base.digest import scene_digest, source_digest
from warpcloth.cli import main
from warpcloth.lab import cluster as clusters
from warpcloth.lab.campaign import Store, kept_store, sweep
from warpcloth.lab.cluster import Cluster, connect
from warpcloth.lab.measurements import SceneRef, task
from warpcloth.lab.work_precision import time_diagram
from warpcloth.run.scene_files import find_source
from warpcloth.scenes import hanging
from warpcloth.solvers import SOLVERS
from warpcloth.usd import write_scene

SCENE = """
import warpcloth as wc


def scene(n: int = 4):
    springs = wc.Spring(pairs="structural", stiffness=100.0)
    return wc.Scene(wc.Mesh.grid(n, n), density=0.1, terms=[springs], pins="corners and z == 0", duration=0.1)
"""


def square(x, folder, after=None):
    """x², and a mark in a folder that it was measured; once both workers are at it, and a file is there."""
    with open(os.path.join(folder, f"{x}-{os.getpid()}-{time.time_ns()}"), "w"):
        pass
    if x < 0:
        raise ValueError(f"x is {x}; it must be 0 or more")
    until(lambda: len({mark.split("-")[-2] for mark in os.listdir(folder)}) == 2)
    until(lambda: after is None or os.path.exists(after))
    return {"square": x * x, "threads": os.environ.get("OMP_NUM_THREADS"), "process": os.getpid()}


def read(reference, scene):
    """Which files are read, and what is in them."""
    paths = [reference, str(find_source(scene["name"]).path)]
    return [[path, sha256(Path(path).read_bytes()).hexdigest()] for path in paths]


def digest(scene):
    """Of the scene as it is found."""
    return scene_digest(SceneRef(**scene).load())


def until(true):
    """Waits; ten minutes are far more than anything here takes, and keep a worker from waiting for ever."""
    ends = time.monotonic() + 600.0
    while not true() and time.monotonic() < ends:
        time.sleep(0.01)


def squares(count, folder, after=None, first=0):
    return [task(square, x=x, folder=str(folder), after=after and str(after)) for x in range(first, count)]


@pytest.fixture(scope="module")
def address():
    """Of a scheduler with two workers."""
    distributed = pytest.importorskip("distributed", reason="part of the test extra")
    given = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": ":0"}
    with distributed.LocalCluster(**given) as cluster:
        yield cluster.scheduler_address


def test_every_task_once_on_both_workers(address, tmp_path):
    tasks = squares(6, tmp_path)
    with connect(address) as cluster:
        found = list(sweep([*tasks, tasks[2]], cluster))
        assert {each.arguments["x"]: result["square"] for each, result in found} == {x: x * x for x in range(6)}
        assert len(list(tmp_path.iterdir())) == 6
        processes = {result["process"] for _, result in found}
        assert len(processes) == 2 and os.getpid() not in processes and {result["threads"] for _, result in found} == {"1"}
        list(sweep(tasks, cluster))  # no result of the cluster's own stands for a measurement
    assert len(list(tmp_path.iterdir())) == 12


def test_an_error_is_the_task_s_own_and_the_rest_is_dropped(address, tmp_path):
    store, refused = Store(tmp_path / "store.jsonl"), tmp_path / "refused"
    marks = tmp_path / "marks"
    marks.mkdir()
    tasks = [*squares(2, marks), task(square, x=-1, folder=str(marks)), *squares(60, marks, refused, first=2)]
    with connect(address) as cluster:
        with pytest.raises(ValueError, match=r"^x is -1; it must be 0 or more$"):
            list(sweep(tasks, cluster, store))
        until(lambda: not any(cluster._client.processing().values()))  # the scheduler has dropped them
        refused.touch()
        assert next(iter(sweep(squares(1, marks), cluster)))[1]["square"] == 0
    # It is among the first that run; each worker may have begun a few more before it hears of it.
    assert len(list(marks.iterdir())) < 30 and len(store) <= 2


def test_an_interruption_keeps_what_is_finished(address, tmp_path):
    store, interrupted = Store(tmp_path / "store.jsonl"), tmp_path / "interrupted"
    marks = tmp_path / "marks"
    marks.mkdir()

    def interrupt(done, *_):
        if done == 2:
            raise KeyboardInterrupt

    tasks = [*squares(2, marks), *squares(30, marks, interrupted, first=2)]
    with pytest.raises(KeyboardInterrupt), connect(address) as cluster:
        list(sweep(tasks, cluster, store, interrupt))
    assert len(Store(store.path)) == 2 and len(list(marks.iterdir())) <= 4
    interrupted.touch()
    with connect(address) as cluster:
        found = list(sweep(squares(6, marks), cluster, store))
    assert sorted(result["square"] for _, result in found) == [0, 1, 4, 9, 16, 25]


def test_files_are_sent_along(address, tmp_path, monkeypatch):
    """Workers keep them in folders of their own; of three of one name, of which one worker gets two, each its own."""
    monkeypatch.chdir(tmp_path)  # where the workers are not
    for folder in ("one", "two", "three"):
        Path(folder).mkdir()
        Path(folder, "cloth.py").write_text(SCENE + f"# {folder}\n", encoding="utf-8")
    Path("exact.npz").write_bytes(b"\x00\xff" * 1000)
    names = ("one/cloth.py", "two/cloth.py", "three/cloth.py", "hanging")
    tasks = [task(read, reference="exact.npz", scene=SceneRef(name)) for name in names]
    with connect(address) as cluster:
        found = {each.arguments["scene"]["name"]: result for each, result in sweep(tasks, cluster)}
    for name in names:
        for (kept, content), path in zip(found[name], ("exact.npz", find_source(name).path), strict=True):
            path = Path(path)
            assert content == sha256(path.read_bytes()).hexdigest() and Path(kept).name == path.name
            assert Path(kept) == path or (Path(kept).is_absolute() and tmp_path not in Path(kept).parents)
    assert Path(found["hanging"][1][0]).samefile(find_source("hanging").path)  # comes with the package


OWN = """
import warpcloth as wc
from warpcloth.solvers.step import Step


@wc.solvers.register
class Own(Step):
    name = "own"
"""


def own(name):
    """The file that a solver of this process is in."""
    return sys.modules[SOLVERS[name].__module__].__file__


def test_the_file_of_a_solver_is_sent(address, tmp_path, monkeypatch):
    monkeypatch.setattr(extensions, "_names", set())
    (tmp_path / "own_solver.py").write_text(OWN, encoding="utf-8")
    extensions.load_extension(str(tmp_path / "own_solver.py"))
    try:
        with connect(address) as cluster:
            ((_, found),) = sweep([task(own, name="own")], cluster)
    finally:
        del SOLVERS["own"], sys.modules["own_solver"]
    assert Path(found).name == "own_solver.py" and tmp_path not in Path(found).parents
    assert Path(found).read_text(encoding="utf-8") == OWN


def test_a_stage_is_sent_with_the_layers_below_it(address, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_scene(hanging.scene(n=4), "below.usda")
    root = (
        '#usda 1.0\n(\n    defaultPrim = "{}"\n    subLayers = [@./below.usda@]\n    metersPerUnit = 1\n    upAxis = "Y"\n)\n'
    )
    below = Path("below.usda").read_text(encoding="utf-8")
    Path("root.usda").write_text(root.format(re.search(r'defaultPrim = "(.*)"', below)[1]), encoding="utf-8")
    ref = SceneRef("root.usda")
    with connect(address) as cluster:
        ((_, found),) = sweep([task(digest, scene=ref)], cluster)
    assert found == scene_digest(ref.load())


@pytest.mark.slow
def test_charts_are_those_of_processes(address, tmp_path, monkeypatch):
    """But for times, which are kept apart."""
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    Path("cloth.py").write_text(SCENE, encoding="utf-8")
    scene, given = SceneRef("cloth.py", {"n": 3}), {"solvers": ["explicit"], "frames": 3}
    here = time_diagram(scene, **given, workers=1)
    with connect(address) as cluster:
        there = time_diagram(scene, **given, executor=cluster)
        assert len(kept_store("work-precision", cluster)) == len(kept_store("work-precision")) == len(here["rows"])
    for one, other in zip(here["rows"], there["rows"], strict=True):
        assert one["status"] == "ok" and one["error"] is not None
        for name in ("label", "status", "error", "strain_error", "residual", "machine"):
            assert one[name] == other[name], name
        assert socket.gethostname() in other["machine"]


def test_commands(address, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path))
    monkeypatch.setattr(clusters, "_ANSWER", 0.5)
    chart = ["chart", "work-precision", "chain", "-p", "links=3", "--frames", "2", "--solvers", "explicit"]
    stability = "chart stability chain -p links=3 --x dt --y stiffness --x-range 1e-3 1e-1 3 --y-range 1 10 2".split()
    stability += ["--steps", "4", "--duration", "0.01"]
    choose = ["choose", "chain", "-p", "links=3", "--frames", "2", "--tolerance", "1%", "--solvers", "explicit"]
    for command in (chart, [*stability, "--solvers", "explicit"], choose):
        assert main([*command, "--dask", address]) == 0, capsys.readouterr().err
        assert main([*command, "--dask", f"127.0.0.1:{_free()}"]) == 2
        assert "no Dask scheduler answers at 127.0.0.1" in capsys.readouterr().err
    assert {path.name for path in (tmp_path / "dask").iterdir()} >= {
        "work-precision.jsonl",
        "stability.jsonl",
        "trajectories.jsonl",
    }
    for command in (chart, stability):
        assert main([*command, "--dask", address, "--workers", "2"]) == 2
        assert "leave one out" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main([*chart, "--dask", address]) == 2
    assert "pip install -e '.[dask]' in the checkout" in capsys.readouterr().err


def _free():
    """A port at which nothing listens."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@pytest.mark.slow
def test_addresses(address, tmp_path):
    file = tmp_path / "scheduler.json"
    file.write_text(f'{{"address": "{address}"}}', encoding="utf-8")
    with connect(str(file)) as cluster:
        assert isinstance(cluster, Cluster)
    file.write_text("[]", encoding="utf-8")
    for wrong, words in (
        ("host", "'host' is no address"),
        ("x://h:1", "unknown address scheme"),
        (str(file), "no scheduler file"),
    ):
        with pytest.raises(ValueError, match=words), connect(wrong):
            pass
    with pytest.raises(ConnectionError, match="went away; what is measured is kept"), connect(address):
        raise CancelledError  # of a measurement that nobody here dropped


class Workers:
    """A client whose workers say of themselves what they are told."""

    def __init__(self, *facts):
        fit = {"source": source_digest(), "arithmetic": "1", "threads": 1, "processor": "A"}
        self.facts = {f"tcp://w{i}": one if isinstance(one, Exception) else fit | one for i, one in enumerate(facts)}

    def wait_for_workers(self, count, timeout):
        if not self.facts:
            raise asyncio.TimeoutError

    def run(self, function, on_error):
        return self.facts


@pytest.mark.slow
def test_workers_that_are_not_fit():
    for facts, words in (
        ([], "has no workers; start some"),
        ([{}, ModuleNotFoundError("No module named 'warpcloth'")], "tcp://w1 cannot import"),
        ([{"source": "another"}], "tcp://w0 has code of warpcloth another"),
        ([{}, {"arithmetic": None}], "tcp://w1 computes with several threads"),
    ):
        with pytest.raises((ValueError, ConnectionError), match=words):
            clusters._check(Workers(*facts), "tcp://s")
    for facts, words in (([{}, {"threads": 8}], "one at a time"), ([{}, {"processor": "B"}], r"differ.*A \(1\), B \(1\)")):
        with pytest.warns(UserWarning, match=words):
            clusters._check(Workers(*facts), "tcp://s")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        clusters._check(Workers({}, {}), "tcp://s")


@pytest.mark.slow
def test_the_scheduler_needs_no_warpcloth(address):
    """It unpickles what is submitted, but not what only workers need."""
    from distributed.protocol.pickle import dumps

    submitted = []

    class Scheduler:
        def get_executor(self, **_):
            return self

        def submit(self, *call):
            submitted.append(dumps(call))
            return Future()

    Cluster(Scheduler()).submit(square, task(square, x=1, folder="."), source_digest())
    code = "import pickle, sys; sys.modules['warpcloth'] = None; pickle.loads(sys.stdin.buffer.read())"
    subprocess.run([sys.executable, "-c", code], input=submitted[0], check=True)
