"""The physics diagram: errors to closed forms by mesh size and cost."""

import math

from ..picture.figures import GREY, number_axis
from .style import LABEL, LEGEND, SMALL, drawn, dress, series_style, small_print


def plot_physics(path, results, facts=None):
    """Plots the error of :func:`physics.measure` over h and over time, two panels for each case, pattern and angle.

    Dashed lines are the effect of a cantilever's free sides and the accuracy of equilibria, below which errors mean nothing.
    Points that failed are named. ``results`` are pairs of arguments and result; without any ValueError is raised.
    """
    rows = {}
    for arguments, found in results:
        rows.setdefault(_title(arguments), {}).setdefault(_label(arguments), []).append((arguments, found))
    if not rows:
        raise ValueError(f"{path}: there are no results; a plot must have one or more")
    across = min(math.ceil(math.sqrt(len(rows) / 2)), 3)
    down = math.ceil(len(rows) / across)
    with drawn(path, 6.0 * across, 2.4 * down + 0.3) as figure:
        panels = figure.subplots(down, 2 * across, squeeze=False, sharey=True).reshape(-1, 2)
        for (left, right), (title, lines) in zip(panels, rows.items(), strict=False):
            for k, (label, points) in enumerate(lines.items()):
                # An error of 0 cannot be drawn on logarithmic axes.
                good = sorted((found["h"], found["error"], found["ms"]) for _, found in points if found["error"])
                style = series_style(k).line | {"markersize": 4, "linewidth": 1.0}
                left.plot([h for h, _, _ in good], [error for _, error, _ in good], label=label, **style)
                timed = sorted((ms, error) for _, error, ms in good if ms is not None)
                if timed:
                    right.plot([ms for ms, _ in timed], [error for _, error in timed], **style)
                for side in {found["sides"] for _, found in points if found["sides"] is not None}:
                    for axes in (left, right):
                        text = "_" if k else "what free sides take"
                        axes.axhline(side, color=series_style(k).colour, linewidth=0.8, linestyle=(0, (4, 3)), label=text)
            _finish(left, right, title, [pair for points in lines.values() for pair in points])
        for (left, right), lines in zip(panels, rows.values(), strict=False):
            _floor(left, right, [found["floor"] for points in lines.values() for _, found in points if found["floor"]])
        for axes in panels[len(rows) :].ravel():
            axes.remove()
        small_print(figure, facts)


def _floor(left, right, floors):
    if not floors:
        return
    (low, high), floor = left.get_ylim(), max(floors)
    for axes in (left, right):
        axes.axhline(floor, color=GREY, linewidth=0.8, linestyle="--", label=f"equilibria are known to {floor:.1g}")
        axes.set_ylim(low, max(high, 2.0 * floor))
    left.legend(**LEGEND)


def _finish(left, right, title, points):
    left.set_title(title, fontsize=LABEL, loc="left", color=GREY)
    left.set_ylabel("relative error")
    left.set_xlabel("h / L")
    right.set_xlabel("time [ms]")
    for axes in (left, right):
        if not any(len(line.get_xdata(orig=True)) for line in axes.lines):  # such as for a cylinder, which needs no solve
            axes.set_axis_off()
            continue
        axes.set(xscale="log", yscale="log")
        dress(axes)
    for axes in (left, right):
        if axes.axison:
            number_axis(axes.xaxis)
    if left.get_legend_handles_labels()[1]:
        left.legend(**LEGEND)
    failed = [f"{_label(a)}, {a['resolution']}: {found['status']}" for a, found in points if found["status"] != "ok"]
    right.set_title("\n".join(failed), fontsize=SMALL, loc="right", color=GREY, parse_math=False)


def _title(arguments):
    if arguments["case"] in ("chain", "catenary"):
        return arguments["case"]
    angle = math.degrees(arguments.get("angle", 0.0))
    return f"{arguments['case']}, {arguments.get('pattern', 'equilateral')} turned by {angle:.3g}°"


def _label(arguments):
    words = [] if arguments["case"] in ("chain", "catenary", "patch") else [arguments.get("bending", "quadratic")]
    if arguments["case"] == "cantilever":
        words.append(f"Γ = {arguments.get('gamma', 1.0):g}")
    names = {"stretching": "stretching {:g}", "width": "width {:g}", "dtype": "{}", "device": "{}"}
    words += [text.format(arguments[name]) for name, text in names.items() if name in arguments]
    return ", ".join(words) or arguments["case"]
