"""Colours, pictures and plots of measured cloth. Nothing else here imports matplotlib, the extra "chart"."""

from .colour import Scale, range_over
from .distances import plot_distances
from .percentiles import plot_percentiles
from .picture import draw
from .view import View

__all__ = ["Scale", "View", "draw", "plot_distances", "plot_percentiles", "range_over"]
