"""Draws panels of measured points with laws as lines, for charts of failures."""

import math

import numpy as np

from ..lab.panels import Map
from ..picture.figures import GREY, PICTURES, check_path, save
from .panel_maps import add_keys, draw_map

_MARKS = "os^DvPX*"
_COLOURS = ("black", "tab:red", "tab:blue", "tab:green", "tab:orange", "tab:purple", "tab:cyan", "tab:brown")


def plot_panels(path, panels, rows, title):
    """Draws points as markers or cells, and laws as lines.

    Args:
        path: The file, .png, .svg or .pdf.
        panels: :class:`warpcloth.lab.panels.Panel` records.
        rows: Points, see :func:`warpcloth.lab.panels.point`.
        title: Title of the figure.

    Raises:
        FileNotFoundError: The folder does not exist.
        ImportError: matplotlib is not installed.
        ValueError: The path has another ending.
    """
    check_path(path, PICTURES)
    from matplotlib.figure import Figure

    across = 4 if len(panels) > 9 else 2 if len(panels) == 4 else min(len(panels), 3)
    down = math.ceil(len(panels) / across)
    width, height = (3.8, 3.2) if any(isinstance(panel, Map) for panel in panels) else (5.0, 4.1)
    figure = Figure(figsize=(width * across, height * down + 0.3), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.12, h_pad=0.1)
    grid, maps, lines = figure.subplots(down, across, squeeze=False).ravel(), [], {}
    for axes, panel in zip(grid, panels, strict=False):
        of = [row for row in rows if row["panel"] == panel.key]
        if isinstance(panel, Map):
            maps.append((axes, panel, draw_map(axes, panel, of, lines)))
        else:
            _draw(axes, panel, of)
        _label(axes, panel)
    for axes in grid[len(panels) :]:
        axes.remove()
    if maps:
        add_keys(figure, maps, lines)
    figure.suptitle(title, fontsize=10, color=GREY)
    save(figure, path)


def _draw(axes, panel, rows):
    from matplotlib.ticker import LogLocator

    axes.set(xscale=panel.scales[0], yscale=panel.scales[1])
    series = {}
    for row in rows:
        series.setdefault(row["series"], []).append(row)
    for k, (label, points) in enumerate(series.items()):
        known = sorted((row["x"], row["value"]) for row in points if row["value"] is not None)
        style = {"color": _COLOURS[k % len(_COLOURS)], "marker": _MARKS[k % len(_MARKS)], "markersize": 4.5}
        # A line joins points only if no law does.
        width = 0.0 if label in panel.follows else 0.8
        axes.plot(*np.array(known).reshape(-1, 2).T, label=label, linewidth=width, fillstyle="none", **style)
    at = [row["x"] for row in rows]
    for (label, law), dashes in zip(panel.laws.items(), ("-", "--", "-.", ":"), strict=False):
        x = _between(min(at), max(at), panel.scales[0])
        axes.plot(x, [law(value) for value in x], dashes, color="0.55", linewidth=1.2, zorder=1.5, label=label)
    for x, label in panel.marks.items():
        axes.axvline(x, color="0.7", linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)
        style = {"ha": "center", "va": "center", "rotation": 90, "fontsize": 7, "color": GREY}
        box = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
        axes.annotate(label, (x, 0.4), xycoords=("data", "axes fraction"), bbox=box, zorder=1, **style)
    if panel.limits:
        axes.set_ylim(panel.limits)
    for axis, scale in zip((axes.xaxis, axes.yaxis), panel.scales, strict=True):
        low, high = axis.get_view_interval()
        if scale == "log" and high < 100.0 * low:  # plain numbers, because there may be no power of ten
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter("{x:g}")
            if high > 10.0 * low:
                axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))  # more labels would overlap
    axes.grid(True, which="major", linewidth=0.3, color="0.85")
    axes.legend(fontsize=7, labelcolor=GREY, framealpha=0.85, edgecolor="none")


def _label(axes, panel):
    axes.set_title(panel.title, fontsize=9, loc="left", color=GREY)
    axes.set_xlabel(panel.x, color=GREY, fontsize=9)
    axes.set_ylabel(panel.y, color=GREY, fontsize=9)
    axes.tick_params(which="both", colors=GREY, labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("0.7")


def _between(low, high, scale):
    """Returns points of a line, equidistant on the axis."""
    return np.geomspace(low, high, 400) if scale == "log" else np.linspace(low, high, 721)
