"""Panels of charts of failures as data: labels, and the laws that explain measured points."""

from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Panel:
    """The contents of one panel: its name in tables, its title, labels with units, and scales, "linear" or "log".

    Attributes:
        laws: Functions of x by the label of their line.
        follows: Label of the law of a series, by series; not all have one.
        marks: Labels of vertical lines by their x.
        limits: Limits of y, None to fit.
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


@dataclass(frozen=True)
class Map(Panel):
    """A panel of cells over x and y, coloured by value, or by series; laws are lines, y as functions of x.

    Attributes:
        value: Label of the value, with its unit.
        colours: Name of the colour map of values.
        kinds: The series, if cells are coloured by series.
        crossed: The series whose cells are crossed out, or None.
    """

    value: str = ""
    colours: str = "Blues"
    kinds: tuple[str, ...] = ()
    crossed: str | None = None


def point(panel, series, x, value, reason="", y=None):
    """Returns a measured point as JSON; ``value`` may be None, with a ``reason``; ``y`` is for a :class:`Map`."""
    value, y = (None if each is None else float(each) for each in (value, y))
    return {"panel": panel, "series": series, "x": float(x), "y": y, "value": value, "reason": reason}
