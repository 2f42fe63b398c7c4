"""The look of all charts: colours and markers by solver, sizes of letters, grids, names at the ends of lines, and small print.

Colours of any two solvers differ by 24 or more in CIELAB, and so do the colours that people without red or green cones see, as
simulated by Machado, Oliveira and Fernandes (2009). No two solvers have the same marker.
"""

import math
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..lab.machine import in_words, machine
from ..others.simulators import other_solvers, shown_name
from ..picture.figures import GREY, PICTURES, check_path, save
from ..solvers import SOLVERS
from ..solvers import __all__ as _INCLUDED

# sRGB. The first eight are those of the included solvers, in the order of the catalogue.
COLOURS = (
    *("#841A00", "#250083", "#0A65B6", "#6AB0ED", "#BA3E63", "#651254", "#A57211", "#68BB6B"),
    *("#37BBB6", "#CAAC00", "#4D6BFF", "#480000"),
)
MARKERS = "so^vDPXph<>*"
_SERIES = (0, 2, 7, 6, 5, 3, 4, 1, 8, 9, 10, 11)  # order of colours for series that belong to no solver
_OTHERS = ("0.22", "0.4", "0.55", "0.31", "0.48", "0.63", "0.71")  # greys, with hollow markers
# Dashes of variants of one solver, such as its integrators, and of lines that are laws.
DASHES = ("-", "--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)))
# sRGB of cells of maps, by how good their result is. They differ in lightness too, for people who do not see red.
GOOD, DOUBTFUL, BAD = (0.66, 0.83, 0.93), (0.93, 0.62, 0.20), (0.42, 0.02, 0.11)

TITLE, LABEL, TICK, SMALL, PRINT = 10.0, 9.0, 8.0, 7.5, 6.5  # sizes of letters [pt]
LEGEND = {"fontsize": SMALL, "labelcolor": GREY, "frameon": False}
_GRID = {"which": "major", "linewidth": 0.3, "color": "0.85"}
_GAP, _LINE = 7.0, 3.0  # from the end of a line to its name, and between heights that are tried [pt]
_MARKER = 5  # points of lines that a marker is worth
_COVERED = 2.0  # distance that a name goes to cover one point less of other lines [pt]


@dataclass(frozen=True)
class Style:
    """The colour and marker of a solver, or of a series of points that belongs to none.

    Attributes:
        colour: Colour as matplotlib takes it.
        marker: Marker as matplotlib takes it.
        hollow: Whether markers are drawn as outlines: those of other simulators are.
    """

    colour: str
    marker: str
    hollow: bool = False

    @property
    def line(self):
        """Arguments of ``Axes.plot``."""
        return {"color": self.colour, "marker": self.marker, "markerfacecolor": "white" if self.hollow else self.colour}


def style_of(solver):
    """Returns the :class:`Style` of a solver by its name, the same in all charts.

    Included solvers have the first colours, in the order of the catalogue. Registered ones have the next, in the order of their
    names. Solvers of other simulators are grey, with hollow markers.
    """
    if solver in (others := list(other_solvers())):
        k = others.index(solver)
        return Style(_OTHERS[k % len(_OTHERS)], MARKERS[k % len(MARKERS)], True)
    names = list(SOLVERS)
    return _style((names[: len(_INCLUDED)] + sorted(names[len(_INCLUDED) :])).index(solver))


def series_style(k):
    """Returns the :class:`Style` of series k of those that belong to no solver, of which neighbours have different hues."""
    return _style(_SERIES[k % len(COLOURS)] + k // len(COLOURS) * len(COLOURS))


def _style(k):
    """Returns the :class:`Style` k; all with k < 144 differ."""
    return Style(COLOURS[k % len(COLOURS)], MARKERS[(k + k // len(COLOURS)) % len(MARKERS)])


def solver_in(label):
    """Returns the name of the solver with which a label begins, as of "xpbd" in "xpbd, filter", or None."""
    shown = {name: shown_name(name) for name in (*other_solvers(), *SOLVERS)}
    return next((name for name, text in shown.items() if label == text or label.startswith((f"{text} ", f"{text},"))), None)


def title_style(label):
    """Returns arguments of ``Axes.set_title``, with the colour of the solver with which a title begins."""
    solver = solver_in(label)
    return {"fontsize": LABEL, "color": readable(style_of(solver).colour) if solver else GREY, "parse_math": False}


def readable(colour):
    """Returns a colour for letters: the given one, or a darker one if that is light."""
    from matplotlib.colors import to_rgb

    rgb = np.array(to_rgb(colour))
    return tuple(rgb * 0.5 / max(rgb @ [0.2126, 0.7152, 0.0722], 0.5))


def dress(axes, grid=True):
    """Gives a panel its spines, ticks, letters and grid; called last, when its labels are known."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("0.7")
    axes.tick_params(which="both", colors=GREY, labelsize=TICK)
    for axis in (axes.xaxis, axes.yaxis):
        axis.label.set(color=GREY, fontsize=LABEL)
    if grid:
        axes.grid(True, **_GRID)
        axes.set_axisbelow(True)


@contextmanager
def drawn(path, width, height):
    """Yields an empty figure with a constrained layout, and writes it when the block ends.

    Args:
        path: The file, .png, .svg or .pdf.
        width: Width of the figure [in].
        height: Height of the figure [in].

    Raises:
        FileNotFoundError: The folder does not exist.
        ImportError: matplotlib is not installed.
        ValueError: The path has another ending.
    """
    check_path(path, PICTURES)
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    yield figure
    save(figure, path)


def headline(figure, text):
    """Writes the title of a figure."""
    figure.suptitle(text, fontsize=TITLE, color=GREY, parse_math=False)


def small_print(figure, facts=None, device="cpu", others=()):
    """Writes versions and the machine below a figure.

    Args:
        figure: Figure of matplotlib with a constrained layout.
        facts: The machine of measurements, as of :func:`warpcloth.lab.machine.machine`; None for this one.
        device: The Warp device, if ``facts`` is None.
        others: Names of other simulators in the chart.
    """
    text = in_words(machine(device) if facts is None else facts, others)
    low = _bottom(figure)
    # The layout makes no room for a legend that does not stand at the edge of the figure, as that of add_legend.
    boxes = [legend.get_window_extent() for legend in figure.legends]
    above = low + sum(box.height for box in boxes if box.y0 < 0.5 * figure.bbox.height) / figure.bbox.height
    figure.get_layout_engine().set(rect=(0.0, above, 1.0, 1.0 - above))
    figure.text(0.995, 0.3 * low, text, ha="right", fontsize=PRINT, color="0.5", parse_math=False)


def add_legend(figure, handles, columns):
    """Adds a legend below all panels of a figure, above its small print."""
    low = _bottom(figure)
    at = {"loc": "outside lower center", "bbox_to_anchor": (0.0, low, 1.0, 1.0 - low)}
    figure.legend(handles=handles, ncols=columns, **at, **LEGEND)


def _bottom(figure):
    """Returns the height of the small print, as a part of that of a figure."""
    return 2.0 * PRINT / 72.0 / figure.get_size_inches()[1]


def name_ends(figure, axes, ends, far=math.inf):
    """Writes the name of each line beside its end, in its colour, near to it, without overlaps and inside the panel.

    Names cover no other text and as little of the lines as possible. The panel is made wider for them.

    Args:
        figure: Figure of the axes, which are otherwise finished.
        axes: A panel.
        ends: (x, y, text, colour) of each line.
        far: The largest distance between the height of a name and of the end of its line [pt].

    Returns:
        Whether the names are legible. If a name would be farther away, would cover another line, or needs more than 40 % of
        the width, none is written; then the chart needs a legend.
    """
    (legible,) = name_all_ends(figure, [(axes, ends)], far)
    return legible


def name_all_ends(figure, panels, far=math.inf):
    """Does what :func:`name_ends` does for each of several panels (axes, ends) that share no axis, and lays them out once."""
    if not panels:
        return []
    figure.draw_without_rendering()  # so that sizes are known
    begun = [_begin_names(figure, axes, ends, far) for axes, ends in panels]
    figure.draw_without_rendering()
    found = []
    for (axes, _ends), (before, others, notes, sizes, legible) in zip(panels, begun, strict=True):
        if legible:
            extents = [text.get_window_extent() for text in others]
            drawn, taken = _drawn(axes), [(extent.min, extent.max) for extent in extents]
            for note, size in zip(notes, sizes, strict=True):
                legible = legible and _put(axes, note, size, drawn, taken, far)
        if not legible:
            for note in notes:
                note.remove()
            axes.set_xlim(before)
        found.append(legible)
    return found


def _begin_names(figure, axes, ends, far):
    """Writes names at the ends of lines, and makes the panel wider if they can be legible.

    Returns:
        The limits of x before; the other texts of the panel; the names; their widths and heights [pt]; whether they can be
        legible.
    """
    from matplotlib.patheffects import withStroke

    before, others = axes.get_xlim(), list(axes.texts)
    style = {"fontsize": SMALL, "va": "center", "annotation_clip": False, "zorder": 4.0, "parse_math": False}
    style |= {"path_effects": [withStroke(linewidth=2.0, foreground="white")], "textcoords": "offset points"}
    notes = [
        axes.annotate(text, (x, y), (_GAP, 0.0), color=readable(colour), **style)
        for x, y, text, colour in sorted(ends, key=lambda end: -end[1])
    ]
    for note in notes:
        note.set_in_layout(False)
    point = figure.dpi / 72.0
    sizes = [note.get_window_extent().size / point for note in notes]
    room = (max(size[0] for size in sizes) + 2.0 * _GAP) * point / axes.bbox.width
    legible = room < 0.4 or far == math.inf
    if legible:
        _widen(axes, min(room, 0.4))
    return before, others, notes, sizes, legible


def _widen(axes, share):
    """Adds room for names right of the lines, a share of the new width. The axis and its ticks end where they ended before."""
    low, high = axes.get_xlim()
    more = share / (1.0 - share)
    ticks = {minor: [tick for tick in axes.get_xticks(minor=minor) if low <= tick <= high] for minor in (False, True)}
    axes.set_xlim(low, high * (high / low) ** more if axes.get_xscale() == "log" else high + (high - low) * more)
    axes.spines["bottom"].set_bounds(low, high)
    for minor, kept in ticks.items():
        axes.set_xticks(kept, minor=minor)


def _drawn(axes):
    """Returns points along all lines of a panel [pixels], (p, 2), about three pixels apart, and at markers several."""
    parts = []
    for line in axes.lines:
        at = line.get_transform().transform(line.get_xydata())
        at = at[np.isfinite(at).all(axis=1)]
        parts.append(np.repeat(at, _MARKER if line.get_marker() not in ("None", "") else 1, axis=0))
        if line.get_linewidth() > 0.0 and line.get_linestyle() != "None":
            for a, b in pairwise(at):
                count = min(int(np.linalg.norm(b - a) / 3.0), 1000)
                parts.append(a + (b - a) * np.linspace(0.0, 1.0, count + 1)[:, None])
    return np.concatenate([np.empty((0, 2)), *parts])


def _put(axes, note, size, drawn, taken, far):
    """Moves a name to its best position; returns whether it is legible there.

    Args:
        axes: The panel.
        note: The name, an annotation.
        size: Width and height of the name [pt].
        drawn: Points of lines [pixels].
        taken: Corners (low, high) of names that have a position [pixels]; that of this one is added.
        far: See :func:`name_ends`.
    """
    point = axes.figure.dpi / 72.0
    anchor, best = axes.transData.transform(note.xy), None
    for shift in range(120):
        for up in (-_LINE * shift, _LINE * shift):
            for side, left in (("left", _GAP), ("right", -_GAP - size[0])):
                low = anchor + point * np.array([left, up - 0.5 * size[1]])
                high = low + point * size
                if (low < axes.bbox.min).any() or (high > axes.bbox.max).any():
                    continue
                if any((low < end).all() and (start < high).all() for start, end in taken):
                    continue
                covered = np.count_nonzero(((drawn > low) & (drawn < high)).all(axis=1))
                cost = abs(up) + (side == "right") + _COVERED * covered
                if best is None or cost < best[0]:
                    best = cost, side, up, covered, low, high
        if best is not None and best[0] <= _LINE * shift:
            break
    if best is None:
        return far == math.inf
    _cost, side, up, covered, low, high = best
    note.set(ha=side)
    note.xyann = (_GAP if side == "left" else -_GAP, up)
    taken.append((low - point, high + point))
    return far == math.inf or (abs(up) <= far and covered == 0)
