"""Plots the distances of two animations over time."""

from pathlib import Path

import numpy as np

from .style import LEGEND, drawn, dress, headline, name_ends, series_style, small_print

_DISTANCE = "distance [m]"
_FAR = 30.0  # from a line to its name [pt]; beyond, a legend is easier to read


def plot_distances(path, found, names, device="cpu"):
    """Plots the distances of a :class:`warpcloth.Comparison` over time, and below differences of stretches, if any."""
    if not found.same_topology:
        lines = {"RMS from A": found.surface_rms[:, 0], "RMS from B": found.surface_rms[:, 1], "Hausdorff": found.hausdorff}
        _plot(path, found, names, device, {_DISTANCE: lines}, 3.2)
        return
    lines = {"RMS of vertices": found.rms, "largest of vertices": found.largest, "Hausdorff": found.hausdorff}
    pairs = (("RMS", found.stretch_rms), ("largest", found.stretch_largest))
    stretches = {f"{label} of λ{'₁₂'[k]}": column for label, both in pairs for k, column in enumerate(both.T)}
    _plot(path, found, names, device, {_DISTANCE: lines, "difference of stretches": stretches}, 5.0)


def plot_surface_distances(path, found, names, device="cpu"):
    """Plots RMS distances of a :class:`warpcloth.SurfaceComparison` over time from each, of all and of inner points, and the 95
    % of the latter.
    """
    lines = {f"RMS from {of}": found.all.rms[:, k] for k, of in enumerate("AB")}
    lines |= {f"RMS from {of} without holes": found.inner.rms[:, k] for k, of in enumerate("AB")}
    lines |= {f"95 % from {of} without holes": found.inner.percentile[:, k] for k, of in enumerate("AB")}
    _plot(path, found, names, device, {_DISTANCE: lines}, 3.6, named=False)


def _plot(path, found, names, device, panels, height, named=True):
    """Draws lines over time, by label and by title of their axis, with their names at their ends or else in a legend."""
    with drawn(path, 7.0, height) as figure:
        grid = figure.subplots(len(panels), sharex=True, squeeze=False)[:, 0]
        ends = [_draw(axes, found.times, lines) for axes, lines in zip(grid, panels.values(), strict=True)]
        for axes, label in zip(grid, panels, strict=True):
            axes.set(ylabel=label)
            axes.set_ylim(bottom=0.0)
            dress(axes)
        grid[-1].set_xlabel("time [s]")
        headline(figure, f"{Path(names[0]).name} and {Path(names[1]).name}")
        small_print(figure, device=device)
        if not (named and all(name_ends(figure, axes, of, _FAR) for axes, of in zip(grid, ends, strict=True))):
            for axes in grid:
                axes.legend(**LEGEND)


def _draw(axes, times, lines):
    ends = []
    for k, (label, values) in enumerate(lines.items()):
        style = series_style(k)
        axes.plot(times, values, label=label, markersize=3.5, linewidth=1.0, **style.line)
        known = np.flatnonzero(np.isfinite(values))
        ends += [(times[known[-1]], values[known[-1]], label, style.colour)] if len(known) else []
    return ends
