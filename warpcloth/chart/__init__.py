"""Plots of measured cloth and of solvers, with matplotlib, the extra "chart".

Each function that plots writes a .png, .svg or .pdf file. It raises ``FileNotFoundError`` if the folder does not exist,
``ImportError`` if matplotlib is not installed, and ``ValueError`` if the path has another ending.
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
