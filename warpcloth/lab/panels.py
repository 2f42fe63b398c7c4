"""Panels: what a chart of failures shows, as data: measured points and the laws that explain them."""

from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Panel:
    """The contents of one panel.

    Attributes:
        key: Its name in tables.
        title: A sentence that says what fails.
        x: Label of the axis, with its unit.
        y: The same of the other axis.
        scales: Of x and of y, "linear" or "log".
        laws: Functions of x by the label of their line.
        follows: The law of a series, by label; not all have one.
        marks: Labels of vertical lines by their x.
        limits: Ends of y, None to fit.
    """

    key: str
    title: str
    x: str
    y: str
    scales: tuple[str, str] = ("linear", "linear")
    laws: dict[str, Callable] = field(default_factory=dict)
    follows: dict[str, str] = field(default_factory=dict)
    marks: dict[float, str] = field(default_factory=dict)
    limits: tuple[float, float] | None = None


def point(panel, series, x, value, reason=""):
    """A measured point as JSON; ``value`` None where there is none, and then the reason."""
    value = None if value is None else float(value)
    return {"panel": panel, "series": series, "x": float(x), "value": value, "reason": reason}
