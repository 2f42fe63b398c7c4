"""Failures of terms, weights, fits and contact, as measured points with the laws that explain them.

A chart is a module with a `TITLE`, the `PANELS` to draw, and `tasks` that measure them. Each task returns points: dictionaries
with ``panel``, ``series``, ``x``, ``y`` (for maps), ``value`` or None, and ``reason``.
"""

from ..base.checks import choice
from ..base.outputs import write_table
from . import cotangents, crossing, friction, isometry, locking, rank, slivers, tunnelling
from .campaign import collect
from .machine import machine
from .panels import Map

FAILURES = {
    "locking": locking,
    "isometry": isometry,
    "slivers": slivers,
    "cotangents": cotangents,
    "rank": rank,
    "tunnelling": tunnelling,
    "friction": friction,
    "crossing": crossing,
}
COLUMNS = ("panel", "series", "x", "y", "value", "law", "expected", "reason", "machine")


def failure_chart(name, device="cpu", **run):
    """Measures one of `FAILURES`; ``run`` has arguments of :func:`sweep`.

    Returns:
        dict: JSON values; ``rows`` has the points, with the ``law`` of a series and the value ``expected`` from it.

    Raises:
        ValueError: There is no such failure.
    """
    choice("failure", name, tuple(FAILURES))
    tasks = FAILURES[name].tasks(str(device))
    panels = {panel.key: panel for panel in FAILURES[name].PANELS}
    rows = []
    for points, where in collect(tasks, "failures", **run):
        for point in points:
            panel = panels[point["panel"]]
            law = panel.follows.get(point["series"])
            expected = float(panel.laws[law](point["x"])) if law else None
            rows.append({**point, "law": law, "expected": expected, "machine": where})
    facts = {"failure": name, "title": FAILURES[name].TITLE, "device": str(device), "seed": 0, "machine": machine(device)}
    shown = {key: _shown(panel) for key, panel in panels.items()}
    return {**facts, "panels": shown, "rows": rows}


def _shown(panel):
    facts = {"title": panel.title, "x": panel.x, "y": panel.y}
    return facts | {"value": panel.value} if isinstance(panel, Map) else facts


def write_csv(path, found):
    """Writes a line for each point.

    Raises:
        FileNotFoundError: The folder does not exist.
    """
    write_table(path, COLUMNS, ([row[name] for name in COLUMNS] for row in found["rows"]))
