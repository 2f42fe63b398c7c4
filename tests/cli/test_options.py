"""Tests help that the command line itself gives: lists of options, completion, and default names of files."""

import json
import os
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from support.stage_texts import prim
from warpcloth.cli import main
from warpcloth.run import scene_files
from warpcloth.solvers import SOLVERS
from warpcloth.usd import FrameSequence

ROOT = Path(__file__).parents[2]
CLOTH = """int[] faceVertexCounts = [3, 3]
int[] faceVertexIndices = [0, 2, 1, 1, 2, 3]
double warpcloth:density = 0.15
token warpcloth:terms:threads:type = "Spring"
double warpcloth:terms:threads:stiffness = 1000
token warpcloth:terms:threads:pairs = "edges"
double warpcloth:duration = 0.125"""
POINTS = [f"point3f[] points = [({x}, 0, 0), ({x + 1}, 0, 0), ({x}, 0, 1), ({x + 1}, 0, 1)]" for x in (0, 3)]
SHEETS = [prim("Mesh", name, CLOTH, points) for name, points in zip(("Left", "Right"), POINTS, strict=True)]
HEAD = '#usda 1.0\n(\n    defaultPrim = "World"\n    metersPerUnit = 1\n    upAxis = "Y"\n)\n'
TWO = HEAD + prim("Xform", "World", *SHEETS)


def listed(capfd, *argv):
    """Rows by name that a list as JSON has."""
    assert main([*argv, "--json"]) == 0
    (found,) = json.loads(capfd.readouterr().out).values()
    return {row["name"]: row for row in found["rows"]}


@pytest.mark.parametrize("name", SOLVERS)
def test_options_are_listed_from_the_record(name, capfd):
    record, rows = SOLVERS[name], listed(capfd, "run", "hanging", "--solver", name, "-s", "help")
    assert list(rows) == [field.name for field in fields(record)]
    for field in fields(record):
        row = rows[field.name]
        assert row["default"] == field.default
        if row["allowed"].startswith("one of "):  # each word is taken, and the default is one of them
            words = row["allowed"].removeprefix("one of ").split(", ")
            assert field.default in words
            for word in words:
                record(substeps=1, **{field.name: word})
        else:
            assert "number" in row["allowed"] and (not isinstance(field.default, str) or field.default in row["allowed"])
            for text in ("0", "0.5", "-1", "nan"):  # what the rule excludes is refused
                allowed = "above 0" not in row["allowed"] or text == "0.5"
                allowed = allowed and ("whole" not in row["allowed"] or (text == "0" and " 0 or more" in row["allowed"]))
                if not allowed:
                    step = {} if field.name in record.step_options else {"substeps": 1}
                    with pytest.raises(ValueError, match=field.name):
                        record(**step, **{field.name: float(text)})


def test_parameters_are_listed_of_a_known_scene_a_file_and_a_stage(tmp_path, capfd):
    assert listed(capfd, "run", "net", "-p", "help")["kind"]["allowed"] == "one of structural, shear, bending"
    n = {"name": "n", "default": 32, "needed": False, "allowed": "a whole number"}
    assert listed(capfd, "info", "hanging", "-p", "help")["n"] == n
    (tmp_path / "needs.py").write_text("def scene(n: int, flat: bool = False):\n    return n\n", encoding="utf-8")
    assert main(["run", str(tmp_path / "needs.py"), "-p", "help"]) == 0
    lines = [line.split() for line in capfd.readouterr().out.splitlines()]
    assert lines[1:] == [["n", "needed", "a", "whole", "number"], ["flat", "False", "true", "or", "false"]]
    (tmp_path / "two.usda").write_text(TWO, encoding="utf-8")
    assert listed(capfd, "run", str(tmp_path / "two.usda"), "-p", "help")["prim"]["allowed"] == "a text, or none"
    (tmp_path / "none.py").write_text("def scene():\n    return 3\n", encoding="utf-8")
    assert main(["choose", str(tmp_path / "none.py"), "-p", "help"]) == 0
    assert "it has none" in capfd.readouterr().out


def test_both_lists_at_once_and_no_run(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", "hanging", "--solver", "pbd", "-s", "help", "-p", "help"]) == 0
    out = capfd.readouterr().out
    assert "-s of pbd: Position based dynamics" in out and "give dt (the step [s]) or substeps" in out and "-p of " in out
    assert not list(tmp_path.iterdir())


def test_a_run_without_output_writes_the_name_of_the_scene_and_replaces_nothing(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["run", "hanging", "-p", "n=4", "--frames", "1"]
    assert main(command) == 0 and "file          hanging.usdc" in capfd.readouterr().out
    written = (tmp_path / "hanging.usdc").read_bytes()
    assert main(command) == 2
    assert capfd.readouterr().err == (
        "warpcloth: hanging.usdc exists already, and without -o nothing is replaced; give -o hanging.usdc to replace it\n"
    )
    assert (tmp_path / "hanging.usdc").read_bytes() == written
    assert main([*command, "-o", "hanging.usdc"]) == 0
    (tmp_path / "hanging.usdc").unlink()
    assert main([*command, "-o", ""]) == 2  # of a variable of a shell that is not set
    assert "must end with one of" in capfd.readouterr().err and not (tmp_path / "hanging.usdc").exists()


def test_a_prim_is_named_by_an_option(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "two.usda").write_text(TWO, encoding="utf-8")
    assert main(["info", "two.usda"]) == 0  # both meshes, as one scene
    both = capfd.readouterr().out
    assert "Left" in both and "Right" in both
    assert main(["run", "two.usda", "--prim", "Right", "--frames", "2", "--json"]) == 0
    facts = json.loads(capfd.readouterr().out)
    assert (facts["parameters"], facts["file"]) == ({"prim": "Right", "law": "proposal", "fabric": None}, "Right.usdc")
    assert FrameSequence("Right.usdc")[0][:, 0].tolist() == [3.0, 4.0, 3.0, 4.0]
    assert main(["info", "two.usda", "--prim", "/World/Left"]) == 0
    assert main(["info", "two.usda", "--prim", "Left", "-p", "prim=Right"]) == 2
    assert "prim is given twice" in capfd.readouterr().err


def test_pins_replace_those_of_the_scene_and_stand_still(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", "flag", "-p", "nx=5", "ny=4", "--pins", "corners", "--frames", "3"]) == 0
    scene = scene_files.find_source("flag").scene({"nx": 5, "ny": 4})
    corners, points = scene.mesh.corners(), FrameSequence("flag.usdc")
    # The upright flag starts elsewhere than at rest, and its pole would move.
    np.testing.assert_allclose(points[0], scene.positions, atol=1e-6)
    assert np.array_equal(points[3][corners], points[0][corners])
    moved = np.abs(points[3] - points[0]).max(axis=1) > 0.0
    assert sorted(np.flatnonzero(~moved)) == sorted(corners)
    assert main(["info", "flag", "-p", "nx=5", "ny=4", "--pins", "corners", "--json"]) == 0
    capfd.readouterr()
    (tmp_path / "two.usda").write_text(TWO, encoding="utf-8")
    assert main(["run", "two.usda", "--prim", "Left", "--pins", "x == 0", "--frames", "2", "-o", "left.usda"]) == 0
    assert np.array_equal(FrameSequence("left.usda")[2][[0, 2]], FrameSequence("left.usda")[0][[0, 2]])


def test_a_choice_is_made_for_the_pins_that_are_run(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path / "cache"))
    from warpcloth.lab import choosing as choose

    seen = []

    def refuse(ref, *_, **__):
        seen.append(ref.load().pins.vertices.tolist())
        raise ValueError("seen")

    monkeypatch.setattr(choose, "choose", refuse)
    assert main(["run", "hanging", "-p", "n=3", "--pins", "z == 0", "--tolerance", "1%"]) == 2
    assert "seen" in capfd.readouterr().err and seen == [[0, 1, 2]]


COMPLETIONS = [
    ("deform bar", ["bar_twist"]),
    ("run hanging --solver xpbd -s substeps=4 sweep=", ["coloured", "sequential", "constraint-averaged"]),
    ("chart work-precision net -p kind=s", ["structural", "shear"]),
    ("run hanging --import mod", ["module.py"]),
    ("run hanging --import module.py --solver hier", ["hierarchical-pbd"]),
    ("run hanging --import gone.py --solver hier", ["hierarchical-pbd"]),
]


@pytest.mark.parametrize(("line", "words"), COMPLETIONS, ids=[line for line, _ in COMPLETIONS])
def test_a_shell_completes(line, words, tmp_path):
    line = f"warpcloth {line}"
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9", "_ARGCOMPLETE_IFS": "\n"}
    asked |= {"_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "words"), "_ARGCOMPLETE_COMP_WORDBREAKS": " \t\n\"'><=;|&(:"}
    (tmp_path / "module.py").touch()
    environment = os.environ | asked | {"PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-m", "warpcloth"], env=environment, cwd=tmp_path, capture_output=True, check=True)
    assert (tmp_path / "words").read_text(encoding="utf-8").split() == words
