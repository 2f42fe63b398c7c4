"""Pictures of speed against accuracy: settings as points with what nothing beats, and methods as lines towards a minimum."""

import textwrap

from .figures import GREY, PICTURES, check_path, save
from .work_precision import left_out

# Each solver has its colour and marker in every picture.
_STYLES = {
    "explicit": ("tab:gray", "s"),
    "newton": ("black", "o"),
    "projective-dynamics": ("tab:blue", "^"),
    "admm": ("tab:cyan", "v"),
    "pbd": ("tab:pink", "D"),
    "hierarchical-pbd": ("tab:purple", "P"),
    "xpbd": ("tab:red", "X"),
    "constrained-dynamics": ("tab:green", "p"),
}
_DASHES = ("-", "--", ":", "-.")
_WIDTH, _LINES = 52, 60  # of the texts beside a picture


def plot_time(path, found):
    """Draws the error of each setting over its time, those that nothing beats as a numbered line with their names beside it.

    What has no error is named with the reason; the error of the reference solution is a line that no point below means
    anything.

    Args:
        path: The file, .png, .svg or .pdf.
        found: As :func:`warpcloth.chart.work_precision.time_diagram` returns it.

    Raises:
        FileNotFoundError: The folder does not exist.
        ImportError: matplotlib is not installed.
        ValueError: The path has another ending.
    """
    figure, (axes,), notes = _figure(path, found, 1)
    lines = {}
    for row in found["rows"]:
        if row["status"] == "ok":
            lines.setdefault((row["solver"], row["options"].get("integrator")), []).append(row)
    for (solver, _), rows in lines.items():
        rows.sort(key=lambda row: row["ms_per_second"])
        colour, marker = _STYLES[solver]
        x, y = ([row[name] for row in rows] for name in ("ms_per_second", "error"))
        axes.plot(x, y, color=colour, linewidth=0.5, alpha=0.6)
        axes.plot(x, y, marker, color=colour, markersize=5, linestyle="none", label=solver)
    best = sorted((row for row in found["rows"] if row.get("front")), key=lambda row: row["ms_per_second"])
    x, y = ([row[name] for row in best] for name in ("ms_per_second", "error"))
    axes.plot(x, y, color="gold", linewidth=4.0, zorder=0, label="nothing is better in both")
    for number, row in enumerate(best, 1):
        place = (row["ms_per_second"], row["error"])
        axes.annotate(str(number), place, (-4, -4), textcoords="offset points", ha="right", va="top", fontsize=8)
    axes.axhline(found["reference"]["error"], color=GREY, linestyle="--", linewidth=0.8, label="error of the reference")
    axes.set(xlabel="ms for a second of motion", ylabel="error: RMS of all vertices and frames, over the size")
    title = f"{found['scene']}, {found['frames']} frames, {found['dtype']}, {found['machine']['device']}"
    names = [f"{number}  {row['label']}" for number, row in enumerate(best, 1)]
    _finish(figure, [axes], notes, title, names, found)
    save(figure, path)


def plot_solver(path, found):
    """Draws the gap that methods leave of a step over their iterations and over their time, down to what float64 tells.

    Args:
        path: The file, .png, .svg or .pdf.
        found: As :func:`warpcloth.chart.work_precision.solver_diagram` returns it.

    Raises:
        FileNotFoundError: The folder does not exist.
        ImportError: matplotlib is not installed.
        ValueError: The path has another ending.
    """
    figure, panels, notes = _figure(path, found, 2)
    seen, floor = {}, max((row["floor"] for row in found["rows"]), default=None)
    for row in found["rows"]:
        colour, marker = _STYLES[row["solver"]]
        style = _DASHES[seen.setdefault(row["solver"], 0) % len(_DASHES)]
        seen[row["solver"]] += 1
        for axes, name in zip(panels, ("iterations", "ms"), strict=True):
            x, y = ([point[name] for point in row["points"]], [max(point["gap"], floor) for point in row["points"]])
            axes.plot(x, y, style, marker=marker, color=colour, markersize=3, linewidth=1.0, label=row["label"])
    for axes, text in zip(panels, ("iterations", "ms of the step"), strict=True):
        axes.set(xlabel=text)
        if floor is not None:
            axes.axhline(floor, color=GREY, linestyle="--", linewidth=0.8, label="rounding of the objective")
    panels[0].set_ylabel("gap of the objective, 1 at x̃")
    step = f"a step of 1/{found['rate']:g} s after {found['frame']} frames"
    title = f"{found['scene']}, {step}, {found['dtype']}, {found['machine']['device']}"
    _finish(figure, panels, notes, title, [], found)
    save(figure, path)


PLOTS = {"solver": plot_solver, "time": plot_time}


def _figure(path, found, panels):
    """A figure with panels on logarithmic scales, and one for texts."""
    check_path(path, PICTURES)
    from matplotlib.figure import Figure

    lines = len(found["rows"]) + sum(len(_wrapped(*each)) for each in left_out(found))
    figure = Figure(figsize=(4.6 * panels + (4.0 if panels == 1 else 3.4), min(max(5.0, 0.12 * lines + 2.0), 10.0)))
    figure.set_layout_engine("constrained")
    *axes, notes = figure.subplots(1, panels + 1, sharey=False, width_ratios=[1.6] * panels + [1.0])
    for each in axes:
        each.set(xscale="log", yscale="log")
        each.grid(True, which="major", linewidth=0.3, color="0.8")
        each.tick_params(colors=GREY, labelsize=8)
        each.spines[["top", "right"]].set_visible(False)
    notes.axis("off")
    return figure, axes, notes


def _finish(figure, axes, notes, title, names, found):
    """Legend, names and what is left out, beside the picture."""
    known = {}
    for each in axes:
        known.update(zip(*reversed(each.get_legend_handles_labels()), strict=True))
    shown = {"loc": "upper left", "frameon": False, "fontsize": 7, "borderaxespad": 0.0, "ncols": 1}
    notes.legend(known.values(), known, **shown)
    texts = list(names)
    missing = left_out(found)
    if missing:
        texts += ["", "not drawn:" if len(axes) == 1 else "ended early:"]
        for each in missing:
            texts += _wrapped(*each)
    if len(texts) > _LINES:
        texts = [*texts[:_LINES], f"… {len(texts) - _LINES} lines more in the table"]
    top = 1.0 - 0.155 * (len(known) + 1) / figure.get_size_inches()[1]
    notes.text(0.0, top, "\n".join(texts), fontsize=7, color=GREY, va="top", transform=notes.transAxes, parse_math=False)
    figure.suptitle(title, fontsize=9, color=GREY)


def _wrapped(name, reason):
    return textwrap.wrap(f"{name}: {reason}", _WIDTH, subsequent_indent="  ")
