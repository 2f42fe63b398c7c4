"""The command line: wrong use in one line, runs and their summaries, what is left of runs that end early."""

import contextlib
import importlib
import json
import math
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import warpcloth.cli.run
import warpcloth.cli.scenes
import warpcloth.cli.terminal
import warpcloth.usd
from support.command_line import refused, run
from support.rows import slow_but
from support.stage_texts import STAGE
from warpcloth.base.outputs import Lock
from warpcloth.base.texts import convert
from warpcloth.cli import _parser, main
from warpcloth.run import scene_files
from warpcloth.solvers import SOLVERS, explicit
from warpcloth.usd import FrameSequence, chunks

ROOT = Path(__file__).parents[2]
SMALL = ["hanging", "-p", "n=5"]

# A scene whose term fails where the model is built, in a way that nobody checks for.
FAILING = """
import warpcloth as wc

class Term(wc.Spring):
    def elements(self, *_):
        {}

def scene():
    return wc.Scene(wc.Mesh.grid(3, 3), density=1.0, terms=[Term(stiffness=1.0)], duration=0.1, pins=[0])
"""


def test_a_run_writes_its_history(tmp_path, capfd, monkeypatch):
    """The table has the energies and the summed reactions of each frame, the report those of each pin."""
    monkeypatch.chdir(tmp_path)
    options = ["--frames", "4", "--dtype", "float64", "-o", "a.usdc", "--csv", "a.csv", "--report", "a.json"]
    code, out, err = run(capfd, "run", *SMALL, *options, "--json")
    assert (code, err) == (0, "") and json.loads(out)["csv"] == "a.csv" and json.loads(out)["report"] == "a.json"
    history = json.loads((tmp_path / "a.json").read_text())
    rows = [line.split(",") for line in (tmp_path / "a.csv").read_text().splitlines()]
    assert rows[0] == ["frame", "time", "Spring", "QuadraticBending", "kinetic", "gravity", *(f"reaction {x}" for x in "xyz")]
    assert list(history["energies"]) == rows[0][2:6] and len(rows) == 6
    assert [row[:2] for row in rows[1:3]] == [["0", "0.0"], ["1", str(1 / 60)]]
    assert np.shape(history["reactions"]) == (5, len(history["pins"]), 3) == (5, 2, 3)
    np.testing.assert_array_equal([[float(cell) for cell in row[6:]] for row in rows[1:]], np.sum(history["reactions"], axis=1))
    refused(capfd, ["run", *SMALL, "-o", "b.usdc", "--csv", "x.csv", "--report", "x.csv"], "given for two outputs")
    refused(capfd, ["run", *SMALL, "-o", "b.usdc", "--report", "no/x.json"], "does not exist")
    hard = ["-p", "n=5", "stiffness=inf", "--frames", "2", "-o", "c.usdc", "--report", "c.json"]
    refused(capfd, ["run", "hanging", *hard, "--solver", "pbd"], "PBD has no multipliers")
    assert run(capfd, "run", "hanging", *hard, "--solver", "xpbd")[0] == 0
    assert json.loads((tmp_path / "c.json").read_text())["reactions"][0] == [[None] * 3] * 2  # of a step that has not been made


SCENE_FILES = {
    "type.py": FAILING.format("None + 'a'"),
    "attribute.py": FAILING.format("().x"),
    "exit.py": FAILING.format("raise SystemExit(1)"),
    "good.py": '''
"""A small sheet."""
import warpcloth as wc

def scene(n: int = 4, *, size=1.0, sag: bool = False, label: str = "sheet", fps: float = 60.0, hole: tuple = ()):
    """Vertices a side, side [m]."""
    mesh = wc.Mesh.grid(n, n, size=size)
    terms = [wc.Spring(pairs="structural", stiffness=1e3)]
    return wc.Scene(mesh, density=0.1, terms=terms, pins=None if sag else [0], duration=6 / fps, fps=fps, name=label)
''',
    "rigid.py": """
import math
import warpcloth as wc

def scene():
    return wc.Scene(wc.Mesh.grid(3, 3), density=1.0, terms=[wc.Spring(stiffness=math.inf)], duration=0.1, pins=[0])
""",
    "needs.py": "def scene(n: int):\n    return n\n",
    "nothing.py": "x = 1\n",
    "syntax.py": "x = 1\ndef scene(:\n",
    "imports.py": "\nimport no_such_module_at_all\n",
    "raises.py": "def scene():\n    values = {}\n    return values['a\\nb']\n",
    "exits.py": "import sys\n\nsys.exit(3)\n",
    "quits.py": "def scene():\n    raise SystemExit\n",
    "stops.py": "class Stop(BaseException):\n    pass\n\ndef scene():\n    raise Stop('here')\n",
    "rubbish.py": "import warpcloth as wc\ndef scene():\n    return wc.Scene(mesh='sheet', density=1.0)\n",
    "number.py": "def scene():\n    return 3\n",
    "broken.usda": "no stage\n",
    "notes.txt": "no scene\n",
    "cache.pc2": "",
    "cache.abc": "",
    "sheet.obj": "v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 3 2\n",
}

# argv, with {} for a folder of SCENE_FILES, and a part of the line that it gives.
WRONG_USES = [
    ("run", "the following arguments are required: SCENE; see warpcloth run --help"),
    ("run -p n=8 hanging", "are required: SCENE (SCENE must stand before -p, which takes all that follows it); see"),
    ("chart work-precision --solvers newton -p n=8 hanging", "are required: SCENE (SCENE must stand before --solvers"),
    ("run {}/good.py -p label=a/b", "the output would be called 'a/b', which cannot be the name of a file; give one with -o"),
    ("run {}/good.py -p label=..", "the output would be called '..', which cannot be the name of a file; give one with -o"),
    ("run {}/good.py -o {}/o.usdc --prim Cloth", "good.py has no parameter 'prim'; allowed are n, size"),
    ("run hanging -o {}/o.usdc --pins", "argument --pins: expected one argument"),
    ("info hanging --pins nowhere", "'nowhere'"),
    ("info hanging --pins x==7", "--pins 'x==7' names no vertex; the mesh reaches from (0, 0, 0) to (1, 0, 1)"),
    ("bench -p help", "-p help lists the parameters of a scene; give SCENE before it"),
    ("walk hanging", "invalid choice: 'walk'"),
    ("rum hanging", "did you mean run?; see warpcloth --help"),
    ("help run", "invalid choice: 'help'"),
    ("rum run", "did you mean run?; see warpcloth --help"),
    ("chart help stability", "see warpcloth chart --help"),
    ("-v run hanging", "unrecognized arguments: -v; see warpcloth --help"),
    ("run hanging --sover pbd", "unrecognized arguments: --sover pbd; did you mean --solver?; see warpcloth run --help"),
    ("chart work-precision hanging --solver pbd", "did you mean --solvers?; see warpcloth chart work-precision --help"),
    ("run hanging --solver pdb", "did you mean pbd?; see warpcloth run --help"),
    ("run hanging -s itertions=3 -o {}/o.usdc", "; did you mean iterations?"),
    ("run hanging -p stifness=3", "; did you mean stiffness?"),
    ("run hangin", "; did you mean hanging?"),
    ("run hanging --fabric denin", "; did you mean denim?"),
    ("measure loop -p kind=pear fabric=denim", "kind with a fabric is 'pear'; it must be one of 'heart'\n"),
    ("fabrics denin", "; did you mean denim?"),
    ("run hanging -s linear=cgg -o {}/o.usdc", "; did you mean cg?"),
    ("run hanging -o {}/o.usdc --device cuda", "device is 'cuda'; on this machine there are cpu"),
    ("view {}/*.obj", "the output would be called '*', which cannot be the name of a file; give one with -o"),
    ("run hanging -o {}/o.usdc --speed 3", "unrecognized arguments: --speed"),
    ("run hanging -o {}/o.usdc --solver simplex", "invalid choice: 'simplex'"),
    ("run hanging -o {}/o.usdc --dtype float16", "invalid choice: 'float16'"),
    ("run hanging -o {}/o.usdc --device gpu", "device is 'gpu'; on this machine there are cpu"),
    ("run hanging -o {}/o.usdc --device cuda:99", "device is 'cuda:99'; on this machine there are cpu"),
    ("run hanging -o {}/o.usdc --frames 0", "frames is 0; it must be a whole number of 1 or more"),
    ("run hanging -o {}/o.usdc --frames 1.5", "invalid int value: '1.5'"),
    ("run -p n=5 hanging -o {}/o.usdc", "the following arguments are required: SCENE"),
    # places
    ("run hanging -o {}/no/o.usdc", "no does not exist"),
    ("run hanging -o {}/o.obj", "must end with one of .usd, .usda, .usdc, .usdz"),
    ("run hanging -o {}", "must end with one of"),
    ("run hangin -o {}/o.usdc", "there is no scene 'hangin'; known by name are "),
    ("run {}/none.py -o {}/o.usdc", "none.py: there is no such file"),
    ("run {} -o {}/o.usdc", "is a folder, no scene"),
    ("info {}/none.usda", "none.usda: there is no such file"),
    ("scenes {}/none", "none: there is no such folder"),
    # scene files
    ("info {}/notes.txt", "notes.txt: is no scene; it must be a .py file, a USD stage or a mesh (.obj"),
    ("info {}/cache.pc2", "cache.pc2: is no scene; it must be a .py file, a USD stage or a mesh"),
    ("info {}/cache.abc", "'warpcloth convert' makes a stage of .pc2, .mdd, .npz and numbered .obj files"),
    ("info {}/sheet.obj --fabric denin", "fabric is 'denin'; it must be one of cotton"),
    ("info {}/sheet.obj --scale 0", "scale is 0.0; it must be a number above 0"),
    ("info {}/sheet.obj --scale 2 -p scale=3", "scale is given twice"),
    ("info hanging --scale 2", "hanging.py has no parameter 'scale'"),
    ("info {}/nothing.py", "nothing.py: has no function scene()"),
    ("info {}/syntax.py", "syntax.py, line 2: SyntaxError: "),
    ("info {}/imports.py", "imports.py, line 2: ModuleNotFoundError: No module named 'no_such_module_at_all'"),
    ("info {}/raises.py", "raises.py, line 3: KeyError: "),
    ("info {}/exits.py", "exits.py, line 3: SystemExit: 3"),
    ("run {}/quits.py -o {}/o.usdc", "quits.py, line 2: SystemExit\n"),
    ("info {}/stops.py", "stops.py, line 5: Stop: here"),
    ("info {}/rubbish.py", "rubbish.py, line 3: ValueError: mesh is"),
    ("info {}/type.py", "warpcloth: TypeError: unsupported operand"),
    ("run {}/type.py -o {}/o.usdc", "'str' (run again with --debug for the traceback)\n"),
    ("run {}/type.py --solver explicit -o {}/o.usdc", "'str' (run again with --debug for the traceback)\n"),
    ("info {}/attribute.py", "warpcloth: AttributeError: 'tuple' object has no attribute 'x' (run again with"),
    ("run {}/exit.py -o {}/o.usdc", "warpcloth: SystemExit: 1 (run again with"),
    ("info {}/number.py", "number.py: scene() returned a int; it must return a warpcloth.Scene"),
    ("info {}/broken.usda", "is no USD stage"),
    # parameters
    ("info hanging -p m=3", "has no parameter 'm'; allowed are n, stiffness, bending, density, duration"),
    ("info hanging -p n=many", "n is 'many'; it must be a whole number"),
    ("info hanging -p n=3/2", "n is '3/2'; it must be a whole number"),
    ("info hanging -p density=1/0", "density is '1/0'; it must be a number, or a fraction such as 1/240"),
    ("info hanging -p density=nan", "density is 'nan'; it must be a number"),
    ("info hanging -p density=__import__('os')", "it must be a number"),
    ("info hanging -p n", "'n' is not of the form name=value"),
    ("info hanging -p n=3 n=4", "n is given twice, as '3' and '4'"),
    ("info hanging -p n=1", "hanging.py, line 21: ValueError: nx is 1; it must be"),
    ("info hanging -p duration=0.01", "ValueError: duration is 0.01 s; at fps 60.0 it must be a whole number of frames"),
    ("info {}/good.py -p sag=perhaps", "sag is 'perhaps'; it must be true or false"),
    ("info {}/good.py -p hole=3", "hole takes tuple, which cannot be written as text"),
    ("info {}/needs.py", "needs.py needs a value for n; give it with -p n=…"),
    ("info {}/rigid.py -p n=3", "has no parameter 'n'; it takes none"),
    # options
    (
        "run hanging -o {}/o.usdc -s speed=3",
        "Newton has no option 'speed'; allowed are dt, substeps, integrator, error, tolerance, iterations",
    ),
    ("run hanging -o {}/o.usdc -s iterations=3.5", "iterations is '3.5'; it must be a whole number"),
    ("run hanging -o {}/o.usdc -s tolerance=0", "tolerance is 0.0; it must be a number above 0"),
    ("run hanging -o {}/o.usdc -s tolerance=inf", "tolerance is inf; it must be a number above 0"),
    ("run hanging -o {}/o.usdc -s dt=1/240 substeps=4", "only one of dt, substeps and error may be given"),
    ("run hanging -o {}/o.usdc -s dt=1/100", "a frame must be a whole number of steps"),
    ("run hanging -o {}/o.usdc -s linear=magic", "linear is 'magic'; it must be one of 'cg', 'factorised'"),
    ("run hanging -p n=5 -o {}/o.usdc --solver explicit -s substeps=1", "symplectic Euler is stable below"),
    ("run hanging -p n=5 -o {}/o.usdc --solver explicit -s scheme=forward", "forward Euler is stable at no step"),
    ("run {}/rigid.py -o {}/o.usdc", "Newton cannot take Spring with infinite stiffness"),
    ("run {}/rigid.py --solver explicit -o {}/o.usdc", "Explicit cannot take Spring with infinite stiffness"),
]
# Parameters that make no sense, of each scene that comes with the package.
NONSENSE = {
    "ValueError: {} is {}; it must be a number above 0": "cantilever gamma=0.0, cantilever length=0.0, flag period=0.0, "
    "flag duration=inf, bar_twist duration=0.0, bunny duration=inf, usd_cloth density=0.0, cantilever length=-1.0 width=0.2",
    "ValueError: {} is {}; it must be a number of 0 or more": "cantilever width=-1.0, cantilever width=inf, flag swing=inf",
    "ValueError: {} is {}; it must be a number that is finite": "bar_twist angle=inf, bunny angle=inf, bunny lift=inf",
    "ValueError: {} is {}; it must be a whole number of 2 or more": "cantilever elements=0, cantilever elements=0 width=0.2",
    "ValueError: {} is {}; it must be a whole number of 1 or more": "bar_twist cells=0",
    "ValueError: {} is {}; it must be a finite positive length": "catenary length=-1.0, chain length=inf",
    "ValueError: {} is {}; it must be above 0, and no more than the length, 1.2": "catenary span=0.0, catenary span=1.3",
    "ValueError: {} is {} s; at fps 24.0 it must be a whole number of frames": "bar_twist duration=0.01",
    "ValueError: n is 1; it must be a whole number of vertices, at least 2": "catenary links=0, chain links=0",
    "ValueError: nx is 1; it must be a whole number of vertices, at least 2": "flag nx=1",
    "ValueError: {} is '{}'; it must be one of 'quadratic', 'dihedral', 'plate'": "cantilever bending=foo",
    "ValueError: {} is '{}' and width is 0, one row of triangles": "cantilever bending=plate",
    "ValueError: vertex 1 has mass 0.0 kg; a vertex that is not pinned must have a finite one above 0": "chain mass=0.0",
    "kg; a vertex that is not pinned must have a finite one above 0": "hanging density=-1",
    "it must be a number above 0": "catenary weight=-1",
    "Spring.stiffness is -83.3": "catenary stretching=-1",
    "Spring.stiffness is -0.001; it must be 0 or more": "cantilever stretching=-1",
    "Spring.stiffness is -1.0; it must be 0 or more": "chain stiffness=-1, flag stiffness=-1, hanging stiffness=-1, "
    "bar_twist stiffness=-1, bunny stiffness=-1, usd_cloth stiffness=-1",
    "QuadraticBending.stiffness is -1.0; it must be 0 or more": "flag bending=-1, usd_cloth bending=-1",
    "DihedralBending.stiffness is -1.0; it must be 0 or more": "bar_twist bending=-1, bunny bending=-1",
}
for rule, given in NONSENSE.items():
    for each in given.split(", "):
        name, words = each.split(" ", 1)
        WRONG_USES.append((f"info {name} -p {words}", rule.format(*words.partition(" ")[0].split("="))))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    for name, text in SCENE_FILES.items():
        (folder / name).write_text(text.lstrip("\n") if name == "good.py" else text)
    return folder


@pytest.mark.parametrize(("argv", "fragment"), WRONG_USES, ids=[argv for argv, _ in WRONG_USES])
def test_wrong_use_gives_one_line_and_exit_code_2(folder, capfd, argv, fragment):
    refused(capfd, argv.replace("{}", str(folder)).split(), fragment)
    assert not list(folder.glob("o*"))


@pytest.mark.parametrize(("name", "code"), [("type.py", "None + 'a'"), ("raises.py", "values['a")])
def test_debug_shows_the_traceback_above_the_line(folder, capfd, name, code):
    result, out, err = run(capfd, "info", folder / name, "--debug")
    assert (result, out) == (2, "")
    assert err.startswith("Traceback (most recent call last):\n") and code in err
    assert err.splitlines()[-1].startswith("warpcloth: ") and "--debug" not in err


def test_a_stage_with_cloth_attributes_runs_as_a_layer_over_it(folder, tmp_path, capfd):
    source, output = tmp_path / "cloth.usda", tmp_path / "out.usda"
    warpcloth.usd.write_scene(scene_files.find_source(folder / "good.py").function(), source)
    before = source.read_bytes()
    refused(capfd, ["run", source, "-o", source], "a file of the source's stage; it must be another file")
    refused(capfd, ["run", source, "-p", "n=3", "-o", output], "has no parameter 'n'; allowed are prim")
    refused(capfd, ["run", source, "-p", "prim=/World/Silk", "-o", output], "/World/Silk")
    code, out, err = run(capfd, "run", source, "-p", "prim=/World/Cloth", "--json", "-o", output)
    assert (code, err) == (0, "")
    assert json.loads(out)["frames"] == 6
    assert FrameSequence(output).shape == (7, 16, 3)
    assert source.read_bytes() == before and "cloth.usda" in output.read_text()


def test_a_folder_that_cannot_be_written_is_refused_before_anything_runs(capfd):
    if not os.path.isdir("/proc/self"):
        pytest.skip("needs /proc, a folder that not even root can write")
    refused(capfd, ["run", *SMALL, "-o", "/proc/out.usdc"], "output = /proc/out.usdc: the folder /proc cannot be written (")
    refused(capfd, ["run", *SMALL, "-o", "out.usdc", "--film", "/proc/a.gif"], "/proc: the folder cannot be written (")


@pytest.mark.parametrize("solver", SOLVERS)
def test_each_solver_runs_with_its_default_step(tmp_path, capfd, solver):
    step = "by default the fewest stable ones, limits " if solver == "explicit" else "substeps=4"
    output = tmp_path / "out.usdc"
    code, out, err = run(capfd, "run", *SMALL, "--solver", solver, "--frames", 3, "-o", output)
    assert (code, err) == (0, "")
    assert any(f"hanging: {end}" in out for end in ("co", "iterations used up ")) and "3 of 3, " in out and step in out
    assert f"{output}, with its frames in {tmp_path / 'out_frames'}\n" in out
    assert out.endswith("(they belong together: move both, or make one file with --single-file)\n")
    assert FrameSequence(output).shape == (4, 25, 3)


PRECISIONS = [
    ("newton", (), "float64"),
    ("explicit", (), "float32"),
    ("newton", ("--dtype", "float32"), "float32"),
    ("explicit", ("--dtype", "float64"), "float64"),
]


@pytest.mark.parametrize(("solver", "given", "dtype"), PRECISIONS)
def test_what_precision_was_used_is_said(solver, given, dtype, tmp_path, capfd):
    words = [*SMALL, "--solver", solver, *given]
    lines = run(capfd, "run", *words, "--frames", 1, "-o", tmp_path / "a.usdc")[1].splitlines()
    assert f"  device        cpu, {dtype}" in lines
    assert json.loads(run(capfd, "run", *words, "--frames", 1, "--json", "-o", tmp_path / "b.usdc")[1])["dtype"] == dtype
    assert json.loads(run(capfd, "info", *words, "--json")[1])["model"]["dtype"] == dtype


def test_json_is_one_object_with_the_facts_of_the_summary(tmp_path, capfd):
    output = tmp_path / "out.usdc"
    options = ["-s", "dt=1/120", "iterations=1", "-s", "tolerance=1e-9"]
    argv = ["run", *SMALL, *options, "--frames", 2, "--dtype", "float64", "--single-file", "--json", "-o", output]
    code, out, err = run(capfd, *argv)
    facts = json.loads(out)
    assert (code, err, out.count("\n")) == (0, "", 1)
    expected = {"scene": "hanging", "status": "iterations used up", "frames": 2, "frames_asked": 2, "solver": "newton"}
    expected |= {"step": 1 / 120, "step_chosen": None, "device": "cpu", "dtype": "float64"}
    expected |= {"file": str(output), "frames_folder": None}
    assert {name: facts[name] for name in expected} == expected
    assert facts["options"]["dt"] == 1 / 120 and facts["options"]["iterations"] == 1
    assert facts["parameters"]["n"] == 5
    assert facts["residual"] > 1e-9 and facts["worst_strain"] > 0.0
    measured = ("largest unbalanced acceleration of a vertex", "times gravity")
    assert (facts["residual_measure"], facts["residual_unit"]) == measured
    assert facts["seconds_per_frame"] > 0.0 and facts["compile_seconds"] > 0.0
    assert os.listdir(tmp_path) == ["out.usdc"]


def test_the_default_step_follows_the_frame_rate(folder, tmp_path, capfd):
    for fps, substeps in ((24, 10), (60, 4), (1000, 1)):
        argv = ["run", folder / "good.py", "-p", f"fps={fps}", "--frames", 1, "--json", "-o", tmp_path / "out.usda"]
        code, out, _ = run(capfd, *argv)
        assert code == 0
        assert json.loads(out)["options"]["substeps"] == substeps


def test_explicit_default_step_is_below_both_limits_and_one_less_is_not(capfd):
    """One less is stable about rest only, which is a warning in one line."""
    _, out, err = run(capfd, "info", *SMALL, "--solver", "explicit", "--json")
    solver = json.loads(out)["solver"]
    limit = min(solver["limit_about_rest"] / 1.1, solver["limit_in_motion"])
    substeps = solver["options"]["substeps"]
    assert 1 / (60 * substeps) < limit <= 1 / (60 * (substeps - 1))
    assert err == ""
    code, out, err = run(capfd, "info", *SMALL, "--solver", "explicit", "-s", f"substeps={substeps - 1}")
    assert code == 0 and "in motion below" in out
    assert err.startswith("warpcloth: warning: dt is ") and err.count("\n") == 1


@pytest.mark.parametrize(
    ("command", "options"), [("run", []), ("info", []), ("info", ["-s", "substeps=100"]), ("info", ["-s", "above_limit=allow"])]
)
def test_explicit_looks_for_its_limits_once(tmp_path, capfd, monkeypatch, command, options):
    models, limits_of = [], explicit.step_limits
    monkeypatch.setattr(explicit, "step_limits", lambda model: models.append(model) or limits_of(model))
    output = ["-o", tmp_path / "out.usdc", "--frames", 1] if command == "run" else []
    code, out, err = run(capfd, command, *SMALL, "--solver", "explicit", "--json", *options, *output)
    assert (code, err) == (0, "")
    assert len(models) == 1
    facts = json.loads(out)
    shown = facts["options"] if command == "run" else facts["solver"]["options"]
    assert shown["above_limit"] == ("allow" if "above_limit=allow" in options else "refuse")


@pytest.mark.parametrize(
    ("solver", "substeps", "hint"), [("explicit", 1001, True), ("explicit", 1000, False), ("pbd", 1001, False)]
)
@pytest.mark.parametrize("command", ["run", "info"])
def test_very_many_explicit_substeps_give_a_hint(tmp_path, capfd, command, solver, substeps, hint):
    output = ["-o", tmp_path / "out.usdc", "--frames", 1] if command == "run" else []
    code, _, err = run(capfd, command, *SMALL, "--solver", solver, "-s", f"substeps={substeps}", *output)
    expected = "warpcloth: hint: explicit takes 1,001 substeps a frame here; --solver newton may suit better\n"
    assert (code, err) == (0, expected if hint else "")


def test_an_output_that_is_a_link_is_written_where_it_points_to(tmp_path, capfd):
    (tmp_path / "shelf").mkdir()
    link = tmp_path / "link.usdc"
    link.symlink_to("shelf/real.usdc")
    code, out, err = run(capfd, "run", *SMALL, "--frames", 1, "--json", "-o", link)
    assert (code, err) == (0, "") and link.is_symlink()
    assert os.path.realpath(json.loads(out)["frames_folder"]) == os.path.realpath(tmp_path / "shelf" / "real_frames")
    assert sorted(os.listdir(tmp_path / "shelf")) == ["real.usdc", "real_frames"]
    assert len(FrameSequence(link)) == 2


CLOSES = ["sys.stdout.close()", "sys.stderr.close()", "os.close(1)", "os.close(2)", "os.closerange(1, 3)"]


@pytest.mark.parametrize("closes", [*CLOSES, "sys.stdout.detach()", "sys.stderr.detach()"])
@pytest.mark.parametrize("ends", ["", "raise ValueError", "sys.exit(0)"])
def test_a_module_that_closes_the_output_ends_with_a_sentence(tmp_path, closes, ends):
    (tmp_path / "closes.py").write_text(f"import os, sys\n{closes}\n{ends}\n")
    command = [sys.executable, "-m", "warpcloth", "scenes", "--import", str(tmp_path / "closes.py")]
    done = subprocess.run(command, capture_output=True, text=True)
    *before, line = done.stderr.splitlines()
    assert line == "warpcloth: a scene or a module closed the standard output or error; it must leave them open"
    assert done.returncode == 2 and all("cannot be imported" in each for each in before)


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
@pytest.mark.parametrize(
    "text",
    [
        "sys.{0} = io.TextIOWrapper(sys.{0}.buffer, encoding='utf-8')",
        "sys.{0} = io.TextIOWrapper(sys.{0}.detach(), encoding='utf-8')",
        "sys.{0} = type('Copy', (), dict(write=lambda self, text: sys.__{0}__.write(text), flush=lambda self: None))()",
    ],
    ids=["buffer", "detached", "own class"],
)
def test_a_module_may_put_another_stream_in_the_place_of_one(tmp_path, text, stream):
    (tmp_path / "puts.py").write_text(f"import io, sys\n{text.format(stream)}\n")
    command = [sys.executable, "-m", "warpcloth", "fabrics", "--import", str(tmp_path / "puts.py")]
    done = subprocess.run(command, capture_output=True, text=True, encoding="utf-8")
    assert (done.returncode, done.stderr) == (0, "") and "denim" in done.stdout


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a shell of POSIX")
@pytest.mark.parametrize("without", [">&-", "2>&-", "<&- >&- 2>&-"])
@pytest.mark.parametrize(("command", "code"), [("scenes", 0), ("run hanging --frames 1 -o a.usdc", 0), ("run nothing", 2)])
def test_a_command_runs_without_standard_streams(tmp_path, command, code, without):
    line = f"{shlex.quote(sys.executable)} -m warpcloth {command} {without}"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(line, shell=True, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == code and "Error" not in done.stderr


@pytest.mark.parametrize("command", [("run", "-o", "out.usda"), ("info",), ("bench",)])
def test_warnings_are_shown_once_and_those_of_libraries_never(tmp_path, capfd, monkeypatch, command):
    """A stage is read for the scene and again below its animation. NumPy warns of arrays that have nothing but NaN."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cloth.usda").write_text(re.sub(r"point3f\[\] points = .*", "", STAGE))
    (tmp_path / "warns.py").write_text(
        "import numpy as np\nfrom warpcloth.usd import read_scene\n\ndef scene():\n"
        "    np.nanmax([np.nan]), np.log(0.0), np.nanmean([])\n"
        "    return read_scene('cloth.usda')\n"
    )
    name, *more = command
    for source in ("cloth.usda", "warns.py"):
        code, _, err = run(capfd, name, source, *more, *(["--frames", "1"] if name != "info" else []))
        assert code == 0 and err.count("no default value") == err.count("warning") == 1


@pytest.mark.parametrize(
    "options",
    [
        ["--solver", "pbd", "-s", "sweep=jacobi", "relaxation=1.9", "iterations=1"],
        ["--solver", "explicit", "-s", "above_limit=allow", "substeps=11"],
    ],
    ids=["pbd", "explicit"],
)
@pytest.mark.parametrize("ending", ["usdc", "usdz"])
def test_a_diverged_run_exits_with_1_and_leaves_its_good_frames(tmp_path, capfd, options, ending):
    output = tmp_path / f"out.{ending}"
    code, out, err = run(capfd, "run", "hanging", "-p", "n=8", *options, "--json", "-o", output)
    facts = json.loads(out)
    assert code == 1
    assert facts["status"] == "diverged" and facts["frames"] < facts["frames_asked"]
    assert err.startswith(f"warpcloth: diverged in frame {facts['frames'] + 1}: ") and err.count("\n") == 1
    assert err.endswith(f"; the last good frame is {facts['frames']}, in {output}\n")
    points = np.asarray(FrameSequence(output))
    assert len(points) == facts["frames"] + 1
    assert np.isfinite(points).all()


def test_a_run_that_is_not_usable_exits_with_1_and_keeps_its_frames_and_picture(tmp_path, capfd):
    """One step and sweep a frame leave vertices farther from the solution than half an edge of 67 mm."""
    output, film = tmp_path / "out.usdc", tmp_path / "out.png"
    options = ["--solver", "xpbd", "-s", "substeps=1", "iterations=1", "--frames", 10, "--film", film]
    code, out, err = run(capfd, "run", "hanging", "-p", "n=16", *options, "--json", "-o", output)
    facts = json.loads(out)
    assert (code, facts["grade"], facts["usable"], facts["status"]) == (1, "not usable", False, "completed")
    assert facts["frames"] == facts["frames_asked"] == 10 and facts["distance"] > 0.5 / 15
    assert err == f"warpcloth: {facts['message']}; all 10 frames are in {output}\n"
    assert re.match("not usable: in frame [0-9]+ cloth has .* J of motion, height and stored energy", facts["message"])
    assert len(FrameSequence(output)) == 11 and np.isfinite(np.asarray(FrameSequence(output))).all()
    assert film.stat().st_size and facts["film"] == str(film)


def test_an_interrupted_run_exits_with_130_and_says_what_is_saved(tmp_path, capfd, monkeypatch):
    class Interrupting(warpcloth.cli.run.Progress):
        def __call__(self, frame, frames):
            super().__call__(frame, frames)
            if frame == 2:
                raise KeyboardInterrupt

    monkeypatch.setattr(warpcloth.cli.run, "Progress", Interrupting)
    output = tmp_path / "out.usdc"
    code, out, err = run(capfd, "run", *SMALL, "-o", output)
    assert (code, out) == (130, "")
    assert err == f"warpcloth: interrupted after frame 2 of 60; frames 0 to 2 are in {output}\n"
    assert len(FrameSequence(output)) == 3


def test_parameters_change_the_scene(folder, capfd):
    argv = ["info", folder / "good.py", "--json", "-p", "n=6", "size=3/2", "sag=yes", "label=a/b", "fps=30"]
    code, out, _ = run(capfd, *argv)
    facts = json.loads(out)
    assert code == 0
    assert facts["scene"]["parameters"] == {"n": 6, "size": 1.5, "sag": True, "label": "a/b", "fps": 30.0, "hole": []}
    assert facts["scene"]["vertices"] == 36 and facts["scene"]["pins"] == 0 and facts["scene"]["name"] == "a/b"
    assert facts["scene"]["mass"] == pytest.approx(0.1 * 1.5**2)
    assert facts["model"]["terms"][0]["elements"] == 60 and facts["model"]["kernels"] == []


def test_info_prints_the_scene_and_what_a_solver_asks_for(capfd):
    code, out, _ = run(capfd, "info", *SMALL)
    assert code == 0
    assert "hanging: 25 vertices" in out and "parameters: n=5" in out and "QuadraticBending: " in out
    assert "kernels" not in out
    code, out, _ = run(capfd, "info", *SMALL, "-s", "dt=1/120", "--dtype", "float64")
    assert code == 0
    assert "float64" in out and "solver: newton(dt=0.0083" in out and "step 1/120 s" in out and "kernels: " in out


def test_scenes_lists_parameters_without_running_anything(folder, capfd):
    code, out, err = run(capfd, "scenes")
    assert (code, err) == (0, "")
    assert "\n  hanging\n      A square cloth of 1 m" in out and "n=32, stiffness=1000.0" in out
    code, out, err = run(capfd, "scenes", folder)
    assert (code, err) == (0, "")
    assert "  good\n      A small sheet.\n      n=4, size=1.0, sag=False, label='sheet', fps=60.0, hole=()\n" in out
    assert "  imports" not in out and "  nothing" not in out
    assert "  syntax\n      cannot be read: " in out


def test_a_changed_scene_file_is_loaded_again(tmp_path, capfd):
    path = tmp_path / "os.py"  # the name of a module that is in use
    for count in (3, 12):
        text = f"import warpcloth as wc\ndef scene():\n    return wc.Scene(wc.Mesh.grid({count}, {count}), density=1.0)\n"
        path.write_text(text)
        code, out, _ = run(capfd, "info", path, "--json")
        assert code == 0 and json.loads(out)["scene"]["vertices"] == count**2


def test_no_command_and_help(capfd):
    code, out, err = run(capfd)
    assert (code, out) == (2, "") and "usage: warpcloth" in err
    code, out, err = run(capfd, "run", "--help")
    assert (code, err) == (0, "") and "1/240 s" in out
    assert out.count("\n  warpcloth run ") == 2
    code, out, err = run(capfd, "--help")
    assert (code, err) == (0, "")
    listed = re.findall(r"^  (\w+) +[A-Z]", out.partition("\nmake:\n")[2], re.MULTILINE)  # each command once, in a group
    (commands,) = (action.choices for action in _parser()._actions if isinstance(action.choices, dict))
    assert sorted(listed) == sorted(commands)
    code, out, _ = run(capfd, "--version")
    assert code == 0 and out.startswith("warpcloth ")


@pytest.mark.parametrize(
    ("text", "kinds", "value"),
    [
        ("1/240", (float, type(None)), 1 / 240),
        ("None", (float, type(None)), None),
        ("inf", (float,), math.inf),
        ("1e3", (int,), 1000),
        ("123456789012345678901", (int,), 123456789012345678901),
        ("-7", (int,), -7),
        ("off", (bool,), False),
        ("3", (int, float, str), 3),
        ("0.5", (int, float, str), 0.5),
        ("/World/Cloth", (int, float, str, type(None)), "/World/Cloth"),
    ],
)
def test_texts_become_values(text, kinds, value):
    found = convert("x", text, kinds)
    assert found == value and type(found) is type(value)


def start(*argv, **options):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    argv = [sys.executable, "-m", "warpcloth.cli", *map(str, argv)]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    return subprocess.Popen(argv, env=environment, text=True, **options)


def test_a_process_prints_nothing_but_its_json_and_its_line(tmp_path):
    process = start("run", *SMALL, "--frames", 2, "--json", "-o", "out.usdc", cwd=tmp_path)
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0
    assert err == ""
    assert json.loads(out)["file"] == "out.usdc"
    process = start("run", *SMALL, "--device", "cuda:99", "-o", "out.usdc", cwd=tmp_path)
    out, err = process.communicate(timeout=600)
    assert (process.returncode, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("warpcloth: device is 'cuda:99'")


def test_a_reader_that_has_gone_changes_nothing(tmp_path, capfd, monkeypatch):
    """Output that ``head`` cuts gives no message, and the exit code is that of the command."""
    monkeypatch.chdir(tmp_path)
    diverged = ["run", *SMALL, "--solver", "pbd", "-s", "sweep=jacobi", "relaxation=1.9", "iterations=1", "-o", "a.usdc"]
    for argv, code in ((["scenes"], 0), (["info", *SMALL], 0), (diverged, 1)):
        read, write = os.pipe()
        os.close(read)
        with open(write, "w") as stream:  # whose end flushes what is left, as the end of a process does
            monkeypatch.setattr(sys, "stdout", stream)
            assert main(argv) == code
        assert capfd.readouterr().err.count("\n") == code  # the line that says how it diverged


@pytest.mark.slow
def test_the_progress_bar_shows_on_a_terminal(tmp_path):
    pty = pytest.importorskip("pty")
    ours, theirs = pty.openpty()
    process = start("run", *SMALL, "--frames", 200, "--json", "-o", "out.usdc", cwd=tmp_path, stderr=theirs)
    os.close(theirs)
    shown = b""
    with contextlib.suppress(OSError):  # what Linux says when the other side has closed
        while chunk := os.read(ours, 4096):
            shown += chunk
    os.close(ours)
    out, _ = process.communicate(timeout=600)
    assert process.returncode == 0 and json.loads(out)["frames"] == 200
    states = shown.decode().split("\r")
    assert states[1].startswith("compiling:   0%|") and states[2].startswith("running:   0%|")
    assert any(" of 200 frames, 0.0" in state and " s each, 00:0" in state for state in states)


def test_a_progress_bar_that_the_environment_disables_takes_all_calls(monkeypatch):
    tqdm = pytest.importorskip("tqdm")
    monkeypatch.setattr(tqdm, "tqdm", partial(tqdm.tqdm, disable=True))  # as TQDM_DISABLE=1 does
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    progress = warpcloth.cli.terminal.Progress(frames=3)
    for frame in range(1, 4):
        progress(frame, 3)
    progress.close()


@pytest.mark.slow
def test_a_process_that_is_interrupted_leaves_a_file_that_opens(tmp_path):
    output = tmp_path / "out.usdc"
    process = start("run", "hanging", "--frames", 100_000, "-o", output)
    end = time.monotonic() + 600.0
    while not output.exists() and time.monotonic() < end:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=600)
    assert (process.returncode, out) == (130, "")
    assert "interrupted after frame " in err and err.count("\n") == 1
    saved = int(err.split("frames 0 to ")[1].split()[0])
    assert abs(len(FrameSequence(output)) - 1 - saved) <= 1  # a frame may be kept and not yet counted


def interrupt_in(monkeypatch, target, attribute, number, call=1, times=1):
    """Raises a signal where a function is called for the given time, so many times."""
    real, calls = getattr(target, attribute), []

    def interrupting(*args, **kwargs):
        calls.append(args)
        if len(calls) == call:
            for _ in range(times):
                signal.raise_signal(number)
        return real(*args, **kwargs)

    monkeypatch.setattr(target, attribute, interrupting)


# Where an interrupt comes, as (what is called then, the how many-th call), and the frames that there are then of 25.
MOMENTS = {
    "a chunk": (chunks.ChunkWriter, "_write_pending", 2, 20),
    "its root": (chunks.ChunkWriter, "_write_root", 2, 20),
    "the last chunk": (chunks.ChunkWriter, "_write_pending", 3, 25),
    "the source": (chunks.ChunkWriter, "_check_source", 1, 25),
    "one file": (chunks.ChunkWriter, "_copy_frames", 1, 25),
    "removing": (chunks.ChunkWriter, "_remove", 1, 25),
    "the summary": (warpcloth.cli.run, "_summary", 1, 25),
}


@pytest.mark.parametrize(
    ("number", "code"),
    slow_but([(signal.SIGINT, 130)], [(signal.SIGINT, 130), (signal.SIGTERM, 143)]),
    ids=["ctrl-c", "sigterm"],
)
@pytest.mark.parametrize("ending", ["usdc", "usdz"])
@pytest.mark.parametrize("moment", MOMENTS)
def test_an_interrupt_finishes_the_file_and_says_what_is_in_it(moment, ending, number, code, tmp_path, capfd, monkeypatch):
    target, attribute, call, frames = MOMENTS[moment]
    output = tmp_path / f"out.{ending}"
    interrupt_in(monkeypatch, target, attribute, number, call)
    found = run(capfd, "run", *SMALL, "--frames", 24, "--single-file", "-o", output)
    last = f"frame {frames - 1} of 24" if moment != "the summary" else "frame 24, the last one"
    assert found == (code, "", f"warpcloth: interrupted after {last}; frames 0 to {frames - 1} are in {output}\n")
    assert len(FrameSequence(output)) == frames
    assert set(tmp_path.iterdir()) == ({output} if frames == 25 else {output, tmp_path / "out_frames"})  # to be resumed
    assert len(list(tmp_path.rglob("checkpoint.npz"))) == (frames < 25)
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


@pytest.mark.parametrize("ending", ["usdc", "usdz"])
@pytest.mark.parametrize("moment", ["its root", "the last chunk", "one file", "removing"])
def test_a_second_interrupt_comes_at_once_and_loses_nothing(moment, ending, tmp_path, capfd, monkeypatch):
    """The file in the message has the frames that it names, and stays when the same command runs again."""
    target, attribute, call, _ = MOMENTS[moment]
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patched:
        interrupt_in(patched, target, attribute, signal.SIGINT, call, times=2)
        code, out, err = run(capfd, "run", *SMALL, "--frames", 24, "--single-file", "-o", f"out.{ending}")
    assert (code, out, err.count("\n")) == (130, "", 1)
    last, path = re.search(r"; frames 0 to (\d+) are in ([^ ,\n]+)", err).groups()
    before = np.asarray(FrameSequence(path))
    assert len(before) == int(last) + 1 >= (25 if moment in ("one file", "removing") else 10)
    assert ("was not made" in err) == (path != f"out.{ending}")
    code, _, err = run(capfd, "run", *SMALL, "--frames", 3, "-o", f"out.{ending}")
    assert code == 0 and len(FrameSequence(f"out.{ending}")) == 4
    complete = path != f"out.{ending}" and int(last) == 24
    assert ("has all frames of an earlier run that was not packed, and is kept" in err) == complete
    if complete:
        np.testing.assert_array_equal(FrameSequence(path), before)


def test_interrupts_in_the_frames_before_and_after_them(tmp_path, capfd, monkeypatch):
    """Before the first frame nothing is left; in frames one ends the run and a second one leaves it in chunks."""
    output, watch = tmp_path / "out.usdz", importlib.import_module("warpcloth.run.watch").Watch
    with monkeypatch.context() as patched:
        interrupt_in(patched, watch, "__init__", signal.SIGINT)
        found = run(capfd, "run", *SMALL, "-o", output)
    assert found == (130, "", "warpcloth: interrupted before the first frame; nothing was saved\n")
    assert list(tmp_path.iterdir()) == []
    with monkeypatch.context() as patched:
        interrupt_in(patched, watch, "passes", signal.SIGTERM, call=13)
        interrupt_in(patched, chunks.Contents, "write", signal.SIGINT)
        code, _, err = run(capfd, "run", *SMALL, "-o", output)
    assert code == 130 and "after frame 12 of 60; frames 0 to 12 are in " in err and err.endswith(" was not made\n")
    assert len(FrameSequence(re.search(r"are in (\S+),", err)[1])) == 13


# Begins an import, and comes in the middle of it.
SITE = """
import os, signal, sys

class Finder:
    def find_spec(self, name, *_):
        if name == "{}":
            os.kill(os.getpid(), signal.{})

sys.meta_path.insert(0, Finder())
"""


@pytest.mark.parametrize(
    ("module", "how", "name", "more"),
    [
        pytest.param("warpcloth.numerics.rotation", ["-m", "warpcloth"], "SIGINT", "", marks=pytest.mark.slow),
        pytest.param("warpcloth.numerics.rotation", ["-m", "warpcloth.cli"], "SIGTERM", "", marks=pytest.mark.slow),
        pytest.param("warpcloth.numerics.rotation", ["warpcloth"], "SIGINT", "", marks=pytest.mark.slow),
        ("warpcloth.numerics.rotation", ["warpcloth"], "SIGTERM", ""),
        ("pxr.UsdGeom", ["-m", "warpcloth"], "SIGINT", " before the first frame; nothing was saved"),
    ],
)
def test_an_interrupt_while_modules_load_is_one_line(module, how, name, more, tmp_path):
    """The modules of pxr are loaded when a stage is first written or read."""
    (tmp_path / "sitecustomize.py").write_text(SITE.format(module, name))
    (tmp_path / "warpcloth").write_text("import sys\nfrom warpcloth.cli import main\nsys.exit(main())\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    argv = [sys.executable, *how, "run", *SMALL, "-o", "out.usdc"]
    found = subprocess.run(argv, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert (found.returncode, found.stdout) == (128 + getattr(signal, name), "")
    assert found.stderr == f"warpcloth: interrupted{more}\n"


def test_an_interrupt_that_python_makes_another_error_of_is_one(capfd, monkeypatch):
    class Field:
        def __set_name__(self, *_):
            raise KeyboardInterrupt

    monkeypatch.setattr(warpcloth.cli.scenes, "folders", lambda: type("New", (), {"field": Field()}))
    assert run(capfd, "scenes") == (130, "", "warpcloth: interrupted\n")


def test_an_output_that_another_process_writes_is_refused(tmp_path, capfd):
    """The refusal is one line and comes at once; the lock file of a process that is gone does not lock."""
    output, left = tmp_path / "out.usdc", tmp_path / ".out.usdc.lock"
    left.write_text("process 1 on nowhere")
    assert run(capfd, "run", *SMALL, "--frames", 2, "-o", output)[0] == 0
    assert not left.exists() and len(FrameSequence(output)) == 3
    lock = Lock(output)
    try:
        refused(capfd, ["run", *SMALL, "-o", output], f"is being written by process {os.getpid()} on {socket.gethostname()}")
        refused(capfd, ["deform", "bar_twist", "-o", output], "wait until it ends, or give another output")
    finally:
        lock.release()
    assert len(FrameSequence(output)) == 3 and not left.exists()
