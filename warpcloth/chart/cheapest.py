"""Draws maps of the cheapest solver for pairs of values."""

import textwrap

from ..lab.choosing import percent
from ..lab.measurements import usable
from .style import LABEL, TICK, drawn, dress, headline, small_print, style_of

_WIDTH, _HEIGHT = 2.5, 1.2  # of a cell [in]
_CHARACTERS = 32  # of a line in a cell
_FADED, _BAR = 0.25, 0.035  # opacity of the colour of a solver behind texts, and width of a bar that has the full colour


def plot_cheapest(path, found):
    """Draws a cell for each pair of values of :func:`warpcloth.lab.cheapest.cheapest_map`, the first value of y lowest.

    A cell has the cheapest solver's colour, marker and settings, the time of a frame, its error, the second best by ratio of
    times, and the error of the reference. Cells without an accurate setting are hatched and say why. A question mark is an
    incomplete search.
    """
    from matplotlib.patches import Rectangle

    xs, ys = found["x"][1], found["y"][1] if found["y"] else [None]
    with drawn(path, _WIDTH * len(xs) + 1.0, _HEIGHT * len(ys) + 1.2) as figure:
        axes = figure.subplots()
        for k, cell in enumerate(found["cells"]):
            row, column = divmod(k, len(xs))
            known = cell["status"] == "found"
            looks = {"facecolor": "white", "edgecolor": "0.85", "hatch": "///"}
            if known:
                style = style_of(cell["solver"])
                looks = {"facecolor": style.colour, "alpha": _FADED}
                axes.add_patch(Rectangle((column, row), _BAR, 1.0, facecolor=style.colour))
                axes.plot(column + 0.09, row + 0.86, markersize=7, **style.line)
            axes.add_patch(Rectangle((column, row), 1.0, 1.0, **looks))
            axes.add_patch(Rectangle((column, row), 1.0, 1.0, fill=False, edgecolor="white", linewidth=2.0))
            text = {"fontsize": TICK, "ha": "center", "va": "center", "parse_math": False}
            axes.text(column + 0.5, row + 0.5, "\n".join(text_of_cell(cell)), **text)
        axes.set(xlim=(0, len(xs)), ylim=(0, len(ys)))
        axes.set_xticks([i + 0.5 for i in range(len(xs))], map(str, xs))
        axes.set_yticks([j + 0.5 for j in range(len(ys))], ["" if y is None else str(y) for y in ys])
        axes.set_xlabel(found["x"][0])
        if found["y"]:
            axes.set_ylabel(found["y"][0])
        dress(axes, grid=False)
        axes.tick_params(length=0, labelsize=LABEL)
        axes.spines[:].set_visible(False)
        frames = "" if found["frames"] is None else f", {found['frames']} frames"
        headline(
            figure, f"cheapest within {percent(found['tolerance'])}: {found['scene']}{frames}, {found['dtype']}, ms a frame"
        )
        small_print(figure, found["machine"])


def text_of_cell(cell):
    """Returns the lines of a cell."""
    if cell["status"] != "found":
        return textwrap.wrap(cell["reason"], _CHARACTERS)
    second = cell["second"]
    beside = "no second within the search" if second is None else f"{second['label']}: ×\u00a0{second['ratio']:.2g}"
    return [
        *textwrap.wrap(cell["label"], _CHARACTERS),
        f"{cell['ms']:.3g} ms{'' if cell['complete'] else '?'}, error {percent(cell['error'])}",
        *([] if usable(cell) else ["not usable"]),
        *textwrap.wrap(beside, _CHARACTERS),
        f"(reference {percent(cell['reference_error'])})",
    ]
