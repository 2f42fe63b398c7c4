"""Draws speed against accuracy with the Pareto front, and the convergence of methods."""

from contextlib import contextmanager

from ..lab.measurements import usable
from ..lab.work_precision import WITHIN, cheapest, front, quartiles
from ..others.simulators import SIMULATORS, shown_name
from ..picture.figures import GREY, number_axis
from .style import DASHES, LEGEND, SMALL, drawn, dress, headline, series_style, small_print, style_of

_CROSS = {"marker": "x", "markersize": 8, "color": "black", "markeredgewidth": 0.8}  # over points of runs that are not usable
_LINES = 48  # of the texts beside a picture
# Errors of a motion, with the labels of their axes.
_ERRORS = {
    "error": "error: RMS of all vertices and frames, over the size",
    "strain_error": "error of strains: 99th percentile of edges and frames",
}


def plot_time(path, found, every=False):
    """Draws the errors of :func:`warpcloth.lab.work_precision.time_diagram` over time, with the scatter of times.

    Panels show errors of positions and the 99th percentile of errors of strains: of each solver the settings that none of its
    own beats, over all integrators, and the Pareto front of all. ``every`` other setting is a dot too. Runs that are not usable
    are crossed. A line is the error of the reference, below which points mean nothing. For other simulators, dots are errors
    relative to the motion to which they converge.
    """
    rows, reference = found["rows"], found["reference"]
    known = [row for row in rows if row["status"] == "ok"]
    best = front(rows, reference["error"])
    texts = ["Pareto front of the error:", *(_named(rows[i]) for i in best), "", f"cheapest within {100.0 * WITHIN:g} %:"]
    texts += [*map(_named, cheapest(rows, reference["error"])), *_missing(found)]
    with _panels(path, found, f"{found['scene']}, {found['frames']} frames, {found['dtype']}", texts) as panels:
        for axes, (error, text) in zip(panels, _ERRORS.items(), strict=True):
            for solver in dict.fromkeys(row["solver"] for row in known):
                mine, style = [row for row in known if row["solver"] == solver], style_of(solver)
                line = [mine[i] for i in front(mine, reference[error], error)]
                _curve(axes, line, error, style, shown_name(solver))
                if every:
                    axes.plot(*_points(mine, error), ".", color=style.colour, markersize=3, alpha=0.4, zorder=1)
                own = [row for row in mine if row.get("own_error") is not None]
                if own and error == "error":
                    label = "from the solver's own converged motion"
                    axes.plot(*_points(own, "own_error"), ":.", color=style.colour, markersize=5, linewidth=0.7, label=label)
            curve = [rows[i] for i in front(rows, reference[error], error)]
            axes.plot(*_points(curve, error), color="gold", linewidth=5.0, zorder=0, label="Pareto front")
            axes.plot([], [], color=GREY, linewidth=2.5, alpha=0.45, label="scatter of the times")
            _floor(axes, reference[error], "error of the reference")
            axes.set(xlabel="ms for a second of motion", ylabel=text)


def _curve(axes, line, error, style, label):
    x, y = _points(line, error)
    axes.plot(x, y, linewidth=1.0, markersize=5, label=label, **style.line)
    axes.hlines(y, *zip(*map(quartiles, line), strict=True), color=style.colour, linewidth=2.5, alpha=0.45)
    crossed = [row for row in line if not usable(row)]
    if crossed:
        axes.plot(*_points(crossed, error), linestyle="none", label="not usable", **_CROSS)


def _points(rows, error):
    return [row["ms_per_second"] for row in rows], [row[error] for row in rows]


def _named(row):
    ms = row["ms_per_second"]
    return f"{ms:.{'0f' if ms >= 100.0 else '3g'}} ms, {100.0 * row['error']:.2g} %: {row['label']}{_doubt(row)}"


def plot_solver(path, found):
    """Draws the gap of a step's objective, of :func:`warpcloth.lab.work_precision.solver_diagram`, over iterations and time."""
    texts = _missing(found)
    step = f"a step of 1/{found['rate']:g} s after {found['frame']} frames"
    with _panels(path, found, f"{found['scene']}, {step}, {found['dtype']}", texts) as panels:
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


def plot_spectrum(path, found):
    """Draws μ over its rank, and measured errors on lines predicted by the spectrum."""
    texts = _missing(found)
    title = f"{found['scene']}, steps after {found['frame']} frames, plain projective dynamics"
    with _panels(path, found, title, texts) as panels:
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


def _doubt(row):
    return "" if usable(row) else ", not usable"


def _floor(axes, value, label, colour=GREY):
    axes.axhline(value, color=colour, linestyle="--", linewidth=0.8, label=label)


def _missing(found):
    count = sum(row["status"] != "ok" for row in found["rows"])
    return ["", f"without a result: {count}, see the table"] if count else []


@contextmanager
def _panels(path, found, title, texts):
    """Yields two panels on logarithmic scales; then finishes and writes the figure.

    A third panel has the legend and the texts below it.
    """
    if len(texts) > _LINES:
        texts[_LINES:] = [f"… {len(texts) - _LINES} lines more in the table"]
    with drawn(path, 11.0, max(4.6, 0.135 * (len(texts) + 20))) as figure:
        *panels, notes = figure.subplots(1, 3, width_ratios=[1.7, 1.7, 1.0])
        for axes in panels:
            axes.set(xscale="log", yscale="log")
        notes.axis("off")
        known = {}
        yield panels
        for axes in panels:
            number_axis(axes.xaxis)
            dress(axes)
            known.update(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
        legend = notes.legend(known.values(), known, loc="upper left", borderaxespad=0.0, **LEGEND)
        style = {"fontsize": SMALL, "color": GREY, "va": "top", "parse_math": False}
        below = {"xycoords": legend, "textcoords": "offset points"}
        notes.annotate("\n".join(texts), (0.0, 0.0), (0.0, -SMALL), **below, **style)
        headline(figure, title)
        used = {row.get("solver") for row in found["rows"]}
        small_print(figure, found["machine"], others=[name for name, each in SIMULATORS.items() if used & set(each.solvers)])
