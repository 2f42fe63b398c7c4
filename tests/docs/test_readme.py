"""What the README shows works as it stands there, and its tables name all that there is."""

import os
import re
import shlex
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import warpcloth as wc
from warpcloth.analysis.measures import MEASURES
from warpcloth.cli import _parser
from warpcloth.solvers import SOLVERS
from warpcloth.terms import TERMS

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(text):
    """(language, text) of each block."""
    return [(m[1], m[2]) for m in re.finditer(r"^```(\w+)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)]


# Text of each section that has a block, by heading, and of each file that is shown, by name.
BY_SECTION = dict(part.partition("\n")[::2] for part in re.split(r"^## ", README, flags=re.MULTILINE)[1:])
BY_SECTION = {heading: text for heading, text in BY_SECTION.items() if blocks(text)}
FILES = {m[1]: m[2] for m in re.finditer(r"`([\w.]+)`:\n\n```\w+\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)}
EXAMPLE, DEFORMATION, ANALYSIS, COPIES, ROTATIONS = (
    text for language, text in blocks(README) if language == "python" and text not in FILES.values()
)
COMMANDS = [
    line for language, text in blocks(README) if language == "sh" for line in text.splitlines() if line[:9] == "warpcloth"
]
# Packages by extra.
OPTIONAL = (ROOT / "pyproject.toml").read_text(encoding="utf-8").partition("[project.optional-dependencies]")[2]
EXTRAS = {
    name: re.findall(r'"(\w+)', packages)
    for name, packages in re.findall(r"^(\w+) = \[(.*)\]$", OPTIONAL.partition("\n[")[0], re.MULTILINE)
}


def test_the_python_example(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(EXAMPLE, "README.md", "exec"), names)
    animation = names["animation"]
    assert animation.status.ok and len(animation.points) == 61 and (tmp_path / "hanging.usdc").is_file()
    assert "converged" in capsys.readouterr().out
    assert np.asarray(animation.points[-1]).shape == (1024, 3)


def test_the_deformation(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    exec(compile(DEFORMATION, "README.md", "exec"), {})
    converged, angle = capsys.readouterr().out.splitlines()[-2:]
    assert converged.startswith("True ") and np.radians(115.0) < float(angle) < np.radians(125.0)
    assert (tmp_path / "twisted.usdc").is_file()


def test_the_analysis(capsys):
    names = {}
    exec(compile(ANALYSIS, "README.md", "exec"), names)
    measured, around = names["measured"], names["around"]
    np.testing.assert_array_equal(names["rolled"][0], names["mesh"].points)
    np.testing.assert_allclose(measured["stretch"][-1, :, 0], 1.15, rtol=1e-12)
    # A chord is shorter than its arc, by (κ/19)²/24.
    np.testing.assert_allclose(measured["stretch"][-1, :, 1], 1.0, atol=(1.5 / 19) ** 2 / 24 * 1.01)
    assert measured["rate_of_strain"].shape == (25, 722, 3, 3) and around["residual"].shape == (25, 400)
    assert "frame 0 has none before it" in capsys.readouterr().out


def test_the_copies(capsys):
    exec(compile(COPIES, "README.md", "exec"), {})
    assert int(capsys.readouterr().out.split()[-1]) == 2 * 64


def test_every_measure_is_in_the_docs():
    text = (ROOT / "docs" / "measuring.md").read_text(encoding="utf-8")
    for on, part in zip(MEASURES.values(), re.split(r"^## Of vertices", text, flags=re.MULTILINE), strict=True):
        rates = text[text.index("## Rates") :]
        for measure in on.values():
            row = re.search(rf"^\| `{measure.name}` \| (.*?) \| (.*?) \|", rates if measure.rate else part, re.MULTILINE)
            assert row, measure.name
            assert row[1] == ("×".join(map(str, measure.shape)) or "–") and row[2] == measure.unit, measure.name


def test_the_rotations():
    names = {}
    exec(compile(ROTATIONS, "README.md", "exec"), names)
    assert np.abs(names["turned"] - names["R"][0]).max() < 1e-5
    assert np.abs(names["R"] @ names["P"] - names["A"]).max() < 1e-5


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_is_one(command):
    assert _parser().parse_args(shlex.split(command, comments=True)[1:]).command


@pytest.mark.parametrize("path", [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))], ids=str)
def test_what_is_to_be_installed_is_there(path):
    """Extras are installed from a checkout, because warpcloth is on no index."""
    text = path.read_text(encoding="utf-8")
    assert "warpcloth[" not in text
    for given in re.findall(r"pip install ([^`&#\n]*)", text):
        assert (given.strip() == "-e .") or re.fullmatch(r"-e '\.\[(\w+)\]'", given.strip()), given
    assert set(re.findall(r"'\.\[(\w+)\]'", text)) <= set(EXTRAS)


def test_what_a_refusal_says_to_install_is_there():
    said = []
    for path in (ROOT / "warpcloth").rglob("*.py"):
        said += re.findall(r"pip install [^\n]*", path.read_text(encoding="utf-8"))
    assert len(said) > 3
    for line in said:
        assert re.match(r"pip install -e (['\"])\.\[(\w+)\]\1(``)? in the checkout", line)[2] in EXTRAS, line


# Read by Python as it starts: packages that are not installed are not found.
ABSENT = """
from importlib.machinery import PathFinder

find = PathFinder.find_spec
absent = {!r}
PathFinder.find_spec = lambda name, *more: None if name.partition(".")[0] in absent else find(name, *more)
"""
# Modules whose names differ from those of their packages.
MODULES = {"libigl": "igl", "pillow": "PIL"}
# The two commands are what .ci/run does, word for word; a cluster needs more than one machine, see test_cluster.
SECTIONS = [
    heading
    for heading, text in BY_SECTION.items()
    if heading not in ("Two commands", "On a cluster") and any(block not in FILES.values() for _, block in blocks(text))
]


@pytest.mark.slow
@pytest.mark.parametrize("heading", SECTIONS)
def test_a_section_as_it_stands(heading, tmp_path):
    """All of its blocks, one after the other in one folder with the files that the README names, each in a process of its own.

    What the README has not said to install up to the end of the section cannot be imported.
    """
    named = set(re.findall(r"'\.\[(\w+)\]'", README[: README.index(f"## {heading}\n")] + BY_SECTION[heading])) - {"test"}
    there = {package for extra in named for package in EXTRAS[extra]}
    absent = {package for extra in set(EXTRAS) - {"test"} for package in EXTRAS[extra]} - there
    tools, folder = tmp_path / "tools", tmp_path / "folder"
    tools.mkdir()
    folder.mkdir()
    (tools / "sitecustomize.py").write_text(ABSENT.format({MODULES.get(package, package) for package in absent}))
    command = tools / "warpcloth"
    command.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m warpcloth "$@"\n')
    command.chmod(0o755)
    for name, text in FILES.items():
        (folder / name).write_text(text, encoding="utf-8")
    environment = os.environ | {
        "PYTHONPATH": f"{tools}{os.pathsep}{ROOT}",
        "PATH": f"{tools}{os.pathsep}{os.environ['PATH']}",
        "WARPCLOTH_CACHE": str(tmp_path / "cache"),
    }
    for language, text in blocks(BY_SECTION[heading]):
        if text in FILES.values():
            continue
        run = {"python": [sys.executable, "-c", text], "sh": ["bash", "-ec", text]}[language]
        done = subprocess.run(run, cwd=folder, env=environment, capture_output=True, text=True)
        assert done.returncode == 0 and "Traceback" not in done.stderr, f"{text}\n{done.stdout}\n{done.stderr}"
    words = shlex.split(" ".join(text for language, text in blocks(BY_SECTION[heading]) if language == "sh"))
    for option, name in pairwise(words):
        if option in ("-o", "--csv", "--plot", "--npz", "--report"):
            assert (folder / name).is_file(), name


@pytest.mark.parametrize(
    ("head", "names"),
    [
        ("Term", set(TERMS)),
        ("Solver", {record.__name__ for record in SOLVERS.values()}),
        ("Scene", {path.stem for path in (ROOT / "scenes").glob("*.py")}),
    ],
)
def test_tables_are_whole(head, names):
    table = re.search(rf"^\| {head} \|.*?(?=\n\n)", README, re.MULTILINE | re.DOTALL)[0]
    assert set(re.findall(r"^\| `(\w+)`", table, re.MULTILINE)) == names


def test_the_table_of_residuals_is_that_of_the_solvers():
    methods = (ROOT / "docs" / "solvers.md").read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| `(\w+)` \| (.+) \| (.+) \| (.+) \| (.+) \|$", methods.split("## The residual of a run")[1], re.MULTILINE
    )
    found = {name: (measure, weightless, unit, held == "`tolerance`") for name, measure, unit, weightless, held in rows}
    solvers = {record.__name__: record for record in SOLVERS.values() if record.residual is not None}
    assert found == {name: (*record.residual, hasattr(record, "tolerance")) for name, record in solvers.items()}


def test_links_lead_somewhere():
    links = re.findall(r"\]\((?!https:)([^)]+)\)", README)
    assert len(links) > 2 and all((ROOT / link).is_file() for link in links)


def test_every_name_of_the_api_exists():
    for name in re.findall(r"wc\.(\w+)", README):
        assert hasattr(wc, name), name
