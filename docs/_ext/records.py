"""Makes the pages that follow from the code, when the site is built."""

import sys
from pathlib import Path

DOCS = Path(__file__).parents[1]
ROOT = DOCS.parent
# Links of the pages to files outside of docs/, and those to the pages of the site that have the same.
OUTSIDE = {
    "[README](../README.md#energies)": "[list of energies](energies/index.md)",
    "[README](../README.md#solvers)": "[list of solvers](solvers/index.md)",
}
sys.path.insert(0, str(DOCS))

import tables  # noqa: E402


def changes():
    """The page of the changes, from the file at the top of the checkout."""
    return (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").replace("](docs/", "](../")


def energies():
    """The page that lists the energies."""
    return f"# Every energy\n\n[Physics](../physics.md#symbols) explains the symbols.\n\n{tables.energies()}"


def solvers():
    """The page that lists the solvers."""
    return f"# Every solver\n\n{tables.solvers()}"


def write(name, text):
    """Writes a page if it differs from the one that is there, so that Sphinx reads only pages that changed."""
    path = DOCS / name
    path.parent.mkdir(exist_ok=True)
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def write_pages(app):
    """Writes all pages of the records."""
    write("reference/changes.md", changes())
    write("energies/index.md", energies())
    write("solvers/index.md", solvers())


def lead_inside(app, document, source):
    """Turns links to files outside of docs/ into links to pages of the site."""
    for outside, page in OUTSIDE.items():
        source[0] = source[0].replace(outside, page)
    for folder in ("tutorial", "howto"):  # Sphinx warns of a folder without pages
        if not (DOCS / folder).is_dir():
            source[0] = source[0].replace(f"{folder}/*\n", "")


def setup(app):
    app.connect("builder-inited", write_pages)
    app.connect("source-read", lead_inside)
    return {"parallel_read_safe": True}
