"""Plots the distances of two animations over time."""

from pathlib import Path

import numpy as np

from ..picture.figures import PICTURES, check_path, save
from .style import LEGEND, dress, headline, name_ends, series_style, small_print

_FAR = 30.0  # from a line to its name [pt]; beyond, a legend is easier to read


def plot_distances(path, found, names, device="cpu"):
    """Plots the distances of a :class:`warpcloth.Comparison` over time, and below differences of stretches, if any."""
    check_path(path, PICTURES)
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 5.0 if found.same_topology else 3.2), layout="constrained")
    axes = figure.subplots(2 if found.same_topology else 1, sharex=True, squeeze=False)[:, 0]
    lines = {"RMS of vertices": found.rms, "largest of vertices": found.largest, "Hausdorff": found.hausdorff}
    if not found.same_topology:
        lines = {"RMS from A": found.surface_rms[:, 0], "RMS from B": found.surface_rms[:, 1], "Hausdorff": found.hausdorff}
    panels = [lines]
    if found.same_topology:
        pairs = (("RMS", found.stretch_rms), ("largest", found.stretch_largest))
        panels.append({f"{label} of λ{'₁₂'[k]}": column for label, both in pairs for k, column in enumerate(both.T)})
    ends = [_draw(each, found.times, lines) for each, lines in zip(axes, panels, strict=True)]
    axes[0].set(ylabel="distance [m]")
    if found.same_topology:
        axes[1].set(ylabel="difference of stretches")
    axes[-1].set_xlabel("time [s]")
    for each in axes:
        each.set_ylim(bottom=0.0)
        dress(each)
    headline(figure, f"{Path(names[0]).name} and {Path(names[1]).name}")
    small_print(figure, device=device)
    if not all(name_ends(figure, each, of, _FAR) for each, of in zip(axes, ends, strict=True)):
        for each in axes:
            each.legend(**LEGEND)
    save(figure, path)


def plot_surface_distances(path, found, names, device="cpu"):
    """Plots RMS distances of a :class:`warpcloth.SurfaceComparison` over time from each, of all and of inner points, and the 95
    % of the latter.
    """
    check_path(path, PICTURES)
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = figure.subplots()
    lines = {f"RMS from {of}": found.all.rms[:, k] for k, of in enumerate("AB")}
    lines |= {f"RMS from {of} without holes": found.inner.rms[:, k] for k, of in enumerate("AB")}
    lines |= {f"95 % from {of} without holes": found.inner.percentile[:, k] for k, of in enumerate("AB")}
    _draw(axes, found.times, lines)
    axes.set(xlabel="time [s]", ylabel="distance [m]")
    axes.set_ylim(bottom=0.0)
    dress(axes)
    headline(figure, f"{Path(names[0]).name} and {Path(names[1]).name}")
    small_print(figure, device=device)
    axes.legend(**LEGEND)
    save(figure, path)


def _draw(axes, times, lines):
    ends = []
    for k, (label, values) in enumerate(lines.items()):
        style = series_style(k)
        axes.plot(times, values, label=label, markersize=3.5, linewidth=1.0, **style.line)
        known = np.flatnonzero(np.isfinite(values))
        ends += [(times[known[-1]], values[known[-1]], label, style.colour)] if len(known) else []
    return ends
