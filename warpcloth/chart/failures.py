"""Draws charts of failures."""

from ..lab.failures import FAILURES
from .panels import plot_panels


def plot_failure(path, found):
    """Draws the result of :func:`failure_chart`.

    Raises:
        OSError, ImportError, ValueError: As of :func:`warpcloth.picture.figures.check_path`.
    """
    plot_panels(path, FAILURES[found["failure"]].PANELS, found["rows"], found["title"], found["machine"])
