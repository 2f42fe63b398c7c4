"""Plots the distances of two animations over time."""

from pathlib import Path

from ..picture.figures import PICTURES, check_path, save


def plot_distances(path, found, names):
    """Plots the distances of two animations over time and, if they have the same triangles, differences of stretches below.

    Args:
        path: The file, .png, .svg or .pdf.
        found: The :class:`warpcloth.Comparison`.
        names: Names of the two files.

    Raises:
        FileNotFoundError: The folder does not exist.
        ImportError: matplotlib is not installed.
        ValueError: The path has another ending.
    """
    check_path(path, PICTURES)
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 5.0 if found.same_topology else 3.2), layout="constrained")
    axes = figure.subplots(2 if found.same_topology else 1, sharex=True, squeeze=False)[:, 0]
    lines = {"RMS of vertices": found.rms, "largest of vertices": found.largest, "Hausdorff": found.hausdorff}
    if not found.same_topology:
        lines = {"RMS from A": found.surface_rms[:, 0], "RMS from B": found.surface_rms[:, 1], "Hausdorff": found.hausdorff}
    for (label, values), style in zip(lines.items(), (".-", ".-", "."), strict=True):
        axes[0].plot(found.times, values, style, label=label)
    axes[0].set(title=f"{Path(names[0]).name} and {Path(names[1]).name}", ylabel="distance [m]")
    if found.same_topology:
        for label, values in (("RMS", found.stretch_rms), ("largest", found.stretch_largest)):
            for k, column in enumerate(values.T):
                axes[1].plot(found.times, column, ".-", label=f"{label} of λ{'₁₂'[k]}")
        axes[1].set(ylabel="difference of stretches")
    for axis in axes:
        axis.legend()
        axis.set_ylim(bottom=0.0)
    axes[-1].set_xlabel("time [s]")
    save(figure, path)
