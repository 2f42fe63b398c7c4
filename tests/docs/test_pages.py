"""README.md and docs/ hold as they stand: blocks run, links resolve, tables and names are those of the code."""

import importlib.util
import os
import re
import shlex
import subprocess
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import warpcloth as wc
import warpcloth.solvers
import warpcloth.terms
from support.forks import Forks
from warpcloth.analysis.measures import MEASURES
from warpcloth.cli import _parser
from warpcloth.solvers import SOLVERS

ROOT = Path(__file__).parents[2]
_spec = importlib.util.spec_from_file_location("tables", ROOT / "docs" / "tables.py")
tables = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(tables)
PAGES = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in tables.PAGES}
ALL = PAGES | {"CHANGELOG.md": (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")}


def blocks(text):
    """(language, text) of each block that runs; others have "notest" behind their language, and a comment that says why."""
    return [(m[1], m[2]) for m in re.finditer(r"^```(\w+)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)]


def files(text):
    """Text of each file that a page shows, by name."""
    return {m[1]: m[2] for m in re.finditer(r"`([\w.]+)`:\n\n```\w+\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)}


def python(page):
    """All Python of a page, but for files."""
    text = PAGES[page]
    return "\n".join(
        text for language, text in blocks(text) if language == "python" and text not in files(PAGES[page]).values()
    )


COMMANDS = [
    line
    for text in PAGES.values()
    for block in re.findall(r"^```sh(?: notest)?\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    for line in block.splitlines()
    if line.startswith("warpcloth ")
]
# Packages by extra.
OPTIONAL = (ROOT / "pyproject.toml").read_text(encoding="utf-8").partition("[project.optional-dependencies]")[2]
EXTRAS = {
    name: re.findall(r'"(\w+)', packages)
    for name, packages in re.findall(r"^(\w+) = \[(.*)\]$", OPTIONAL.partition("\n[")[0], re.MULTILINE)
}


def test_the_readme_is_short_and_has_three_commands():
    text = PAGES["README.md"]
    assert len(text.split()) <= 900
    assert len(re.findall(r"^python3 -m venv", text, re.MULTILINE)) == 3  # as .ci/run takes them
    assert len([line for line in python("README.md").splitlines() if line]) == 5


@pytest.mark.parametrize("page", PAGES)
def test_generated_tables_are_those_of_the_code(page):
    assert tables.filled(PAGES[page]) == PAGES[page], "run python docs/tables.py"


def test_tables_of_the_site_are_not_in_the_checkout():
    """They have every command, and a row for each of its options; the checkout has their markers."""
    page = PAGES["docs/command-line.md"]
    for name in tables.IN_SITE:
        assert f"<!-- {name} -->\n<!-- end -->\n" in "".join(PAGES.values())
    built = tables.filled(page, tables.IN_SITE)
    for name, parser in tables.commands(_parser()):
        part = built.partition(f"\n### {name}\n")[2].partition("\n### ")[0]
        flags = {flag for action in parser._actions for flag in action.option_strings} - {"-h", "--help", "--debug", "--import"}
        assert flags <= set(re.findall(r"--?[\w-]+", part)), name
    assert all(f"`{record.__name__}`" in built.partition("<!-- solver options -->")[2] for record in SOLVERS.values())


def slug(heading):
    """The anchor of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("page", ALL)
def test_links_lead_somewhere(page):
    """To a file of the checkout, and to a heading that it has in the site."""
    for link in re.findall(r"\]\((?!https?:)([^)]+)\)", ALL[page]):
        path, _, anchor = link.partition("#")
        target = (ROOT / page).parent / path if path else ROOT / page
        assert target.is_file(), link
        if anchor:
            text = tables.filled(target.read_text(encoding="utf-8"), tables.IN_SITE)
            headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
            assert anchor in map(slug, headings), link


def test_every_page_is_linked_and_every_picture_shown():
    linked = {
        str(((ROOT / page).parent / link.partition("#")[0]).resolve().relative_to(ROOT))
        for page, text in PAGES.items()
        for link in re.findall(r"\]\((?!https?:)([^)#]+)", text)
    }
    shown = [path for path in (ROOT / "docs").iterdir() if path.suffix in (".png", ".gif", ".svg", ".md")]
    assert {str(path.relative_to(ROOT)) for path in shown} <= linked


def test_the_gallery_shows_its_files_with_the_commands_that_make_them():
    """Entries of docs/gallery.py have their names in files and commands; charts are made by ``warpcloth``."""
    entries = re.findall(r"^@entry\ndef (\w+)", (ROOT / "docs" / "gallery.py").read_text(encoding="utf-8"), re.MULTILINE)
    shown = re.findall(r"^!\[[^\]]+\]\((\S+)\)\n\n(.+?)(?=\n\n|\Z)", PAGES["docs/gallery.md"], re.MULTILINE | re.DOTALL)
    named = []
    for path, text in shown:
        (command,) = re.findall(r"`((?:warpcloth|python docs/gallery\.py) [^`]+)`", text)
        if command.startswith("warpcloth"):
            assert _parser().parse_args(shlex.split(command)[1:]).output == f"docs/{path}"
        else:
            named.append(command.split()[-1])
            assert Path(path).stem == named[-1]
    # Links of Markdown to files that are no pages are downloads in the site, so these are links of HTML.
    linked = re.findall(
        r'^<a href="(_static/gallery/(\w+)\.html)">.+`python docs/gallery\.py \2`$', PAGES["docs/gallery.md"], re.MULTILINE
    )
    named += [name for _, name in linked]
    assert len(shown) >= 20 and sorted(named) == sorted(entries)
    for folder, paths, most in (
        ("gallery", [path for path, _ in shown], 400e3),
        ("_static/gallery", [path for path, _ in linked], 1e6),
    ):
        files = {path.relative_to(ROOT / "docs").as_posix(): path.stat().st_size for path in (ROOT / "docs" / folder).iterdir()}
        assert set(files) == {path for path in paths if path.startswith(f"{folder}/")} and max(files.values()) < most
    assert sum(path.stat().st_size for path in (ROOT / "docs").rglob("*") if path.is_file()) < 15e6


@pytest.mark.parametrize("page", PAGES)
def test_every_name_of_the_api_exists(page):
    for name in re.findall(r"\bwc\.(\w+)", PAGES[page]):
        assert hasattr(wc, name), name


@pytest.mark.parametrize("page", PAGES)
def test_files_that_are_named_exist(page):
    """Paths of the checkout and the modules of the package, in code."""
    for path in re.findall(r"[ `]((?:warpcloth|kernels|scenes|tests|benchmarks|docs|\.ci)/[\w./-]*\w)`?", PAGES[page]):
        assert (ROOT / path).exists(), path
    for name in re.findall(r"`(warpcloth(?:\.\w+)+)", PAGES[page]):
        parts = name.split(".")
        found = next(k for k in range(len(parts), 0, -1) if _exists(".".join(parts[:k])))
        value = importlib.import_module(".".join(parts[:found]))
        for part in parts[found:]:
            value = getattr(value, part)


def test_the_drawing_of_the_packages_is_what_the_linter_checks():
    checked = re.search(r"^layers = \[(.*)\]$", (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)[1]
    (drawing,) = (text for language, text in blocks(PAGES["docs/architecture.md"]) if language == "text")
    packages = re.findall(r"[a-z]+", checked)
    assert [word for word in re.findall(r"(?<= )[a-z]+(?=  )", drawing) if word in packages] == packages


def _exists(module):
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


@pytest.mark.parametrize("command", [command for command in COMMANDS if "--import" not in command])
def test_every_command_is_one(command):
    """Those with --import need their file, see test_a_page_as_it_stands."""
    assert _parser().parse_args(shlex.split(command, comments=True)[1:]).command


@pytest.mark.parametrize("page", ALL)
def test_extras_that_are_to_be_installed_exist(page):
    """Extras are installed from a checkout, because warpcloth is on no index."""
    assert "warpcloth[" not in ALL[page]
    for given in re.findall(r"pip install ([^`&#\n]*)", ALL[page]):
        assert (given.strip() == "-e .") or re.fullmatch(r"-e '\.\[(\w+)\]'", given.strip()), given
    assert set(re.findall(r"'\.\[(\w+)\]'", ALL[page])) <= set(EXTRAS)


def test_extras_that_refusals_name_exist():
    said = []
    for path in (ROOT / "warpcloth").rglob("*.py"):
        said += re.findall(r"pip install [^\n]*", path.read_text(encoding="utf-8"))
    assert len(said) > 3
    for line in said:
        assert re.match(r"pip install -e (['\"])\.\[(\w+)\]\1(``)? in the checkout", line)[2] in EXTRAS, line


@pytest.mark.parametrize("name", tables.TABLES | tables.IN_SITE)
def test_every_generated_table_is_on_one_page(name):
    assert "".join(PAGES.values()).count(f"<!-- {name} -->\n") == 1


def test_every_scene_is_in_the_docs():
    table = re.search(r"^\| Scene \|.*?(?=\n\n)", PAGES["docs/scenes.md"], re.MULTILINE | re.DOTALL)[0]
    assert set(re.findall(r"^\| `(\w+)`", table, re.MULTILINE)) == {path.stem for path in (ROOT / "scenes").glob("*.py")}


def test_every_record_has_a_small_picture():
    """The pages that the build of the site makes show them."""
    names = {
        "energy": warpcloth.terms.__all__,
        "solver": warpcloth.solvers.__all__,
        "scene": [path.stem for path in (ROOT / "scenes").glob("*.py")],
        "fabric": wc.fabrics,
    }
    there = {path.stem: path.stat().st_size for path in (ROOT / "docs" / "pictures").glob("*.webp")}
    needed = {f"{kind}-{name}" for kind, of_kind in names.items() for name in of_kind}
    assert needed <= there.keys(), "run python docs/stills.py"
    assert {name for name in there if name.partition("-")[0] in names} <= needed
    assert max(there.values()) <= 40_000


def test_every_solver_of_the_package_says_what_it_suits():
    assert all(record.facts.suits and record.facts.weakness for record in SOLVERS.values())
    assert "| – |" not in tables.methods(), "the table in docs/choosing.md lacks a solver"


def test_every_measure_is_in_the_docs():
    text = PAGES["docs/measuring.md"]
    for on, part in zip(MEASURES.values(), re.split(r"^## Measures of vertices", text, flags=re.MULTILINE), strict=True):
        rates = text[text.index("## Rates") :]
        for measure in on.values():
            row = re.search(rf"^\| `{measure.name}` \| (.*?) \| (.*?) \|", rates if measure.rate else part, re.MULTILINE)
            assert row, measure.name
            assert row[1] == ("×".join(map(str, measure.shape)) or "–") and row[2] == measure.unit, measure.name


@pytest.mark.parametrize("code", [0, 1, 2])
@pytest.mark.parametrize("said", ["", "  # exit code 1"])
def test_a_command_of_a_cell_ends_the_build_unless_it_exits_as_the_page_says(code, said):
    """Code 1 used to pass, which `check` gives where it finds something, and a run where it diverges."""
    kernel = SimpleNamespace(user_ns={})
    kernel.system = lambda command: kernel.user_ns.update(_exit_code=subprocess.run(command, shell=True).returncode)
    exec((ROOT / "docs" / "_ext" / "cells.py").read_text(encoding="utf-8"), {"get_ipython": lambda: kernel})
    with nullcontext() if code == bool(said) else pytest.raises(RuntimeError, match=f"exit {code}{said} ended with .* {code}$"):
        kernel.system(f"exit {code}{said}")


# --- Results of the Python that pages show.


def run(page, folder, monkeypatch):
    monkeypatch.chdir(folder)
    names = {}
    exec(compile(python(page), page, "exec"), names)
    return names


def test_the_deformation(tmp_path, monkeypatch, capsys):
    run("docs/deformation.md", tmp_path, monkeypatch)
    converged, angle = capsys.readouterr().out.splitlines()[-2:]
    assert converged.startswith("True ") and np.radians(115.0) < float(angle) < np.radians(125.0)
    assert (tmp_path / "twisted.usdc").is_file()


def test_the_measures(tmp_path, monkeypatch, capsys):
    names = run("docs/measuring.md", tmp_path, monkeypatch)
    measured, around = names["measured"], names["around"]
    np.testing.assert_array_equal(names["rolled"][0], names["mesh"].points)
    np.testing.assert_allclose(measured["stretch"][-1, :, 0], 1.15, rtol=1e-12)
    # A chord is shorter than its arc, by (κ/19)²/24.
    np.testing.assert_allclose(measured["stretch"][-1, :, 1], 1.0, atol=(1.5 / 19) ** 2 / 24 * 1.01)
    assert measured["rate_of_strain"].shape == (25, 722, 3, 3) and around["residual"].shape == (25, 400)
    assert "frame 0 has none before it" in capsys.readouterr().out


def test_the_rotations(tmp_path, monkeypatch):
    names = run("docs/rotations.md", tmp_path, monkeypatch)
    assert np.abs(names["turned"] - names["R"][0]).max() < 1e-5
    assert np.abs(names["R"] @ names["P"] - names["A"]).max() < 1e-5


# --- All blocks of a page, as they stand there.

# Modules whose names differ from those of their packages.
MODULES = {"libigl": "igl", "pillow": "PIL", "pyuipc": "uipc"}
# Runs the blocks of a page one after the other, commands by the function behind them. Packages that the page does not say to
# install are not found. Other commands are left out: .ci/run runs those of the README, a cluster needs several machines, and
# bench compiles again what it measures, as test_bench.py has it do. What commands measure in two processes is measured here in
# a thread; test_sweep.py and test_extending.py have them start processes. Runs of whole scenes end after 12 frames, their films
# are small, and the diagram physics has two resolutions.
# One process imports what all pages need, and forks for each page.
RUN = """
import functools, os, shlex, sys
from importlib.machinery import PathFinder

find, absent = PathFinder.find_spec, set({absent!r})
PathFinder.find_spec = lambda name, *more: None if name.partition(".")[0] in absent else find(name, *more)

from concurrent.futures import ThreadPoolExecutor

import pxr.UsdGeom, scipy.sparse.linalg, trimesh
import warpcloth.cli.run
import warpcloth.solvers
from warpcloth.cli import main
from warpcloth.lab import campaign, work_precision

assert not absent & sys.modules.keys()
campaign.processes = lambda workers: ThreadPoolExecutor(1)
warpcloth.cli.run.draw_film = functools.partial(warpcloth.cli.run.draw_film, size=(320, 180))
for name, (plans, resolutions) in work_precision.PHYSICS.items():
    work_precision.PHYSICS[name] = plans, resolutions[:2]


def page(folder, blocks, there, check):
    os.chdir(folder)
    os.environ["WARPCLOTH_CACHE"] = os.path.join(folder, "cache")
    absent.difference_update(there)
    names = {{"__name__": "page"}}
    for language, text in blocks:
        if language == "python":
            exec(compile(text, "page", "exec"), names)
        for line in text.splitlines() if language == "sh" else ():
            if line.startswith("warpcloth ") and not line.startswith("warpcloth bench "):
                print("+", line, flush=True)
                words = shlex.split(line, comments=True)[1:]
                code = main(words + ["--frames", "12"] * (words[0] == "run" and "--frames" not in words))
                assert code == 0, f"{{line}}: {{code}}"
    exec(check, names)
"""
# What holds of the names that the Python of a page leaves.
CHECKS = {
    "docs/scenes.md": """
assert animation.status.ok and animation.status.message.startswith("converged")
assert animation.points.shape == (61, 576, 3) and animation.points[-1].shape == (576, 3)
""",
    "docs/batches.md": "assert ends == 2 * 64",
}


@pytest.fixture(scope="module")
def forks():
    absent = {MODULES.get(package, package) for extra in set(EXTRAS) - {"test"} for package in EXTRAS[extra]}
    with Forks(RUN.format(absent=sorted(absent)), PYTHONPATH=str(ROOT)) as forks:
        yield forks


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize("page", [page for page, text in PAGES.items() if {"python", "sh"} & dict(blocks(text)).keys()])
def test_a_page_as_it_stands(page, forks, tmp_path, tmp_path_factory):
    """All of its blocks in one process, in a folder with the files that it shows."""
    text = PAGES[page]
    named = set(re.findall(r"'\.\[(\w+)\]'", text)) - {"test"}
    there = [MODULES.get(package, package) for extra in named for package in EXTRAS[extra]]
    for name, content in files(text).items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    shown = [block for block in blocks(text) if block[1] not in files(text).values()]
    output = tmp_path_factory.mktemp("said") / "said"
    forks.start("page(*given)", output, str(tmp_path), shown, there, CHECKS.get(page, ""))
    code, said = forks.wait(), output.read_text(encoding="utf-8")
    assert code == 0 and "Traceback" not in said, said
    lines = [line for language, block in shown if language == "sh" for line in block.splitlines()]
    commands = [line for line in lines if line[:9] == "warpcloth" and line[10:15] != "bench"]
    for option, name in pairwise(shlex.split("\n".join(commands), comments=True)):
        if option in ("-o", "--csv", "--plot", "--npz", "--report"):
            assert (tmp_path / name).is_file(), name
