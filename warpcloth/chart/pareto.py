"""Draws speed against accuracy with the Pareto front, and the convergence of methods."""

import textwrap

from ..lab.measurements import usable
from ..lab.work_precision import WITHIN, cheapest, front, quartiles, without_point
from ..numerics.integrators import INTEGRATORS
from ..others.simulators import SIMULATORS, shown_name
from ..picture.figures import GREY, PICTURES, check_path, number_axis, save
from .style import DASHES, LABEL, LEGEND, SMALL, dress, headline, name_all_ends, series_style, small_print, style_of

_CROSS = {"marker": "x", "markersize": 8, "color": "black", "markeredgewidth": 0.8}  # over points of runs that are not usable
_WIDTH, _LINES = 46, 48  # characters and lines of the texts beside a picture
# Errors of a motion, with the labels of their axes.
_ERRORS = {
    "error": "error: RMS of all vertices and frames, over the size",
    "strain_error": "error of strains: 99th percentile of edges and frames",
}


def plot_time(path, found):
    """Draws the error of each setting of :func:`warpcloth.lab.work_precision.time_diagram` over its time, with the scatter of
    times.

    Panels show errors of positions and the 99th percentile of errors of strains. Settings that no other beats beyond the spread
    are joined, numbered and named; those without an error are named with the reason; runs that are not usable are crossed. A
    line is the error of the reference, below which points mean nothing. For other simulators, dots are errors relative to the
    motion to which they converge.
    """
    rows, reference = found["rows"], found["reference"]
    curves = {name: front(rows, reference[name], name) for name in _ERRORS}
    best = sorted(set().union(*curves.values()), key=lambda i: rows[i]["ms_per_second"])
    texts = [f"{number}  {rows[i]['label']}{_doubt(rows[i])}" for number, i in enumerate(best, 1)]
    texts += [
        "",
        f"cheapest within {100.0 * WITHIN:g} %:",
        *(row["label"] + _doubt(row) for row in cheapest(rows, reference["error"])),
    ]
    texts += _missing("not drawn:", found)
    figure, panels, notes = _figure(path, texts)
    lines = {}
    for row in rows:
        if row["status"] == "ok":
            lines.setdefault((row["solver"], row["options"].get("integrator", "euler")), []).append(row)
    ends, dashes = {axes: [] for axes in panels}, dict(zip(INTEGRATORS, DASHES, strict=False))
    for (solver, integrator), line in lines.items():
        line.sort(key=lambda row: row["ms_per_second"])
        style = style_of(solver)
        own = [(row["ms_per_second"], row["own_error"]) for row in line if row.get("own_error") is not None]
        if own:
            panels[0].plot(*zip(*own, strict=True), ".", color=style.colour, markersize=5, linestyle=":", linewidth=0.7)
        for axes, error in zip(panels, _ERRORS, strict=True):
            x, y = ([row[of] for row in line] for of in ("ms_per_second", error))
            axes.plot(x, y, dashes.get(integrator, "-"), color=style.colour, linewidth=0.7, alpha=0.6)
            axes.hlines(y, *zip(*map(quartiles, line), strict=True), color=style.colour, linewidth=2.5, alpha=0.45)
            axes.plot(x, y, linestyle="none", markersize=5, **style.line)
            crossed = [point for point, row in zip(zip(x, y, strict=True), line, strict=True) if not usable(row)]
            if crossed:
                axes.plot(*zip(*crossed, strict=True), linestyle="none", label="not usable", **_CROSS)
            name = shown_name(solver) if integrator == "euler" else f"{solver} {integrator}"
            ends[axes].append((x[-1], y[-1], name, style.colour))
    for axes, (name, text) in zip(panels, _ERRORS.items(), strict=True):
        x, y = ([rows[i][of] for i in curves[name]] for of in ("ms_per_second", name))
        axes.plot(x, y, color="gold", linewidth=5.0, zorder=0, label="nothing is better in both")
        for i in curves[name]:
            point, below = (rows[i]["ms_per_second"], rows[i][name]), {"ha": "right", "va": "top", "fontsize": LABEL}
            axes.annotate(str(best.index(i) + 1), point, (-4, -4), textcoords="offset points", **below)
        axes.plot([], [], color=GREY, linewidth=2.5, alpha=0.45, label="scatter of the times")
        if found.get("others"):
            label = "from the solver's own converged motion"
            axes.plot([], [], ".", color=GREY, markersize=5, linestyle=":", linewidth=0.7, label=label)
        _floor(axes, reference[name], "error of the reference")
        axes.set(xlabel="ms for a second of motion", ylabel=text)
    title = f"{found['scene']}, {found['frames']} frames, {found['dtype']}"
    _finish(figure, panels, notes, title, texts, found)
    name_all_ends(figure, [(axes, of) for axes, of in ends.items() if of])
    save(figure, path)


def plot_solver(path, found):
    """Draws the gap of a step's objective, of :func:`warpcloth.lab.work_precision.solver_diagram`, over iterations and time."""
    texts = _missing("ended early:", found)
    figure, panels, notes = _figure(path, texts)
    seen, floor = {}, max((row["floor"] for row in found["rows"]), default=None)
    for row in found["rows"]:
        dashes = DASHES[seen.setdefault(row["solver"], 0) % len(DASHES)]
        seen[row["solver"]] += 1
        if not row["points"]:
            continue
        for axes, name in zip(panels, ("iterations", "ms"), strict=True):
            x, y = ([point[name] for point in row["points"]], [max(point["gap"], floor) for point in row["points"]])
            style = style_of(row["solver"]).line
            axes.plot(x, y, linestyle=dashes, markersize=3, linewidth=1.0, label=row["label"], **style)
    for axes, text in zip(panels, ("iterations", "ms of the step"), strict=True):
        axes.set(xlabel=text)
        if floor is not None:
            _floor(axes, floor, "rounding of the objective")
    panels[0].set_ylabel("gap of the objective, 1 at x̃")
    step = f"a step of 1/{found['rate']:g} s after {found['frame']} frames"
    title = f"{found['scene']}, {step}, {found['dtype']}"
    _finish(figure, panels, notes, title, texts, found)
    save(figure, path)


def plot_spectrum(path, found):
    """Draws μ over its rank, and measured errors on lines predicted by the spectrum."""
    texts = _missing("not drawn:", found)
    figure, panels, notes = _figure(path, texts)
    good = [row for row in found["rows"] if row["points"]]
    for k, row in enumerate(good):
        mu, colour, points = row["eigenvalues"], series_style(k).colour, row["points"]
        panels[0].plot(range(1, len(mu) + 1), mu, color=colour, linewidth=1.2)
        at, errors = ([point[name] for point in points] for name in ("iterations", "error"))
        panels[1].plot(
            at, errors, "o", color=colour, markersize=3, label=f"{row['label']}: max |1 − μ| = {row['contraction']:.4f}"
        )
        known = [point for point in points if point["predicted"] is not None]
        at, errors = ([point[name] for point in known] for name in ("iterations", "predicted"))
        panels[1].plot(at, errors, color=colour, linewidth=0.8)
    for k, row in enumerate(good):
        _floor(panels[1], row["floor"], "rounding of the positions", series_style(k).colour)
    panels[0].set(xlabel="rank", ylabel="eigenvalue μ of the Hessian relative to the matrix")
    panels[1].set(xlabel="iterations", ylabel="error, 1 at x̃; lines: by the spectrum")
    title = f"{found['scene']}, steps after {found['frame']} frames, plain projective dynamics"
    _finish(figure, panels, notes, title, texts, found)
    save(figure, path)


def _doubt(row):
    return "" if usable(row) else ", not usable"


def _floor(axes, value, label, colour=GREY):
    axes.axhline(value, color=colour, linestyle="--", linewidth=0.8, label=label)


def _missing(head, found):
    lines = [line for each in without_point(found) for line in textwrap.wrap(": ".join(each), _WIDTH, subsequent_indent="  ")]
    return ["", head, *lines] if lines else []


def _figure(path, texts):
    check_path(path, PICTURES)
    from matplotlib.figure import Figure

    if len(texts) > _LINES:
        texts[_LINES:] = [f"… {len(texts) - _LINES} lines more in the table"]
    height = max(4.6, 0.135 * (len(texts) + 14))
    figure = Figure(figsize=(11.0, height), layout="constrained")
    *axes, notes = figure.subplots(1, 3, width_ratios=[1.7, 1.7, 1.0])
    for each in axes:
        each.set(xscale="log", yscale="log")
    notes.axis("off")
    return figure, axes, notes


def _finish(figure, axes, notes, title, texts, found):
    known = {}
    for each in axes:
        number_axis(each.xaxis)
        dress(each)
        known.update(zip(*reversed(each.get_legend_handles_labels()), strict=True))
    notes.legend(known.values(), known, loc="upper left", borderaxespad=0.0, **LEGEND)
    top = 1.0 - 0.17 * (len(known) + 1) / figure.get_size_inches()[1]
    notes.text(0.0, top, "\n".join(texts), fontsize=SMALL, color=GREY, va="top", transform=notes.transAxes, parse_math=False)
    headline(figure, title)
    named = [name for name, each in SIMULATORS.items() if set(each.solvers) & {row.get("solver") for row in found["rows"]}]
    small_print(figure, found["machine"], others=named)
