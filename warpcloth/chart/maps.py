"""Draws maps of stability, a panel for each method, and writes them as a table."""

import math

import numpy as np

from ..base.outputs import write_table
from ..lab.axes import AXES
from ..lab.cells import FRAMES
from ..lab.stability_limits import DIVERGES, KNOWN
from ..picture.figures import GREY
from .style import BAD, DOUBTFUL, GOOD, add_legend, drawn, dress, headline, small_print, title_style

# sRGB colours. Divergence goes from dark, at once, to light, in the last frame. All differ in lightness too, for people who do
# not see red.
_PLAIN = {
    "stable": GOOD,
    "unsure": GOOD,
    "inaccurate": (0.98, 0.88, 0.50),
    "stalled": DOUBTFUL,
    "slow": (0.72, 0.72, 0.72),
    "refused": (1.0, 1.0, 1.0),
}
_EARLY, _LATE = np.array(BAD), np.array([0.87, 0.47, 0.40])
# Line style and label of each rule; lines are black if runs diverge beyond them.
_STYLES = {
    "2/ω_max": ("-", "largest stable step about the rest shape"),
    "2/√(2 Σk/m)": ("--", "stable in any motion"),
    "forward Euler": ("-.", "energy grows tenfold in the run"),
    "ω λ_max = 2": ((0, (1, 1)), "Jacobi sweeps overshoot beyond"),
    "Gauss–Seidel, |z| = 1": ((0, (4, 1, 1, 1, 1, 1)), "sweeps in their order overshoot beyond"),
    "h² = m/(k(L/l − 1))": ("-", "beyond, a step has several minima"),
    "1 + Σk h²/m iterations": ("--", "needed across stiff springs"),
    "a ring an iteration": ("-.", "beyond, the pins do not reach every vertex"),
    "r = 1/(2hω)": ((0, (5, 1)), "the weight that converges fastest"),
    KNOWN: ((0, (1, 2)), "beyond, the reference is less accurate"),
}
# Hatching of cells that are stable or inaccurate.
_UNSURE = {"facecolor": _PLAIN["stable"], "edgecolor": _PLAIN["inaccurate"], "hatch": "///", "linewidth": 0.0}
_TICKS = 4


def plot_maps(path, survey, cells, accuracy=None, facts=None):
    """Draws the verdict of each cell of :meth:`warpcloth.lab.stability.Survey.table`, (setup, y, x), a panel for each method.

    Lines are where :mod:`warpcloth.lab.stability_limits` are 1; ``accuracy`` is the error above which cells are inaccurate, or
    None.
    """
    count = len(survey.setups)
    columns = min(count, 4)
    lines = math.ceil(count / columns)
    with drawn(path, max(2.5 * columns, 6.0), 2.3 * lines + 1.6) as figure:
        panels = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel()
        coordinates = [_coordinates(name, values) for name, values in ((survey.x, survey.xs), (survey.y, survey.ys))]
        shown = {}
        for k, (axes, setup, rows) in enumerate(zip(panels, survey.setups, cells, strict=False)):
            axes.pcolormesh(*map(edges, coordinates), _colours(rows), edgecolors="white", linewidth=0.4)
            _hatch(axes, coordinates, rows)
            for name, (dashes, _) in _STYLES.items():
                style = {"colors": "black" if name in DIVERGES else "0.4", "linestyles": [dashes], "linewidths": 1.5}
                if _line(axes, coordinates, rows, name, style):
                    shown[name] = style
            axes.set_title(str(setup), **title_style(str(setup)))
            for of, name, values, at in zip("xy", (survey.x, survey.y), (survey.xs, survey.ys), coordinates, strict=True):
                ticks, numbers = _ticks(name, values, at)
                axes.set(**{f"{of}ticks": ticks, f"{of}ticklabels": numbers})
                if (of == "x" and k >= count - columns) or (of == "y" and k % columns == 0):
                    getattr(axes, f"set_{of}label")(AXES[name].label)
            dress(axes, grid=False)
            axes.tick_params(labelbottom=k >= count - columns)
        for axes in panels[count:]:
            axes.remove()
        _legend(figure, shown, {cell["verdict"] for rows in cells for row in rows for cell in row}, accuracy)
        rest = ", ".join(f"{name} {value:.4g}" for name, value in survey.fixed.items())
        headline(figure, f"{survey.scene}, {survey.duration:g} s of motion" + (f", {rest}" if rest else ""))
        small_print(figure, facts)


def _coordinates(name, values):
    return np.log10(values) if AXES[name].logarithmic else np.asarray(values, dtype=np.float64)


def _ticks(name, values, at):
    if AXES[name].logarithmic and at[-1] - at[0] >= 1.0:
        powers = np.arange(math.ceil(at[0] - 1e-6), at[-1] + 1e-6)
        powers = powers[:: math.ceil(len(powers) / _TICKS)]
        return powers, [f"{10.0**power:g}" if abs(power) < 4 else f"$10^{{{power:.0f}}}$" for power in powers]
    few = slice(0, None, math.ceil(len(values) / _TICKS))
    return at[few], [f"{value:.3g}" for value in values[few]]


def edges(at):
    """Returns the edges of cells (n+1,) around coordinates (n,)."""
    if len(at) == 1:
        return np.array([at[0] - 0.5, at[0] + 0.5])
    middle = 0.5 * (at[1:] + at[:-1])
    return np.concatenate([[2.0 * at[0] - middle[0]], middle, [2.0 * at[-1] - middle[-1]]])


def _colours(rows):
    return np.array([[_colour(cell) for cell in row] for row in rows])


def _colour(cell):
    if cell["verdict"] != "diverged":
        return _PLAIN[cell["verdict"]]
    part = 1.0 + math.log(cell["step"] / cell["steps"]) / math.log(FRAMES)
    return _EARLY + min(max(part, 0.0), 1.0) * (_LATE - _EARLY)


def _hatch(axes, coordinates, rows):
    from matplotlib.patches import Rectangle

    across, up = map(edges, coordinates)
    for j, row in enumerate(rows):
        for i, cell in enumerate(row):
            if cell["verdict"] == "unsure":
                axes.add_patch(Rectangle((across[i], up[j]), across[i + 1] - across[i], up[j + 1] - up[j], **_UNSURE))


def _line(axes, coordinates, rows, name, style):
    ratios = np.array([[cell["rules"].get(name) or np.nan for cell in row] for row in rows], dtype=float)
    if min(ratios.shape) < 2:
        return False
    heights = np.log10(ratios)
    if not (np.nanmin(heights, initial=np.inf) < 0.0 < np.nanmax(heights, initial=-np.inf)):
        return False
    axes.contour(*coordinates, np.ma.masked_invalid(heights), levels=[0.0], **style)
    return True


def _legend(figure, shown, verdicts, accuracy):
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    said = {"unsure": "stable or inaccurate, not known"}
    if accuracy:
        said["inaccurate"] = f"inaccurate: off by more than {100.0 * accuracy:g} % of the size"
    entries = [
        Patch(**_UNSURE, label=said[verdict])
        if verdict == "unsure"
        else Patch(fc=colour, ec=GREY, lw=0.5, label=said.get(verdict, verdict))
        for verdict, colour in _PLAIN.items()
        if verdict in verdicts
    ]
    if "diverged" in verdicts:
        entries += [Patch(color=_EARLY, label="diverged at once"), Patch(color=_LATE, label="diverged in the end")]
    entries += [
        Line2D([], [], color=style["colors"], linestyle=style["linestyles"][0], label=f"{name}: {_STYLES[name][1]}")
        for name, style in shown.items()
    ]
    columns = 3 if figure.get_size_inches()[0] > 9.0 else 2 if figure.get_size_inches()[0] > 8.0 else 1
    add_legend(figure, entries, columns)


def write_csv(path, survey, cells):
    """Writes a line for each cell of the maps.

    Columns: method, axes, verdict, step of divergence, steps of the run, growth, error, floor, rules, reason, and the machine,
    if known.

    Raises:
        FileNotFoundError: The folder does not exist.
    """
    names = list(dict.fromkeys(name for rows in cells for row in rows for cell in row for name in cell["rules"]))
    plain = ("verdict", "step", "steps", "growth", "error", "floor")

    def lines():
        for setup, rows in zip(survey.setups, cells, strict=True):
            for y, row in zip(survey.ys, rows, strict=True):
                for x, cell in zip(survey.xs, row, strict=True):
                    ratios = [cell["rules"].get(name) for name in names]
                    yield [str(setup), x, y, *(cell[name] for name in plain), *ratios, cell["reason"], cell.get("machine")]

    write_table(path, ["method", survey.x, survey.y, *plain, *names, "reason", "machine"], lines())
