"""The energy and the solver of docs/extending.md, each a file outside the package: in Python, commands and charts."""

import json
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.command_line import refused, run
from support.outside import write_files
from warpcloth.base import extensions
from warpcloth.base.digest import package_digest, source_digest
from warpcloth.cli.options import solvers
from warpcloth.lab import benchmarks
from warpcloth.lab.setups import setups_of_runs, setups_of_steps
from warpcloth.solvers import SOLVERS, register
from warpcloth.terms import TERMS
from warpcloth.usd import read_scene, write_scene

SCENE = """
import numpy as np
import warpcloth as wc
from plane import Plane


def scene(n: int = 5):
    terms = [wc.Spring(stiffness=100.0), Plane(vertices="x < 0.01", stiffness=1e3, normal=(1.0, 0.0, 0.0))]
    return wc.Scene(wc.Mesh.grid(n, n), density=0.1, terms=terms, pins="corners and z == 0", duration=0.1)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("outside")
    write_files(path)
    (path / "slide.py").write_text(SCENE, encoding="utf-8")
    return path


@pytest.fixture
def outside(folder, monkeypatch, tmp_path):
    """The folder of the two files, as the current one; what a test registers is forgotten after it."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path / "cache"))
    for known in (SOLVERS, TERMS):
        for name in {*known}:
            monkeypatch.setitem(known, name, known[name])
    monkeypatch.setattr(extensions, "_names", set())
    monkeypatch.setattr(extensions, "_files", set())
    before = {*SOLVERS}, {*TERMS}, {*sys.modules}
    yield folder
    for known, names in zip((SOLVERS, TERMS), before, strict=False):
        for name in {*known} - names:
            del known[name]
    for name in {"plane", "descent"} - before[2]:
        sys.modules.pop(name, None)


@pytest.fixture
def scene(outside):
    for name in ("plane.py", "descent.py"):
        extensions.load_extension(name)
    found = wc.run.scene_files.find_source("slide.py").scene({"n": 5})
    return found, SOLVERS["descent"]


IMPORTS = ["--import", "plane.py", "--import", "descent.py"]


def test_both_run_in_python(scene, device):
    """The minimiser of a step is that of Newton's method: an unbalanced acceleration a is a distance of h²a at most."""
    declared, Descent = scene
    record, g = Descent(substeps=4, iterations=1000, tolerance=1e-6), 9.81
    found = [wc.simulate(declared, each, device=device, dtype="float64", frames=1) for each in (record, wc.Newton(substeps=4))]
    assert all(each.status.ok for each in found)
    assert found[0].status.result.value == "converged" and found[0].status.measure.startswith("largest unbalanced")
    first, last = found[0].points[0], found[0].points[-1]
    assert np.abs(last - first).max() > 1e-3
    # Of a step by the tolerance of Newton, 1e-3 g; four steps carry it on as velocity.
    assert np.abs(last - found[1].points[-1]).max() < 1e-3 * g / 240**2 * (1 + 2 + 3 + 4)
    slid = last[declared.mesh.select("x < 0.01 and not corners")]
    assert np.abs(slid[:, 0]).max() < 1e-3, "the plane holds them"


def test_refusals_follow(scene):
    declared, Descent = scene
    soft = replace(declared, terms=[wc.StVKMembrane(stiffness=10.0)]).build()
    with pytest.raises(ValueError, match=r"Descent cannot take StVKMembrane, .*; Explicit, Newton, Pro.* can"):
        Descent(substeps=1).bind(soft)
    bodies = replace(declared, terms=[wc.RigidCluster(vertices="all", stiffness=10.0)]).build()
    with pytest.raises(ValueError, match=r"ADMM cannot take RigidCluster.* or Descent can"):
        wc.ADMM(substeps=1).bind(bodies)
    with pytest.raises(ValueError, match="'descent' is the name of a solver of descent; Other must have another"):
        register(type("Other", (wc.solvers.step.Step,), {"name": "descent", "__module__": "other"}))


def test_both_go_through_usd(scene, outside, capfd, tmp_path):
    declared, _ = scene
    write_scene(declared, tmp_path / "slide.usda")
    read = read_scene(tmp_path / "slide.usda")
    for one, other in zip(declared.terms, read.terms, strict=True):
        assert type(one) is type(other) and one.stiffness == other.stiffness
    assert np.array_equal(read.terms[1].normal, (1.0, 0.0, 0.0))
    command = ["run", tmp_path / "slide.usda", *IMPORTS, "--solver", "descent", "-s", "substeps=4", "--frames", "2"]
    code, out, err = run(capfd, *command, "--json", "-o", tmp_path / "out.usdc")
    assert code == 0 and json.loads(out)["solver"] == "descent", err
    assert len(wc.open_sequence(tmp_path / "out.usdc")) == 3


def test_the_command_line_knows_them(outside, capfd):
    refused(capfd, ["info", "slide.py"], "No module named 'plane'")
    refused(capfd, ["info", "hanging", "--import", "nothing"], "nothing cannot be imported: ModuleNotFoundError")
    refused(capfd, ["info", "hanging", "--import"], "argument --import: expected one argument; see warpcloth info --help")
    Path("exits.py").write_text("raise SystemExit(0)", encoding="utf-8")
    refused(capfd, ["info", "hanging", "--import", "exits.py"], "exits.py cannot be imported: SystemExit: 0")
    code, out, _ = run(capfd, "info", "slide.py", *IMPORTS, "--solver", "descent", "-s", "substeps=4", "--json")
    facts = json.loads(out)
    assert code == 0 and facts["solver"]["solver"] == "descent"
    assert [term["term"] for term in facts["model"]["terms"]] == ["Spring", "Plane"]
    code, out, _ = run(capfd, "run", "hanging", *IMPORTS, "--solver", "descent", "-s", "help")
    assert code == 0 and "integrator  euler  one of euler, midpoint, bdf2" in out
    assert solvers()["descent"]["integrator"] == ("euler", "midpoint", "bdf2")
    code, out, _ = run(capfd, "run", *IMPORTS, "--help")
    assert code == 0 and "descent" in out


def test_charts_and_choices_have_settings(scene, outside):
    from warpcloth.lab.benchmarks import standard
    from warpcloth.lab.measurements import SceneRef

    assert [setup.options["substeps"] for setup in setups_of_runs(SceneRef("slide.py"), ["descent"])] == [4, 8, 16]
    assert len(setups_of_steps(["descent"])) == 1
    (benchmark,) = [each for each in standard() if each.setup.solver == "descent"]
    assert benchmark.sizes == (16, 32)


def test_code_counts_in_keys_of_measurements(scene, outside):
    assert set(extensions.extensions()) == {str(outside / "plane.py"), str(outside / "descent.py")}
    before, text = source_digest(), Path("descent.py").read_text(encoding="utf-8")
    assert before != package_digest()
    Path("descent.py").write_text(text + "# another\n", encoding="utf-8")
    try:
        assert source_digest() != before
    finally:
        Path("descent.py").write_text(text, encoding="utf-8")
    assert source_digest() == before


MEASURES = {
    "bench": ["bench", "slide.py", "--solver", "descent", "--frames", "1"],
    "choose": ["choose", "slide.py", "--solvers", "descent", "--tolerance", "5%", "--frames", "2"],
    "work-precision": ["chart", "work-precision", "slide.py", "--solvers", "descent", "--frames", "2", "--workers", "1"],
    "stability": (
        "chart stability slide.py --x stiffness --x-range 1 10 2 --y dt --y-range 1e-3 1e-2 2 --steps 4 --duration 0.02 "
        "--solvers descent --workers 1"
    ).split(),
}


# Each starts processes.
SLOW = pytest.mark.slow


@pytest.mark.parametrize("name", [pytest.param(name, marks=() if name == "choose" else SLOW) for name in MEASURES])
def test_processes_that_measure_load_them(name, outside, capfd, tmp_path, monkeypatch):
    # `bench` compiles all kernels anew in test_bench.py.
    monkeypatch.setattr(benchmarks, "TemporaryDirectory", lambda **_: nullcontext(wp.config.kernel_cache_dir))
    picture = ["-o", tmp_path / "chart.png"] if "chart" in MEASURES[name] else []
    code, out, err = run(capfd, *MEASURES[name], *IMPORTS, *picture, "--json")
    assert code == 0, err
    found = json.loads(out)
    if name == "choose":
        assert found["meets"] and found["chosen"]["setup"]["solver"] == "descent"
        assert "--import plane.py --import descent.py" in found["command"]
    elif name == "stability":
        verdicts = [cell["verdict"] for row in found["maps"]["descent"] for cell in row]
        assert len(verdicts) == 4 and set(verdicts) <= {"stable", "inaccurate"}
    else:
        assert {row["status"] for row in found["rows"]} == {"ok"}
        assert {row["solver"] for row in found["rows"]} == {"descent"}
    assert not picture or (tmp_path / "chart.png").stat().st_size > 10_000


def test_entry_points_are_loaded(outside, monkeypatch):
    """A broken one is a warning, for it must not keep others from working."""
    points = [type("Point", (), {"name": name, "module": name}) for name in ("nothing_here", "descent")]
    monkeypatch.setattr(extensions, "entry_points", lambda group: points if group == "warpcloth.extensions" else [])
    monkeypatch.syspath_prepend(str(outside))
    with pytest.warns(
        UserWarning, match="nothing_here of the entry points warpcloth.extensions: nothing_here cannot be imported"
    ):
        extensions.load_installed.__wrapped__()
    assert "descent" in SOLVERS and extensions.extensions() == {str(outside / "descent.py"): [outside / "descent.py"]}
