"""Formulas of the pages are formulas in the site: each ``$$`` becomes one, and no LaTeX stands in text."""

import re
import sys
from pathlib import Path

import pytest

from warpcloth.solvers import SOLVERS
from warpcloth.terms import TERMS

DOCS = Path(__file__).parents[2] / "docs"
docutils = pytest.importorskip("docutils.core")
nodes = pytest.importorskip("docutils.nodes")
myst = pytest.importorskip("myst_parser.parsers.docutils_")
pytest.importorskip("matplotlib")
WRITTEN = {path.relative_to(DOCS).as_posix(): path for at in ("*", "tutorial/*", "howto/*") for path in DOCS.glob(f"{at}.md")}


def formulas(text):
    """Number of displayed formulas of a page, and the LaTeX that stands outside of formulas and code."""
    settings = {"myst_enable_extensions": ["colon_fence", "dollarmath"], "report_level": 5, "raw_enabled": False}
    settings["myst_suppress_warnings"] = ["*"]
    tree = docutils.publish_doctree(text, parser=myst.Parser(), settings_overrides=settings)
    kept = (nodes.math, nodes.math_block, nodes.literal, nodes.literal_block, nodes.system_message, nodes.comment)
    plain = [each for each in tree.findall(nodes.Text) if not isinstance(each.parent, kept)]
    outside = [word for each in plain for word in re.findall(r"\\[A-Za-z]{2,}|\$\$", each)]
    return len(list(tree.findall(nodes.math_block))), outside


@pytest.fixture(scope="module")
def records():
    """The module that makes pages from the records."""
    sys.path[:0] = [str(DOCS), str(DOCS / "_ext")]
    yield pytest.importorskip("records")
    del sys.path[:2]


@pytest.mark.parametrize("page", WRITTEN)
def test_formulas_of_pages_are_formulas(page):
    text = WRITTEN[page].read_text(encoding="utf-8")
    assert formulas(text) == (len(re.findall(r"^ *\$\$", text, re.MULTILINE)) // 2, [])


def test_every_energy_and_solver_has_its_formula(records):
    made = {name: records.energy(name, []) for name in TERMS}
    made |= {record.__name__: records.solver(record, []) for record in SOLVERS.values()}
    assert {name: formulas(text) for name, text in made.items()} == dict.fromkeys(made, (1, []))
