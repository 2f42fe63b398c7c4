"""Writes the tables of README.md and docs/ that follow from the code, between their markers: python docs/tables.py"""

import argparse
import inspect
import re
from pathlib import Path
from types import SimpleNamespace

from warpcloth.cli import _parser
from warpcloth.cli.fabrics import COLUMNS
from warpcloth.cli.fabrics import rows as rows_of_fabrics
from warpcloth.cli.options import _of_solver, _values
from warpcloth.scene.measured_fabrics import fabrics
from warpcloth.solvers import SOLVERS
from warpcloth.terms import TERMS
from warpcloth.terms.needs import lacks
from warpcloth.usd.attributes import attributes as every_attribute

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))


def table(head, rows):
    """A table of Markdown, of one line a row."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cells)} |\n".replace("|  |", "| |") for cells in lines)


def energies():
    """Lists the energies, from the docstrings of their records: the first paragraph, and the unit of the stiffness."""
    rows = []
    for name, energy in TERMS.items():
        said = inspect.getdoc(energy)
        first = re.sub(r" \([A-Z][^()]*\d{4}\)", "", " ".join(said.partition("\n\n")[0].split()))  # without its source
        symbol, unit = re.search(r"stiffness: (\S+?),? .*?(\[.*?\])", said, re.DOTALL).groups()
        rows.append([f"`{name}`", first.rstrip(".").replace("U = ", "").replace("|", "\\|"), f"{symbol} {unit}"])
    return table(("Term", "Energy U", "Stiffness"), rows)


def solvers():
    """Lists the solvers, with the energies that each takes, from what it needs of them."""
    rows = []
    for record in SOLVERS.values():
        soft, hard = (refused(record, hard=hard) for hard in (False, True))
        takes = "all" if not soft else f"all but {listed(soft)}"
        hard = [name for name in hard if name not in soft]
        if len(soft) + len(hard) == len(TERMS):
            takes += "; finite stiffness only"
        else:
            takes += "; infinite stiffness too" + (f", but not for {listed(hard)}" if hard else "")
        first = next((row[0] for row in rows if "but not for" in takes and row[2] == takes), None)
        rows.append([f"`{record.__name__}`", record.facts.method, f"as {first}" if first else takes])
    return table(("Solver", "Method", "Supports"), rows)


def methods():
    """Lists the solvers with the scenes that they suit, and the time that an error of 1 % takes, from choosing.md."""
    measured = (ROOT / "docs" / "choosing.md").read_text(encoding="utf-8").partition("## What one per cent costs")[2]
    times = dict(re.findall(r"^\| `(\w+)[^|]*(?:\|[^|]*){2}\| ([\d.]+) \|", measured.partition("\n## ")[0], re.MULTILINE))
    rows = []
    for record in SOLVERS.values():
        name, facts = record.__name__, record.facts
        rows.append([f"`{name}`", facts.suits, f"{times[name]} ms" if name in times else "–", facts.weakness])
    return table(("Method", "For", "1 %, n = 64", "Weakness"), rows)


def residuals():
    """Lists the residuals of the solvers that have one."""
    rows = []
    for record in SOLVERS.values():
        if record.residual is not None:
            held = "`tolerance`" if hasattr(record, "tolerance") else "–"
            rows.append([f"`{record.__name__}`", record.residual.measure, held])
    return table(("Solver", "Measure", "Compared with"), rows)


def refused(record, hard):
    """The energies that lack what a solver needs, with finite or infinite stiffness."""
    of = {name: SimpleNamespace(term=energy.term, hard=hard, damping=None) for name, energy in TERMS.items()}
    return [name for name, elements in of.items() if lacks(elements, record.needs)]


def listed(names):
    names = [f"`{name}`" for name in names]
    return ", ".join(names[:-1]) + " and " * (len(names) > 1) + names[-1]


def attributes():
    """Lists the attributes of a stage that say what a cloth is."""
    rows = [(row.name, row.type_names, row.location, row.field) for row in every_attribute() if row.field[:6] != "terms."]
    return table(("Attribute", "Type", "On", "Field"), [[f"`{name}`", kinds(types), *more] for name, types, *more in rows])


def term_attributes():
    """Lists the attributes of a term, with the energies that have them."""
    rows = []
    for row in every_attribute():
        field = row.field.removeprefix("terms.")
        if field != row.field:
            having = [f"`{name}`" for name, energy in TERMS.items() if field in energy.__dataclass_fields__]
            all_have = field == "type" or len(having) == len(TERMS)
            rows.append([f"`{row.name}`", kinds(row.type_names), "all" if all_have else ", ".join(having)])
    return table(("Attribute", "Type", "Energies"), rows)


def kinds(names):
    return " or ".join(f"`{name}`" for name in names)


def commands(parser):
    """Yields (name, parser) of each command, those of ``chart`` by themselves."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                inner = list(commands(command))
                yield from [(f"{name} {part}", one) for part, one in inner] or [(name, command)]


def options():
    """Lists the arguments and options of each command."""
    parts = []
    for name, command in commands(_parser()):
        rows = []
        for action in command._actions:
            if isinstance(action, argparse._HelpAction) or action.dest in ("debug", "imports"):
                continue
            values = action.metavar or (
                "" if action.nargs == 0 else (action.dest.upper() if action.choices is None else "NAME")
            )
            values = " ".join(values) if isinstance(values, tuple) else values
            flags = ", ".join(action.option_strings) or values
            said = (action.help or "") % vars(action) if action.help else ""
            choices = ", ".join(map(str, action.choices or ()))
            allowed = f"one of {choices}" if choices not in said else ""
            default = (
                f"default {action.default}"
                if action.choices and isinstance(action.default, str) and "default" not in said
                else ""
            )
            meaning = "; ".join(part for part in (said, allowed, default) if part)
            more = f" {values}" if action.option_strings and values else ""
            rows.append([f"`{flags}{more}`", meaning.replace("|", "\\|")])
        parts.append(f"\n### {name}\n\n{command.description}\n\n{table(('Option', 'Meaning'), rows)}")
    return "".join(parts) + "\n"


def solver_options():
    """Lists the options of all solvers, with the solvers that have them and their defaults."""
    found = {}
    for name, record in SOLVERS.items():
        for row in _of_solver(name)["rows"]:
            found.setdefault((row["name"], _values(row)), []).append((record.__name__, row["default"]))
    rows = []
    for (name, allowed), having in found.items():
        by_default = {}
        for solver, default in having:
            by_default.setdefault(default, []).append(f"`{solver}`")
        everyone = len(having) == len(SOLVERS) and len(by_default) == 1
        with_default = ["all"] if everyone else [", ".join(names) for names in by_default.values()]
        told = [of + ("" if default is None else f" ({default})") for of, default in zip(with_default, by_default, strict=True)]
        rows.append([f"`{name}`", allowed, "; ".join(told)])
    return table(("Option", "Values", "Solvers (default)"), rows)


def measured_fabrics():
    """Lists the fabrics."""
    return table(COLUMNS, rows_of_fabrics(list(fabrics.values())))


def fabric_sources():
    """Lists the sources of the fabrics, and what each says."""
    found = dict.fromkeys((fabric.source, fabric.notes) for fabric in fabrics.values())
    return "".join(f"- [{k}] {source}. {notes}\n" for k, (source, notes) in enumerate(found, start=1))


TABLES = {
    "energies": energies,
    "solvers": solvers,
    "methods": methods,
    "residuals": residuals,
}
# Tables that the site alone has. Their markers in the checkout have nothing between them.
IN_SITE = {
    "options": options,
    "solver options": solver_options,
    "fabrics": measured_fabrics,
    "fabric sources": fabric_sources,
    "attributes": attributes,
    "term attributes": term_attributes,
}


def filled(text, tables=TABLES):
    """The text of a page with its tables as the code has them now."""
    for name, made in tables.items():
        marked = f"<!-- {name} -->\n"
        if marked in text:
            text = re.sub(rf"(?s)({marked}).*?(<!-- end -->)", lambda m, made=made: m[1] + made() + m[2], text)
    return text


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")
