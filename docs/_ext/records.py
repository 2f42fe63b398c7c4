"""Makes the pages that follow from the code when the site is built.

There is one for each energy, solver, scene and fabric, one of the failures, the reference of Python, and the changes. The
tables of options are put into the page of the command line.
"""

import inspect
import re
import sys
from importlib import import_module
from pathlib import Path

from docutils import nodes

import warpcloth as wc
from warpcloth.cli.fabrics import COLUMNS
from warpcloth.cli.fabrics import rows as rows_of_fabrics
from warpcloth.run.listing import list_scenes
from warpcloth.solvers import SOLVERS
from warpcloth.terms import TERMS

DOCS = Path(__file__).parents[1]
ROOT = DOCS.parent
sys.path.insert(0, str(DOCS))

import tables  # noqa: E402
from formulas import SOLVERS as STEPS  # noqa: E402
from formulas import latex  # noqa: E402
from stills import MAPS  # noqa: E402

# Texts of the pages that differ in the site: links to files outside of docs/, and to pages that are made when it is built.
OUTSIDE = {
    "[README](../README.md#energies)": "[list of energies](energies/index.md)",
    "[README](../README.md#solvers)": "[list of solvers](solvers/index.md)",
    "<!-- lists -->": "- *To look things up*: every [energy](energies/index.md), [solver](solvers/index.md), "
    "[scene](scenes/index.md), [fabric](fabrics/index.md) and [failure](failures/index.md), with pictures; "
    "[Python](reference/python.md) and the [command line](command-line.md).",
}
# The sections of the reference of Python, by the packages of the names.
SECTIONS = {
    "Scenes and meshes": ("scene", "mesh", "terms"),
    "Running": ("run",),
    "Measuring and comparing": ("analysis", "lab"),
    "Deforming": ("deformation", "numerics"),
    "Pictures": ("picture",),
    "For scene files": ("base",),
}
# The units of the numbers of a fabric.
UNITS = {
    "density": ("ρ", "kg/m²"),
    "warp": ("E₁t", "N/m"),
    "weft": ("E₂t", "N/m"),
    "shear": ("Gt", "N/m"),
    "poisson_ratio": ("ν₁₂", ""),
    "bending_warp": ("D₁", "N·m"),
    "bending_weft": ("D₂", "N·m"),
    "thickness": ("t", "m"),
}


def page(title, *parts):
    """A page of a title and paragraphs; empty ones are left out."""
    return "\n\n".join([f"# {title}", *(part.strip("\n") for part in parts if part)]) + "\n"


def shown(name, text, folder="pictures"):
    """A picture of docs/pictures/ for a page in a folder; without one the build ends."""
    if not (DOCS / folder / name).is_file():
        raise FileNotFoundError(f"docs/{folder}/{name} does not exist; make it with python docs/stills.py")
    return f"![{text}](../{folder}/{name})"


def made(name):
    return f"*Made by `python docs/stills.py {name}`.*"


def sh(*commands):
    """A block of commands of warpcloth."""
    return "```sh\n" + "".join(f"warpcloth {command}\n" for command in commands) + "```"


def described(kind, name):
    """The docstring of a name and of its members, except properties that have none."""
    value = getattr(wc, name)
    bare = [each for each, of_class in vars(value).items() if isinstance(of_class, property) and not of_class.__doc__]
    bare += getattr(value, "_fields", ())  # of named tuples, whose docstrings only count them
    left_out = ", ".join(bare)
    path = value.__name__ if kind == "module" else f"warpcloth.{name}"
    options = {"class": ["members:"], "module": ["members:"], "data": ["no-value:"]}.get(kind, [])
    options += [f"exclude-members: {left_out}"] * bool(left_out)
    return f"```{{eval-rst}}\n.. auto{kind}:: {path}\n" + "".join(f"   :{option}\n" for option in options) + "```"


def sentence(words):
    """Words as a sentence."""
    return f"{words[0].upper()}{words[1:]}."


def members(names, folder=""):
    """Names as links to their pages."""
    return ", ".join(f"[`{name}`]({folder}{name}.md)" for name in names) or "none"


def index(title, names, kind, text, caption, better=None):
    """The page that lists records as cards with pictures of a kind, or of a better one if there is such a picture."""
    kinds = {name: better if (DOCS / "pictures" / f"{better}-{name}.webp").is_file() else kind for name in names}
    cards = "".join(
        f":::{{grid-item-card}} {name}\n:link: {name}\n:link-type: doc\n:img-top: ../pictures/{kinds[name]}-{name}.webp\n\n"
        f"{caption(name)}\n:::\n\n"
        for name in names
    )
    pages = "\n".join(names)
    return page(
        title,
        text,
        f"::::{{grid}} 1 2 2 3\n:gutter: 3\n\n{cards}::::",
        f"```{{toctree}}\n:hidden:\n:maxdepth: 1\n\n{pages}\n```",
    )


# --- Energies.


def first_sentence(record):
    """The first paragraph of a docstring: what it is, its equation and its source."""
    said = " ".join(inspect.getdoc(record).partition("\n\n")[0].split())
    what, _, rest = said.partition(", U = ")
    source = re.search(r" \(([A-Z][^()]*\d{4})\)", rest)
    equation = rest.replace(source[0], "") if source else rest
    return what, equation.rstrip("."), source[1] if source else ""


def energy(name, scenes):
    record = TERMS[name]
    what, equation, source = first_sentence(record)
    equation, *more = re.split(r"(: |, |\. )", equation, maxsplit=1)
    where = (f"with {more[1]}." if more[0] == ", " else sentence(more[1])) if more else ""
    finite = [each.__name__ for each in SOLVERS.values() if name not in tables.refused(each, hard=False)]
    hard = [each.__name__ for each in SOLVERS.values() if name not in tables.refused(each, hard=True)]
    kernel = Path(inspect.getfile(record)).stem
    return page(
        name,
        f"{what}.",
        shown(f"energy-{name}.webp", what),
        made(f"energy-{name}"),
        f"$$U = {latex(equation)}$$",
        f"{where} [Physics](../physics.md#symbols) explains the symbols.",
        f"It is one of the `terms` of a [scene](../scenes.md): `terms=[wc.{name}(…)]`.",
        "## Parameters",
        described("class", name),
        "## Solvers",
        f"With finite stiffness: {members(finite, '../solvers/')}.",
        f"With infinite stiffness: {members(hard, '../solvers/')}." if hard else "With infinite stiffness: none.",
        f"## Scenes\n\nScenes that have it as they stand: {members(scenes, '../scenes/')}." if scenes else "",
        f"## Source\n\n{source}. " if source else "## Source\n\n",
        f"Its functions are in {code(f'kernels/terms/{kernel}.py')}, its record in {code(f'warpcloth/terms/{kernel}.py')}.",
    )


def code(path):
    """A file of the checkout, for download."""
    return f"[`{path}`](../../{path})"


# --- Solvers.


def solver(record, scenes):
    name, facts = record.__name__, record.facts
    timed = next((row for row in tables_of("choosing") if row.startswith(f"| `{name}")), None)
    taken = [energy for energy in TERMS if energy not in tables.refused(record, hard=False)]
    hard = [energy for energy in TERMS if energy not in tables.refused(record, hard=True)]
    head = "| Solver | Substeps | Iterations per step | CPU core [ms] | H200 [ms] |\n|---|---|---|---|---|\n"
    return page(
        name,
        f"{facts.method[0].upper()}{facts.method[1:]}.",
        shown(f"solver-{name}.webp", f"The hanging cloth by {name}"),
        "*The scene `hanging` with 24 × 24 vertices after 0.5 s, coloured by its larger principal stretch, as on the pages of "
        f"the other solvers. {made(f'solver-{name}')[1:]}",
        f"- **Suits:** {facts.suits}.\n- **Weakness:** {facts.weakness}.",
        sh(f"run hanging --solver {record.name} -o hanging.usdc", f"run hanging --solver {record.name} -s help"),
        "## A step",
        f"$$\n\\begin{{gathered}} {STEPS[name][0]} \\end{{gathered}}\n$$",
        f"{STEPS[name][1]}."
        + ("" if r"\tilde x" not in STEPS[name][0] else " x̃ is where the vertices would be without the energy.")
        + (" [Solvers](../solvers.md#integrators) has the other integrators." if hasattr(record, "integrator") else ""),
        "## Method and options",
        described("class", name),
        "## Energies",
        f"With finite stiffness: {members(taken, '../energies/')}.",
        f"With infinite stiffness: {members(hard, '../energies/')}." if hard else "It takes no infinite stiffness.",
        f"Included scenes that it runs as they stand: {members(scenes, '../scenes/')}.",
        "## Accuracy and time",
        f"For an error of 1 % in a second of `hanging` with 64 × 64 vertices a frame takes:\n\n{head}{timed}" if timed else "",
        "[Choosing](../choosing.md#what-one-per-cent-costs) says how this was measured, and has it for other solvers."
        if timed
        else "",
        "Each point is a setting, and each line has the settings of an integrator:",
        shown(f"speed-{name}.webp", f"Error against time, {name} in colour and the other solvers in grey"),
        "*Measured on a machine that other processes used too. "
        "[All solvers in one chart](../choosing.md#speed-against-accuracy). "
        f"{made(f'speed-{name}')[1:]}",
        sh(f"chart work-precision hanging --solvers {record.name} -o {record.name}.png"),
        "## Where it fails",
        "[Failures](../failures/index.md) has the charts of what goes wrong with each method, "
        "[solvers](../solvers.md) what is common to all.",
    )


def tables_of(name):
    """The lines of the tables of a page."""
    return [line for line in (DOCS / f"{name}.md").read_text(encoding="utf-8").splitlines() if line.startswith("|")]


# --- Scenes.


def supporters(scene):
    """Names of the solvers that take a scene, and what the others say."""
    model, able, unable = scene.build(), [], []
    for record in SOLVERS.values():
        try:
            record.refuse(model)
            able.append(record.__name__)
        except ValueError as error:
            unable.append(f"{error}.")
    return able, unable


def known_answers():
    """Returns the known answer of each scene, from the table of scenes.md."""
    rows = (row.strip("| ").split(" | ") for row in tables_of("scenes") if row.startswith("| `"))
    return {cells[0].strip("`"): cells[2] if len(cells) > 2 else "" for cells in rows}


def scene(listed, built, able, unable):
    name, module = listed.name, import_module(f"warpcloth.scenes.{listed.name}")
    known = known_answers()[name]
    parameters = [text.partition("=")[::2] for text in listed.parameters]
    kinds = dict.fromkeys(type(term).__name__ for term in built.terms)
    mesh, more = built.mesh, []
    if built.colliders:
        more.append(f"colliders: {', '.join(dict.fromkeys(type(each).__name__ for each in built.colliders))}")
    if built.self_contact is not None:
        more.append("contact of the cloth with itself")
    if built.air is not None:
        more.append("air")
    facts = [
        f"{len(mesh.points):,} vertices, {len(mesh.triangles):,} triangles, {len(mesh.edges):,} edges, "
        f"{len(built.pins.vertices):,} vertices pinned",
        f"{built.duration:g} s at {built.fps:g} frames a second",
        f"energies: {members(kinds, '../energies/')}",
        *more,
    ]
    refusals = "".join(f"- {said}\n" for said in unable)
    return page(
        name,
        inspect.getdoc(module),
        shown(f"scene-{name}.webp", listed.summary),
        made(f"scene-{name}"),
        sh(f"run {name} -o {name}.usdc", f"render {name}.usdc -o {name}.gif"),
        f"## Known answer\n\n{sentence(known.replace('](', '](../'))}" if known else "",
        "## Parameters",
        listed.meaning,
        "| Parameter | Default |\n|---|---|\n" + "".join(f"| `{key}` | `{value}` |\n" for key, value in parameters),
        f"Give them by `-p`, as in `warpcloth run {name} -p {parameters[0][0]}=… -o {name}.usdc`, or to the function "
        f"`warpcloth.scenes.{name}.scene`.",
        "## As it stands",
        "".join(f"- {fact}\n" for fact in facts),
        f"Solvers that take it: {members(able, '../solvers/')}.",
        f"Solvers that refuse it:\n\n{refusals}" if refusals else "",
        f"## The file\n\n```{{literalinclude}} ../../scenes/{name}.py\n:language: python\n```",
    )


# --- Fabrics.


def fabric(found):
    name = found.name
    rows = "".join(
        f"| {symbol}{', computed' * (field in found.computed)} | {float(f'{getattr(found, field):.4g}'):g} | {unit} |\n"
        if getattr(found, field) is not None
        else f"| {symbol} | unknown | |\n"
        for field, (symbol, unit) in UNITS.items()
    )
    (values,) = rows_of_fabrics([found])
    derived = [(column, value) for column, value in zip(COLUMNS, values, strict=True) if column[:2] in ("l₁", "l₂", "dr")]
    lengths = "".join(f"| {column.rpartition(' ')[0]} | {value} | {column.rpartition(' ')[2]} |\n" for column, value in derived)
    try:
        found.terms()
    except ValueError as error:
        first = [f"A number of it is not known: {error}. [Fabrics](../fabrics.md) has an example."]
    else:
        first = [
            shown(f"drape-{name}.webp", f"A drape of {name} from above"),
            f"*Its drape in the test of Cusick, from above: [`cusick`](../scenes/cusick.md). {made(f'drape-{name}')[1:]}",
            sh(f"run hanging -p fabric={name} -o {name}.usdc", f"measure cusick -p fabric={name} rows=8"),
        ]
    return page(
        name,
        *first,
        "## Numbers",
        f"| | | |\n|---|---|---|\n{rows}",
        shown(f"fabric-{name}.webp", f"The numbers of {name} among those of all fabrics"),
        f"*Its numbers among those of all fabrics. {made(f'fabric-{name}')[1:]}",
        "Bending lengths l = (D/ρg)^⅓, and the drape coefficient. Numbers with * were computed, not measured:",
        f"| | | |\n|---|---|---|\n{lengths}",
        "## Source",
        f"{found.source}. {found.notes}",
    )


# --- Failures.


def failures():
    """The page of all failures, from the table of stability.md, each with its chart."""
    text = (DOCS / "stability.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| (.*?) \| (.*?) \|$", text, re.MULTILINE)
    parts = []
    for number, what, command in rows:
        command, _, more = command.partition("; ")
        command = command.strip("`")
        name = command.split()[1] if command.startswith("failure") else f"failure-{number}"
        name = "stability" if number == "1" else name  # the map of all solvers
        own = (DOCS / f"{name}.png").is_file()
        parts += [
            f"## {number}. {what[0].upper()}{what[1:]}",
            shown(f"{name}.png", what, ".") if own else shown(f"failure-{number}.webp", what),
            sh(f"chart {command} -o {name}.png"),
            "" if own else made(f"failure-{number}"),
            "*The picture has the map of every solver; [its command](../stability.md).*" if number == "1" else "",
            f"*It has fewer cells, by `{MAPS[number]}`.*" if MAPS.get(number) else "",
            more and f"{more[0].upper()}{more[1:]}.",
            f"[What it shows](../stability.md#{name if command.startswith('failure') else 'theoretical-limits'}).",
        ]
    return page(
        "Every failure",
        "Each chart is measured. [Where methods are stable](../stability.md) says what colours mean, what theory predicts, and "
        "when a run counts as diverged.",
        *parts,
    )


# --- Reference.


def api():
    """The reference of what ``import warpcloth as wc`` gives, but for energies and solvers, which have pages."""
    parts = ["```{eval-rst}\n.. module:: warpcloth\n```"]
    for title, packages in SECTIONS.items():
        parts.append(f"## {title}")
        for name in sorted(
            (name for name, module in wc._MODULES.items() if module.partition(".")[0] in packages), key=in_order
        ):
            parts += [f"### {name}", described(kind_of(getattr(wc, name)), name)]
    left = {module.partition(".")[0] for module in wc._MODULES.values()} - {each for some in SECTIONS.values() for each in some}
    assert not left, f"no section of the reference has {left}"
    return page(
        "Python",
        "What `import warpcloth as wc` gives. [Energies](../energies/index.md) and [solvers](../solvers/index.md) have "
        "pages of their own.",
        *parts,
    )


def kind_of(value):
    """The directive of autodoc for a value."""
    kinds = {"module": inspect.ismodule, "class": inspect.isclass, "function": inspect.isfunction}
    return next((kind for kind, holds in kinds.items() if holds(value)), "data")


def in_order(name):
    """Sorts classes first, and modules last."""
    return ("class", "data", "function", "module").index(kind_of(getattr(wc, name)))


def changes():
    """The page of the changes, from the file at the top of the checkout."""
    return (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").replace("](docs/", "](../")


def pages():
    """All pages by name."""
    found = {"reference/python.md": api(), "reference/changes.md": changes(), "failures/index.md": failures()}
    listed = list_scenes(ROOT / "scenes")
    built = {each.name: import_module(f"warpcloth.scenes.{each.name}").scene() for each in listed}
    taken = {name: supporters(one) for name, one in built.items()}
    for each in listed:
        found[f"scenes/{each.name}.md"] = scene(each, built[each.name], *taken[each.name])
    for name in TERMS:
        having = [at for at, one in built.items() if any(type(term).__name__ == name for term in one.terms)]
        found[f"energies/{name}.md"] = energy(name, having)
    for record in SOLVERS.values():
        runs = [at for at, (able, _) in taken.items() if record.__name__ in able]
        found[f"solvers/{record.__name__}.md"] = solver(record, runs)
    for each in wc.fabrics.values():
        found[f"fabrics/{each.name}.md"] = fabric(each)
    summaries = {each.name: each.summary for each in listed}
    found["energies/index.md"] = index(
        "Every energy",
        TERMS,
        "energy",
        "Pictures show a cloth without the energy and with it, or two values of a parameter. "
        "[Physics](../physics.md) compares them.",
        lambda name: f"{first_sentence(TERMS[name])[0]}.",
    )
    records = {record.__name__: record for record in SOLVERS.values()}
    found["solvers/index.md"] = index(
        "Every solver",
        records,
        "solver",
        "Pictures show the same moment of the scene `hanging`, coloured by its largest stretch.\n\n" + tables.solvers(),
        lambda name: f"{records[name].facts.method[0].upper()}{records[name].facts.method[1:]}.",
    )
    known = [name for name, answer in known_answers().items() if answer and name in summaries]
    found["scenes/index.md"] = index(
        "Every scene",
        summaries,
        "scene",
        "Files in `scenes/` are known by name, as in `warpcloth run hanging`. [Scenes](../scenes.md) says how to write one.\n\n"
        f"The pages of these say what is known of their results: {members(known)}.",
        summaries.get,
    )
    found["fabrics/index.md"] = index(
        "Every fabric",
        wc.fabrics,
        "fabric",
        "Pictures show a drape from above, or the numbers of a fabric among those of all. [Fabrics](../fabrics.md) has the "
        "table, and says how far to trust it.",
        lambda name: f"{1e3 * wc.fabrics[name].density:.0f} g/m²",
        better="drape",
    )
    return found


def write_pages(app):
    """Writes all pages, if they differ from those that are there, so that Sphinx reads only pages that changed."""
    found = pages()
    for name, text in found.items():
        path = DOCS / name
        path.parent.mkdir(exist_ok=True)
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    for folder in {name.partition("/")[0] for name in found}:
        for path in (DOCS / folder).glob("*.md"):
            if f"{folder}/{path.name}" not in found:
                path.unlink()


def lead_inside(app, document, source):
    """Puts the texts and the tables of the site into a page."""
    for outside, inside in OUTSIDE.items():
        source[0] = source[0].replace(outside, inside)
    source[0] = tables.filled(source[0], tables.IN_SITE)


def escape(app, what, name, value, options, lines):
    """Escapes vertical bars in docstrings, which mean absolute values there, outside of code."""
    for k, line in enumerate(lines):
        parts = line.split("``")
        parts[::2] = [part.replace("|", "\\|") for part in parts[::2]]
        lines[k] = "``".join(parts)


def dash(app, tree):
    """Makes dashes of the two hyphens that autodoc sets between names and texts; those of options of commands stay."""
    for text in list(tree.findall(nodes.Text)):
        if " -- " in text and not isinstance(text.parent, nodes.literal | nodes.literal_block):
            text.parent.replace(text, nodes.Text(text.replace(" -- ", " – ")))


def setup(app):
    app.connect("autodoc-process-docstring", escape)
    app.connect("builder-inited", write_pages)
    app.connect("doctree-read", dash)
    app.connect("source-read", lead_inside)
    return {"parallel_read_safe": True}
