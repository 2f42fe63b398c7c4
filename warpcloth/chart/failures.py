"""Draws charts of failures."""

from ..lab.failures import FAILURES
from .panels import plot_panels


def plot_failure(path, found):
    """Draws the result of :func:`failure_chart`."""
    plot_panels(path, FAILURES[found["failure"]].PANELS, found["rows"], found["title"], found["machine"])
