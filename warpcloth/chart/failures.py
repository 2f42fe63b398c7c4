"""Draws charts of failures."""

from ..lab.failures import FAILURES
from .panels import plot_panels


def plot_failure(path, found):
    """Draws the result of :func:`failure_chart`.

    Raises:
        FileNotFoundError: The folder does not exist.
        ImportError: matplotlib is not installed.
        ValueError: The path has another ending.
    """
    plot_panels(path, FAILURES[found["failure"]].PANELS, found["rows"], found["title"], found["machine"])
