"""Plots the residuals of a fit over time."""

import numpy as np

from ..picture.figures import PICTURES, check_path, save


def plot_residuals(path, found, fps):
    """Plots the RMS residual of each frame of a fit over time.

    Args:
        path: The file, .png, .svg or .pdf.
        found: The :class:`warpcloth.Fit`.
        fps: Frames per second of the scene.

    Raises:
        FileNotFoundError: The folder does not exist.
        ImportError: matplotlib is not installed.
        ValueError: The path has another ending.
    """
    check_path(path, PICTURES)
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(np.arange(1, len(found.residuals) + 1) / fps, found.residuals, ".-")
    axes.axhline(found.residual, color="0.6", linewidth=1.0, label=f"over all frames, {found.residual:.3g} m")
    parameters = ", ".join(f"{name} = {value:.4g}" for name, value in found.parameters.items())
    axes.set(title=parameters, xlabel="time [s]", ylabel="RMS residual along an axis [m]", ylim=(0.0, None))
    axes.legend()
    save(figure, path)
