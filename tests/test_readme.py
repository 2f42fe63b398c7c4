"""What the README shows works as it stands there, and its tables name all that there is."""

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

import warpcloth as wc
from warpcloth.cli import main
from warpcloth.measures import MEASURES
from warpcloth.scenes import hanging
from warpcloth.solvers import SOLVERS
from warpcloth.terms import TERMS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = [(m[1], m[2]) for m in re.finditer(r"^```(\w+)\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)]
EXAMPLE, CURTAIN, DEFORMATION, ANALYSIS, COPIES, ROTATIONS = (text for language, text in BLOCKS if language == "python")
(STAGE,) = (text for language, text in BLOCKS if language == "usda")
COMMANDS = [line for language, text in BLOCKS if language == "sh" for line in text.splitlines() if line.startswith("warpcloth")]


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
    exec(compile(DEFORMATION, "README.md", "exec"), {"wc": wc})
    converged, angle = capsys.readouterr().out.splitlines()[-2:]
    assert converged.startswith("True ") and np.radians(115.0) < float(angle) < np.radians(125.0)
    assert (tmp_path / "twisted.usdc").is_file()


def test_the_analysis(capsys):
    names = {}
    exec(compile(ANALYSIS, "README.md", "exec"), names)
    measured, around = names["measured"], names["around"]
    np.testing.assert_allclose(measured["stretch"][-1, :, 0], 1.15, rtol=1e-12)
    # A chord is shorter than its arc, by (κ/19)²/24.
    np.testing.assert_allclose(measured["stretch"][-1, :, 1], 1.0, atol=(1.5 / 19) ** 2 / 24 * 1.01)
    assert measured["rate_of_strain"].shape == (25, 722, 3, 3) and around["residual"].shape == (25, 400)
    assert "frame 0 has none before it" in capsys.readouterr().out


def test_the_copies(capsys):
    exec(compile(COPIES, "README.md", "exec"), {})
    assert int(capsys.readouterr().out.split()[-1]) == 2 * 64


def test_every_measure_is_in_the_docs():
    text = (ROOT / "docs" / "measures.md").read_text(encoding="utf-8")
    for on, part in zip(MEASURES.values(), re.split(r"^## Of vertices", text, flags=re.MULTILINE), strict=True):
        rates = text[text.index("## Rates") :]
        for measure in on.values():
            row = re.search(rf"^\| `{measure.name}` \| (.*?) \| (.*?) \|", rates if measure.rate else part, re.MULTILINE)
            assert row, measure.name
            assert row[1] == ("×".join(map(str, measure.shape)) or "–") and row[2] == measure.unit, measure.name


@pytest.fixture(scope="module")
def animations(tmp_path_factory):
    """A folder with animations that commands of the README measure."""
    folder = tmp_path_factory.mktemp("animations")
    for name, solver in (("hanging", wc.Newton(substeps=4)), ("coarse", wc.XPBD(substeps=8, iterations=1))):
        wc.simulate(hanging.scene(n=8, duration=0.1), solver, output=str(folder / f"{name}.usdc"))
    return folder


def test_the_rotations():
    names = {}
    exec(compile(ROTATIONS, "README.md", "exec"), names)
    assert np.abs(names["turned"] - names["R"][0]).max() < 1e-5
    assert np.abs(names["R"] @ names["P"] - names["A"]).max() < 1e-5


@pytest.mark.parametrize("command", COMMANDS)
def test_commands(command, animations, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path / "cache"))
    (tmp_path / "curtain.py").write_text(CURTAIN, encoding="utf-8")
    (tmp_path / "cloth.usda").write_text(STAGE, encoding="utf-8")
    arguments = shlex.split(command)[1:]
    if arguments[0] in ("analyze", "compare"):
        shutil.copytree(animations, tmp_path, dirs_exist_ok=True)
    if arguments[0] in ("run", "deform") and "--frames" not in arguments:
        arguments += ["--frames", "2"]
    assert main(arguments) == 0, capsys.readouterr().err
    for option in ("-o", "--csv", "--plot", "--npz", "--report"):
        if option in arguments:
            assert (tmp_path / arguments[arguments.index(option) + 1]).is_file()


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
    methods = (ROOT / "docs" / "methods.md").read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| `(\w+)` \| (.+) \| (.+) \| (.+) \| (.+) \|$", methods.split("## What the residual")[1], re.MULTILINE
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
