"""Draws measured points with laws as lines, for charts of failures."""

import math

import numpy as np

from ..lab.panels import Map
from ..picture.figures import GREY, number_axis
from .panel_maps import add_keys, draw_map
from .style import (
    DASHES,
    LEGEND,
    SMALL,
    drawn,
    dress,
    headline,
    name_all_ends,
    series_style,
    small_print,
    solver_in,
    style_of,
    title_style,
)

_LAW = "0.55"  # grey of laws
_FAR = 16.0  # from a line to its name [pt]; beyond, a legend is easier to read


def plot_panels(path, panels, rows, title, facts):
    """Draws :class:`warpcloth.lab.panels.Panel` records: points as markers or cells, and laws as lines."""
    across = 4 if len(panels) > 9 else 2 if len(panels) == 4 else min(len(panels), 3)
    down = math.ceil(len(panels) / across)
    width, height = (3.8, 3.2) if any(isinstance(panel, Map) for panel in panels) else (5.0, 4.1)
    with drawn(path, width * across, height * down + 0.3) as figure:
        figure.get_layout_engine().set(w_pad=0.12, h_pad=0.1)
        grid, maps, lines, named = figure.subplots(down, across, squeeze=False).ravel(), [], {}, []
        for axes, panel in zip(grid, panels, strict=False):
            of = [row for row in rows if row["panel"] == panel.key]
            if isinstance(panel, Map):
                maps.append((axes, panel, draw_map(axes, panel, of, lines)))
            else:
                named.append((axes, _draw(axes, panel, of)))
            axes.set_title(panel.title, loc="left", **title_style(panel.title))
            axes.set(xlabel=panel.x, ylabel=panel.y)
            dress(axes, grid=not isinstance(panel, Map))
        for axes in grid[len(panels) :]:
            axes.remove()
        if maps:
            add_keys(figure, maps, lines)
        headline(figure, title)
        small_print(figure, facts)
        for (axes, _ends), legible in zip(named, name_all_ends(figure, named, _FAR), strict=True):
            if not legible:
                axes.legend(**LEGEND | {"frameon": True}, framealpha=0.85, edgecolor="none")


def _draw(axes, panel, rows):
    from matplotlib.ticker import LogLocator

    axes.set(xscale=panel.scales[0], yscale=panel.scales[1])
    series, ends = {}, []
    for row in rows:
        series.setdefault(row["series"], []).append(row)
    for k, (label, points) in enumerate(series.items()):
        known = sorted((row["x"], row["value"]) for row in points if row["value"] is not None)
        style = style_of(solver_in(label)) if solver_in(label) else series_style(k)
        # A line joins points only if no law does.
        width = 0.0 if label in panel.follows else 0.8
        looks = style.line | {"fillstyle": "none", "markersize": 4.5}
        axes.plot(*np.array(known).reshape(-1, 2).T, label=label, linewidth=width, **looks)
        ends += [(*known[-1], label, style.colour)] if known else []
    at = [row["x"] for row in rows]
    for (label, law), dashes in zip(panel.laws.items(), DASHES, strict=False):
        x = _between(min(at), max(at), panel.scales[0])
        y = [law(value) for value in x]
        axes.plot(x, y, linestyle=dashes, color=_LAW, linewidth=1.2, zorder=1.5, label=label)
        ends.append((x[-1], y[-1], label, _LAW))
    for x, label in panel.marks.items():
        axes.axvline(x, color="0.7", linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)
        style = {"ha": "center", "va": "center", "rotation": 90, "fontsize": SMALL, "color": GREY}
        box = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
        axes.annotate(label, (x, 0.4), xycoords=("data", "axes fraction"), bbox=box, zorder=1, **style)
    if panel.limits:
        axes.set_ylim(panel.limits)
    if panel.scales[0] == "log":
        number_axis(axes.xaxis)
    low, high = axes.get_ylim()
    if panel.scales[1] == "log" and high < 100.0 * low:  # plain numbers, because there may be no power of ten
        axes.yaxis.set(major_formatter="{x:g}", minor_formatter="{x:g}")
        if high > 10.0 * low:
            axes.yaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))  # more labels would overlap
    return ends


def _between(low, high, scale):
    return np.geomspace(low, high, 400) if scale == "log" else np.linspace(low, high, 721)
