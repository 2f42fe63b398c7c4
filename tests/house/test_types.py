"""Types of the public API: all of it is annotated, the package passes mypy, and mypy finds a wrong argument of a user."""

import inspect
import re
import subprocess
import sys
from dataclasses import is_dataclass
from pathlib import Path

import pytest

import warpcloth as wc
from support.outside import write_files
from warpcloth import usd

ROOT = Path(__file__).parents[2]
RIGHT = """
from dataclasses import replace

import numpy as np

import warpcloth as wc
from warpcloth import usd

mesh = wc.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
terms = [wc.Spring(stiffness=1e3), wc.QuadraticBending(stiffness=1e-5)]
scene = wc.Scene(wc.Mesh.grid(3, 3), density=0.1, terms=terms, pins="corners", gravity=(0, 0, -9.81))
moved = replace(scene, pins=wc.Pins([0, 1], keyframes=np.zeros((2, 2, 3))), gravity=[0, 0, 1])
first: np.int32 = scene.pins.vertices[0]
weight = scene.gravity @ scene.gravity
where = None if scene.stage is None else scene.stage.prim
animation = wc.simulate(scene, wc.Newton(dt=1 / 240), output="out.usdc", frames=3)
highest = animation.points[-1].max()
finished: bool = animation.status.ok
stepper = wc.PBD(substeps=3, sweep="jacobi").bind(scene.build(copies=2, vary={"Spring.stiffness": [1.0, 2.0]}))
stepper.step()
rest = wc.equilibrium(scene).points.max()
stretches = wc.analyze(animation, scene.mesh, measures="stretch")["stretch"].max()
for sample in wc.Analyzer("out.usdc", measures=("stretch",)):
    largest = sample.values["stretch"].max()
apart = wc.compare("out.usdc", (scene.mesh, animation)).surface_mean.max()
turned = wc.deform(scene.mesh, wc.Pins([0], np.zeros((2, 1, 3)))).largest_angles.max()
solved = wc.Arap(mesh, [0]).solve([[0.0, 0.0, 1.0]]).points.max()
R = wc.kabsch(mesh.points, mesh.points) @ np.eye(3)
frame = wc.open_sequence("out.usdc")[0].max()
film = wc.render(animation, "out.gif", size=(64, 36), colour="stretch_1", frames=(0, 3)).upper()
name = usd.write_scene(usd.read_scene("in.usda"), "out.usda").upper()
"""
# Every line is wrong by itself.
WRONG = """
wc.simulate(scene, wc.Newton(dt="small"))
wc.simulate(scene.mesh, wc.Newton(dt=1 / 240))
wc.simulate(scene, wc.Newton(dt=1 / 240), dtype="float16")
wc.Mesh.grid("3", 3)
wc.Mesh.grid(3, 3, pattern="hexagonal")
wc.Scene(mesh, densty=1.0)
wc.Scene(mesh, density=1.0, terms=wc.Spring(stiffness=1.0))
wc.Spring(stiffness="stiff")
wc.PBD(substeps=2, stiffness="per-step")
wc.Pins([0], keyframes=0.5).vertices.nothing
wc.equilibrium(scene, linear="cholesky")
wc.render("out.usdc", "out.png", size=64)
scene.stage.prim
wc.Sceen
"""


def mypy(*arguments):
    command = [sys.executable, "-m", "mypy", "--config-file", str(ROOT / "pyproject.toml"), *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)


def calls():
    """Public functions, constructors and methods by name."""
    for module in (wc, usd):
        for name in module.__all__:
            found = getattr(module, name)
            if inspect.isfunction(found):
                yield name, found
            if inspect.isclass(found):
                for method, function in vars(found).items():
                    function = getattr(function, "__func__", getattr(function, "fget", getattr(function, "func", function)))
                    made = method == "__init__" and not is_dataclass(found)
                    if inspect.isfunction(function) and (method[0] != "_" or made):
                        yield f"{name}.{method}", function


def test_the_public_api_is_annotated():
    wrong = []
    for name, function in calls():
        signature = inspect.signature(function)
        annotations = {key: each.annotation for key, each in signature.parameters.items() if key not in ("self", "cls")}
        annotations["return"] = signature.return_annotation
        wrong += [f"{name}: {key}" for key, annotation in annotations.items() if annotation is inspect.Parameter.empty]
    assert not wrong


@pytest.mark.slow
def test_types_of_the_package_and_of_programs_agree(tmp_path):
    """In one run, in which only the wrong lines are errors."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8").partition("[tool.mypy]")[2]
    folders = re.findall(r'"([^"]+)"', re.search(r"^files = \[(.*)\]$", text, re.MULTILINE)[1])
    assert "warpcloth/run" in folders
    right, wrong = tmp_path / "right.py", tmp_path / "wrong.py"
    right.write_text(RIGHT)
    wrong.write_text(RIGHT + WRONG)
    write_files(tmp_path)
    programs = right, tmp_path / "descent.py", wrong
    checked = mypy("--cache-dir", tmp_path / "cache", "--no-error-summary", *folders, *programs)
    errors = [line for line in checked.stdout.splitlines() if ": error:" in line]
    lines = {int(line.split(":")[1]) for line in errors if line.startswith(f"{wrong}:")}
    others = [line for line in errors if not line.startswith(f"{wrong}:")]
    first = RIGHT.count("\n") + 2
    assert not others and checked.returncode == 1 and not checked.stderr, "\n".join(others) + checked.stderr
    assert lines == set(range(first, first + WRONG.count("\n") - 1)), checked.stdout
