"""Plots of measured cloth and of solvers, with the extra "chart".

Paths end with .png, .svg or .pdf; functions raise what :func:`warpcloth.picture.figures.check_path` does.
"""

from ..picture.colour import Scale, range_over
from ..picture.picture import draw
from ..picture.projection import View
from .distances import plot_distances, plot_surface_distances
from .percentiles import plot_percentiles
from .residuals import plot_residuals

__all__ = [
    "Scale",
    "View",
    "draw",
    "plot_distances",
    "plot_percentiles",
    "plot_residuals",
    "plot_surface_distances",
    "range_over",
]
