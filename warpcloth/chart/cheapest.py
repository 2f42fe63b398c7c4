"""Draws maps of the cheapest solver: a cell for each pair of values, in the colour of the solver."""

import textwrap

from ..lab.choosing import percent
from ..lab.machine import in_words
from ..picture.figures import GREY, PICTURES, check_path, save
from ..solvers import SOLVERS

_WIDTH, _HEIGHT = 2.5, 1.25  # of a cell [in]
_LETTERS = 8.5  # [pt]
_CHARACTERS = 32  # of a line in a cell
_FADED = 0.30  # opacity of the colour of a solver, so that texts can be read


def plot_cheapest(path, found):
    """Draws a cell for each pair of values, with the first value of y in the lowest row.

    A cell has the colour of the cheapest solver. It shows its settings, the time of a frame, its error, the second best with
    its ratio of times, and the error of the reference. Cells without an accurate setting are hatched and say why. A question
    mark after the time means that the search was not complete.

    Args:
        path: The file, .png, .svg or .pdf.
        found: As :func:`warpcloth.lab.cheapest.cheapest_map` returns it.

    Raises:
        FileNotFoundError: The folder does not exist.
        ImportError: matplotlib is not installed.
        ValueError: The path has another ending.
    """
    check_path(path, PICTURES)
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    xs, ys = found["x"][1], found["y"][1] if found["y"] else [None]
    figure = Figure(figsize=(_WIDTH * len(xs) + 1.0, _HEIGHT * len(ys) + 1.2), layout="constrained")
    axes = figure.subplots()
    for k, cell in enumerate(found["cells"]):
        row, column = divmod(k, len(xs))
        known = cell["status"] == "found"
        colour = SOLVERS[cell["solver"]].facts.style[0] if known else "white"
        style = {"facecolor": colour, "alpha": _FADED} if known else {"facecolor": "white", "edgecolor": "0.85", "hatch": "///"}
        axes.add_patch(Rectangle((column, row), 1.0, 1.0, **style))
        axes.add_patch(Rectangle((column, row), 1.0, 1.0, fill=False, edgecolor="white", linewidth=2.0))
        text = {"fontsize": _LETTERS, "ha": "center", "va": "center", "parse_math": False}
        axes.text(column + 0.5, row + 0.5, "\n".join(text_of_cell(cell)), **text)
    axes.set(xlim=(0, len(xs)), ylim=(0, len(ys)))
    axes.set_xticks([i + 0.5 for i in range(len(xs))], map(str, xs))
    axes.set_yticks([j + 0.5 for j in range(len(ys))], ["" if y is None else str(y) for y in ys])
    axes.set_xlabel(found["x"][0], color=GREY, fontsize=_LETTERS + 1.0)
    if found["y"]:
        axes.set_ylabel(found["y"][0], color=GREY, fontsize=_LETTERS + 1.0)
    axes.tick_params(length=0, colors=GREY, labelsize=_LETTERS + 1.0)
    axes.spines[:].set_visible(False)
    frames = "" if found["frames"] is None else f", {found['frames']} frames"
    title = f"cheapest within {percent(found['tolerance'])}: {found['scene']}{frames}, {found['dtype']}, ms a frame"
    figure.suptitle(f"{title}\non {in_words(found['machine'])}", fontsize=_LETTERS + 1.0, color=GREY, parse_math=False)
    save(figure, path)


def text_of_cell(cell):
    """Returns the lines of text of a cell."""
    if cell["status"] != "found":
        return textwrap.wrap(cell["reason"], _CHARACTERS)
    second = cell["second"]
    beside = "no second within the search" if second is None else f"{second['label']}: ×\u00a0{second['ratio']:.2g}"
    return [
        *textwrap.wrap(cell["label"], _CHARACTERS),
        f"{cell['ms']:.3g} ms{'' if cell['complete'] else '?'}, error {percent(cell['error'])}",
        *textwrap.wrap(beside, _CHARACTERS),
        f"(reference {percent(cell['reference_error'])})",
    ]
