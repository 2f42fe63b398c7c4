"""Plots the residuals of a fit over time."""

import numpy as np

from ..picture.figures import GREY
from .style import drawn, dress, headline, name_ends, series_style, small_print


def plot_residuals(path, found, fps, device="cpu"):
    """Plots the RMS residual of each frame of a :class:`warpcloth.Fit`."""
    with drawn(path, 7.0, 3.2) as figure:
        axes = figure.subplots()
        times, style = np.arange(1, len(found.residuals) + 1) / fps, series_style(1)
        axes.plot(times, found.residuals, markersize=3.5, linewidth=1.0, **style.line)
        axes.axhline(found.residual, color="0.6", linewidth=1.0)
        parameters = ", ".join(f"{name} = {value:.4g}" for name, value in found.parameters.items())
        axes.set(xlabel="time [s]", ylabel="RMS residual along an axis [m]", ylim=(0.0, None))
        dress(axes)
        headline(figure, parameters)
        small_print(figure, device=device)
        name_ends(figure, axes, [(times[-1], found.residual, f"over all frames, {found.residual:.3g} m", GREY)])
