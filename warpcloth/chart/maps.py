"""Maps of stability: a panel for each method, with the limits that theory gives, and the same as a table."""

import csv
import math

import numpy as np

from ..outputs import TEXT, Output
from .axes import AXES, FRAMES
from .figures import GREY, PICTURES, check_path, save
from .rules import DIVERGES, KNOWN

# sRGB. What diverged goes from the dark, at once, to the light, in the last frame; all differ in lightness too, for those who
# do not see red.
_PLAIN = {
    "stable": (0.66, 0.83, 0.93),
    "unsure": (0.66, 0.83, 0.93),
    "inaccurate": (0.98, 0.88, 0.50),
    "stalled": (0.93, 0.62, 0.20),
    "slow": (0.72, 0.72, 0.72),
    "refused": (1.0, 1.0, 1.0),
}
_EARLY, _LATE = np.array([0.42, 0.02, 0.11]), np.array([0.87, 0.47, 0.40])
# Of each rule; black where beyond it a run diverges.
_STYLES = {
    "2/ω_max": "-",
    "2/√(2 Σk/m)": "--",
    "forward Euler": "-.",
    "ω λ_max = 2": (0, (1, 1)),
    "Gauss–Seidel, |z| = 1": (0, (4, 1, 1, 1, 1, 1)),
    "h² = m/(k(L/l − 1))": "-",
    "1 + Σk h²/m iterations": "--",
    "a ring an iteration": "-.",
    KNOWN: (0, (1, 2)),
}
# Of what is stable or inaccurate.
_UNSURE = {"facecolor": _PLAIN["stable"], "edgecolor": _PLAIN["inaccurate"], "hatch": "///", "linewidth": 0.0}
_TICKS = 5


def plot_maps(path, survey, cells):
    """Draws what became of each cell, a panel for each method, and where the rules of :mod:`warpcloth.chart.rules` are 1.

    Args:
        path: The file, .png, .svg or .pdf.
        survey: The :class:`warpcloth.chart.stability.Survey`.
        cells: (setup, y, x) as :meth:`warpcloth.chart.stability.Survey.table` gives them.

    Raises:
        FileNotFoundError: The folder does not exist.
        ImportError: matplotlib is not installed.
        ValueError: The path has another ending.
    """
    check_path(path, PICTURES)
    from matplotlib.figure import Figure

    count = len(survey.setups)
    columns = min(count, 4)
    lines = math.ceil(count / columns)
    figure = Figure(figsize=(max(3.1 * columns, 5.5), 2.7 * lines + 1.3), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel()
    places = [_places(name, values) for name, values in ((survey.x, survey.xs), (survey.y, survey.ys))]
    shown = {}
    for k, (axes, setup, rows) in enumerate(zip(panels, survey.setups, cells, strict=False)):
        axes.pcolormesh(*map(_edges, places), _colours(rows), edgecolors="white", linewidth=0.4)
        _hatch(axes, places, rows)
        for name, dashes in _STYLES.items():
            style = {"colors": "black" if name in DIVERGES else "0.4", "linestyles": [dashes], "linewidths": 1.5}
            if _line(axes, places, rows, name, style):
                shown[name] = style
        axes.set_title(str(setup), fontsize=9, color=GREY)
        for of, name, values, at in zip("xy", (survey.x, survey.y), (survey.xs, survey.ys), places, strict=True):
            few = slice(0, None, math.ceil(len(values) / _TICKS))
            axes.set(**{f"{of}ticks": at[few], f"{of}ticklabels": [f"{value:.2g}" for value in values[few]]})
            if (of == "x" and k >= count - columns) or (of == "y" and k % columns == 0):
                getattr(axes, f"set_{of}label")(AXES[name].label, color=GREY, fontsize=9)
        axes.tick_params(colors=GREY, labelsize=8, labelbottom=k >= count - columns)
    for axes in panels[count:]:
        axes.remove()
    _legend(figure, shown, {cell["verdict"] for rows in cells for row in rows for cell in row})
    rest = ", ".join(f"{name} {value:.4g}" for name, value in survey.fixed.items())
    figure.suptitle(
        f"{survey.scene}, {survey.duration:g} s of motion" + (f", {rest}" if rest else ""),
        fontsize=10,
        color=GREY,
        parse_math=False,
    )
    save(figure, path)


def _places(name, values):
    """Where the values stand along an axis."""
    return np.log10(values) if AXES[name].logarithmic else np.asarray(values, dtype=np.float64)


def _edges(at):
    """Ends of cells about places (n,), (n+1,)."""
    if len(at) == 1:
        return np.array([at[0] - 0.5, at[0] + 0.5])
    middle = 0.5 * (at[1:] + at[:-1])
    return np.concatenate([[2.0 * at[0] - middle[0]], middle, [2.0 * at[-1] - middle[-1]]])


def _colours(rows):
    """sRGB of cells (y, x, 3)."""
    return np.array([[_colour(cell) for cell in row] for row in rows])


def _colour(cell):
    if cell["verdict"] != "diverged":
        return _PLAIN[cell["verdict"]]
    part = 1.0 + math.log(cell["step"] / cell["steps"]) / math.log(FRAMES)
    return _EARLY + min(max(part, 0.0), 1.0) * (_LATE - _EARLY)


def _hatch(axes, places, rows):
    """What is stable or inaccurate in the colours of both."""
    from matplotlib.patches import Rectangle

    across, up = map(_edges, places)
    for j, row in enumerate(rows):
        for i, cell in enumerate(row):
            if cell["verdict"] == "unsure":
                axes.add_patch(Rectangle((across[i], up[j]), across[i + 1] - across[i], up[j + 1] - up[j], **_UNSURE))


def _line(axes, places, rows, name, style):
    """The line where a rule is 1, between the cells; whether there is one."""
    ratios = np.array([[cell["rules"].get(name) or np.nan for cell in row] for row in rows], dtype=float)
    if min(ratios.shape) < 2:
        return False
    heights = np.log10(ratios)
    if not (np.nanmin(heights, initial=np.inf) < 0.0 < np.nanmax(heights, initial=-np.inf)):
        return False
    axes.contour(*places, np.ma.masked_invalid(heights), levels=[0.0], **style)
    return True


def _legend(figure, shown, verdicts):
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    entries = [
        Patch(**_UNSURE, label="stable or inaccurate")
        if verdict == "unsure"
        else Patch(fc=colour, ec=GREY, lw=0.5, label=verdict)
        for verdict, colour in _PLAIN.items()
        if verdict in verdicts
    ]
    if "diverged" in verdicts:
        entries += [Patch(color=_EARLY, label="diverged at once"), Patch(color=_LATE, label="in the end")]
    entries += [
        Line2D([], [], color=style["colors"], linestyle=style["linestyles"][0], label=name) for name, style in shown.items()
    ]
    figure.legend(handles=entries, loc="outside lower center", ncols=4, frameon=False, fontsize=8, labelcolor=GREY)


def write_table(path, survey, cells):
    """A line for each cell: method, axes, verdict, step of divergence, steps of the run, growth, error, floor, rules, reason.

    The last column is the machine, if known.

    Raises:
        FileNotFoundError: The folder does not exist.
    """
    names = list(dict.fromkeys(name for rows in cells for row in rows for cell in row for name in cell["rules"]))
    plain = ("verdict", "step", "steps", "growth", "error", "floor")
    with Output(path, "x", **TEXT) as output:
        table = csv.writer(output.file, lineterminator="\n")
        table.writerow(["method", survey.x, survey.y, *plain, *names, "reason", "machine"])
        for setup, rows in zip(survey.setups, cells, strict=True):
            for y, row in zip(survey.ys, rows, strict=True):
                for x, cell in zip(survey.xs, row, strict=True):
                    values = [cell[name] for name in plain] + [cell["rules"].get(name) for name in names]
                    ends = cell["reason"], cell.get("machine", "")
                    table.writerow([str(setup), x, y, *("" if v is None else v for v in values), *ends])
