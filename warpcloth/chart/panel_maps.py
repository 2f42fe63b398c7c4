"""Draws maps in charts of failures: cells by value or series, laws as lines."""

import numpy as np

from ..picture.figures import GREY
from .maps import edges
from .style import BAD, DASHES, DOUBTFUL, GOOD, LABEL, TICK, add_legend

_KINDS = (GOOD, DOUBTFUL, BAD)
_CROSS = "#E0105A"
_REFUSED = {"facecolor": "white", "edgecolor": "0.8", "hatch": "////"}


def draw_map(axes, panel, rows, lines):
    """Draws the cells and laws of a :class:`warpcloth.lab.panels.Map`; returns cells for a colour bar, or None if coloured by
    series.
    """
    xs, ys = (sorted({row[name] for row in rows}) for name in "xy")
    values, crossed = np.full((len(ys), len(xs)), np.nan), []
    for row in rows:
        shown = panel.kinds.index(row["series"]) if panel.kinds else row["value"]
        values[ys.index(row["y"]), xs.index(row["x"])] = np.nan if shown is None else shown
        crossed += [(row["x"], row["y"])] if row["series"] == panel.crossed else []
    corners = [_edges(np.array(each), scale) for each, scale in zip((xs, ys), panel.scales, strict=True)]
    axes.set(xscale=panel.scales[0], yscale=panel.scales[1])
    axes.patch.set(**_REFUSED)
    style = {"edgecolors": "white", "linewidth": 0.3}
    if panel.kinds:
        from matplotlib.colors import ListedColormap

        style |= {"cmap": ListedColormap(_KINDS[: len(panel.kinds)]), "vmin": -0.5, "vmax": len(panel.kinds) - 0.5}
    else:
        style |= {"cmap": panel.colours, "vmin": 0.0, "vmax": 100.0}
    cells = axes.pcolormesh(*corners, np.ma.masked_invalid(values), **style)
    x = np.geomspace(xs[0], xs[-1], 200) if panel.scales[0] == "log" else np.linspace(xs[0], xs[-1], 200)
    for label, law in panel.laws.items():
        dashes = lines.setdefault(label, DASHES[len(lines) % len(DASHES)])
        axes.plot(x, [law(value) for value in x], linestyle=dashes, color="black", linewidth=1.2)
    if crossed:
        axes.plot(*np.array(crossed).T, "x", color=_CROSS, markersize=5.0)
    axes.set_xlim(corners[0][0], corners[0][-1])
    axes.set_ylim(corners[1][0], corners[1][-1])
    return None if panel.kinds else cells


def _edges(values, scale):
    return 10.0 ** edges(np.log10(values)) if scale == "log" else edges(values)


def add_keys(figure, maps, lines):
    """Adds colour bars, one for maps (axes, panel, cells) of the same colours, and a legend of lines, kinds and crosses."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    bars = {}
    for axes, panel, cells in maps:
        if cells is not None:
            bars.setdefault((panel.value, panel.colours), (cells, []))[1].append(axes)
    for (label, _colours), (cells, group) in bars.items():
        bar = figure.colorbar(cells, ax=group, pad=0.01, aspect=8.0 * len(group) ** 0.5)
        bar.set_label(label, color=GREY, fontsize=LABEL)
        bar.ax.tick_params(colors=GREY, labelsize=TICK)
        bar.outline.set_visible(False)
    keys = [Line2D([], [], color="black", linestyle=dashes, label=label) for label, dashes in lines.items()]
    kinds = dict.fromkeys(kind for _, panel, _ in maps for kind in panel.kinds)
    keys += [Patch(color=colour, label=kind) for kind, colour in zip(kinds, _KINDS, strict=False)]
    for crossed in dict.fromkeys(panel.crossed for _, panel, _ in maps if panel.crossed):
        keys.append(Line2D([], [], color=_CROSS, marker="x", linestyle="", label=f"a sheet {crossed}"))
    keys += [Patch(**_REFUSED, label="refused")] * any(cells is not None for *_, cells in maps)
    add_legend(figure, keys, min(len(keys), 8))
