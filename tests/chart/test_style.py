"""The look of charts: colours that all eyes tell apart, the same for a solver everywhere, names beside lines, small print."""

from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from warpcloth.chart import style
from warpcloth.chart.cheapest import plot_cheapest
from warpcloth.chart.residuals import plot_residuals
from warpcloth.lab.machine import in_words, machine
from warpcloth.lab.measurements import Setup
from warpcloth.lab.setups import label
from warpcloth.others.simulators import other_solvers
from warpcloth.solvers import SOLVERS

pytestmark = pytest.mark.host

# Linear RGB to that of people without red or green cones, of Machado, Oliveira and Fernandes (2009), severity 1.
EYES = {
    "all cones": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
}
XYZ = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]])


def lab(colours, eyes):
    """CIELAB (n, 3) of sRGB colours, relative to the white of sRGB."""
    srgb = np.array([to_rgb(colour) for colour in colours])
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    t = np.clip(linear @ np.array(eyes).T, 0.0, 1.0) @ XYZ.T / XYZ.sum(axis=1)
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)


def smallest(a, b, eyes):
    return min(np.linalg.norm(p - q) for p, q in zip(lab(a, eyes), lab(b, eyes), strict=True))


@pytest.mark.parametrize("eyes", EYES.values(), ids=EYES)
def test_all_eyes_tell_solvers_apart(eyes):
    """Of all pairs, and each from white paper; greys of other simulators, near which some come, have hollow markers."""
    colours = [*style.COLOURS, "white"]
    assert smallest(*zip(*combinations(colours, 2), strict=True), eyes) > 24.0
    ours = [style.style_of(name) for name in SOLVERS]
    others = [style.style_of(name) for name in other_solvers()]
    assert not any(each.hollow for each in ours) and all(each.hollow for each in others)
    assert smallest(*zip(*combinations([each.colour for each in others], 2), strict=True), eyes) > 5.0
    for group in (ours, others):
        assert len({each.marker for each in group}) == len(group)


def test_registered_solvers_have_the_next_colours_by_name(monkeypatch):
    before = {name: style.style_of(name) for name in SOLVERS}
    for first, second in (("b", "a"), ("a", "b")):
        with monkeypatch.context() as patch:
            for name in (first, second):
                patch.setitem(SOLVERS, name, None)
            assert {name: style.style_of(name) for name in before} == before
            assert [style.style_of(name).colour for name in "ab"] == list(style.COLOURS[8:10])
    assert len({style._style(k) for k in range(144)}) == 144
    assert len({style.series_style(k) for k in range(24)}) == 24


def test_labels_that_begin_with_a_solver():
    engine = label(Setup("newton-xpbd", {"substeps": 4}))
    assert engine == "Newton engine: XPBD 4"
    labels = ("xpbd", "xpbd, filter", "newton bdf2", engine, "newtonian", "edges, xpbd")
    assert [style.solver_in(label) for label in labels] == ["xpbd", "xpbd", "newton", "newton-xpbd", None, None]


def lines(heights, scale="linear"):
    """A figure with a line to each height, and their ends."""
    figure = Figure(figsize=(5.0, 3.0), layout="constrained")
    axes = figure.subplots()
    axes.set(xscale=scale, ylim=(0.0, 1.0))
    for height in heights:
        axes.plot([1.0, 10.0], [0.5, height])
    return figure, axes, [(10.0, height, f"height {height}", "#6AB0ED") for height in heights]


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_names_are_beside_their_lines_without_overlaps(scale):
    figure, axes, ends = lines([0.1, 0.45, 0.48, 0.9], scale)
    assert style.name_ends(figure, axes, ends, 16.0)
    figure.draw_without_rendering()
    boxes = [note.get_window_extent() for note in axes.texts]
    assert len(boxes) == 4 and not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    for note, box in zip(axes.texts, boxes, strict=True):
        x, y = axes.transData.transform(note.xy)
        assert abs(0.5 * (box.y0 + box.y1) - y) < 18.0 / 72.0 * figure.dpi and x < box.x0 and box.x1 < axes.bbox.x1


def test_what_cannot_be_named_legibly_is_left_to_a_legend():
    """Names of lines that end at one point, and names that need half of the panel; without a bound they are written. No name
    covers a text that was there.
    """
    figure, axes, ends = lines([0.5] * 9)
    before = axes.get_xlim()
    assert not style.name_ends(figure, axes, ends, 16.0) and not axes.texts and axes.get_xlim() == before
    assert not style.name_ends(figure, axes, [(10.0, 0.5, "long " * 12, "black")], 16.0) and axes.get_xlim() == before
    for height in np.linspace(0.0, 1.0, 40):
        axes.axhline(height)
    assert not style.name_ends(figure, axes, ends[:1], 16.0), "whatever covers lines"
    axes.annotate("here", (10.0, 0.5), (9.0, 0.0), textcoords="offset points")
    assert style.name_ends(figure, axes, ends) and len(axes.texts) == 10
    here, *boxes = (note.get_window_extent() for note in axes.texts)
    assert not here.count_overlaps(boxes)


def test_cells_have_the_colour_of_their_solver_and_charts_small_print(tmp_path, monkeypatch):
    kept, saving = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (kept.append(self), saving(self, *a, **k)))
    cell = {"status": "found", "label": "xpbd 4×1", "solver": "xpbd", "ms": 1.0, "complete": True, "error": 0.01}
    cell |= {"second": None, "reference_error": 1e-4}
    found = {"x": ("n", ["4", "8"]), "y": None, "frames": None, "tolerance": 0.01, "scene": "hanging", "dtype": "float32"}
    found |= {"machine": machine(), "cells": [cell, {"status": "inaccurate", "reason": "nothing is accurate"}]}
    plot_cheapest(tmp_path / "map.png", found)
    look = style.style_of("xpbd")
    (line,) = kept[0].axes[0].lines
    assert (line.get_color(), line.get_marker()) == (look.colour, look.marker)
    colours = {patch.get_facecolor()[:3] for patch in kept[0].axes[0].patches if patch.get_fill()}
    assert to_rgb(look.colour) in colours and len(colours) == 2
    fit = SimpleNamespace(residuals=np.array([1.0, 2.0, 1.5]), residual=1.6, parameters={"Spring.stiffness": 300.0})
    plot_residuals(tmp_path / "fit.png", fit, 24)
    assert {figure.texts[-1].get_text() for figure in kept} == {in_words(machine())}
    assert "over all frames, 1.6 m" in [text.get_text() for text in kept[1].axes[0].texts]


def test_panels_end_above_the_legend_and_the_legend_above_the_small_print():
    figure = Figure(figsize=(6.0, 3.9), layout="constrained")
    axes = figure.subplots()
    axes.set_xlabel("step [s]")
    style.add_legend(figure, [Patch(label=f"entry {k}") for k in range(5)], 1)
    style.small_print(figure)
    figure.draw_without_rendering()
    (legend,), (text,) = figure.legends, figure.texts
    assert axes.get_tightbbox().y0 >= legend.get_window_extent().y1 - 2.0  # the padding of the layout
    assert legend.get_window_extent().y0 >= text.get_window_extent().y1 - 2.0
