"""The look of all charts: colours and markers by solver, letters, grids, names at the ends of lines, small print.

Colours of two solvers differ by 24 or more in CIELAB, also without red or green cones (Machado, Oliveira and Fernandes 2009);
markers differ too.
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
    """Colour and marker of a solver, or of another series.

    Attributes:
        colour: As matplotlib takes it.
        marker: As matplotlib takes it.
        hollow: Whether markers are outlines, for other simulators.
    """

    colour: str
    marker: str
    hollow: bool = False

    @property
    def line(self):
        """Arguments of ``Axes.plot``."""
        return {"color": self.colour, "marker": self.marker, "markerfacecolor": "white" if self.hollow else self.colour}


def style_of(solver):
    """Returns the :class:`Style` of a solver by its name.

    Included solvers have the first colours in the order of the catalogue, registered ones the next by name, those of other
    simulators greys and hollow markers.
    """
    if solver in (others := list(other_solvers())):
        k = others.index(solver)
        return Style(_OTHERS[k % len(_OTHERS)], MARKERS[k % len(MARKERS)], True)
    names = list(SOLVERS)
    return _style((names[: len(_INCLUDED)] + sorted(names[len(_INCLUDED) :])).index(solver))


def series_style(k):
    """Returns the :class:`Style` of series k without a solver; neighbours differ in hue."""
    return _style(_SERIES[k % len(COLOURS)] + k // len(COLOURS) * len(COLOURS))


def _style(k):
    return Style(COLOURS[k % len(COLOURS)], MARKERS[(k + k // len(COLOURS)) % len(MARKERS)])


def solver_in(label):
    """Returns the solver with which a label begins, or None."""
    shown = {name: shown_name(name) for name in (*other_solvers(), *SOLVERS)}
    return next((name for name, text in shown.items() if label == text or label.startswith((f"{text} ", f"{text},"))), None)


def title_style(label):
    """Returns arguments of ``Axes.set_title`` in the colour of the solver that begins a title."""
    solver = solver_in(label)
    return {"fontsize": LABEL, "color": readable(style_of(solver).colour) if solver else GREY, "parse_math": False}


def readable(colour):
    """Returns a colour for letters, darker if it is light."""
    from matplotlib.colors import to_rgb

    rgb = np.array(to_rgb(colour))
    return tuple(rgb * 0.5 / max(rgb @ [0.2126, 0.7152, 0.0722], 0.5))


def dress(axes, grid=True):
    """Gives a panel spines, ticks, letters and grid; called last."""
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
    """Yields an empty figure of a size [in] with a constrained layout, and writes it when the block ends.

    Raises:
        OSError, ImportError, ValueError: As of :func:`warpcloth.picture.figures.check_path`.
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
    """Writes versions and the machine below a figure with a constrained layout: that of ``facts``, or this one and its Warp
    device.
    """
    text = in_words(machine(device) if facts is None else facts, others)
    low = _bottom(figure)
    # The layout makes no room for a legend that does not stand at the edge of the figure, as that of add_legend.
    boxes = [legend.get_window_extent() for legend in figure.legends]
    above = low + sum(box.height for box in boxes if box.y0 < 0.5 * figure.bbox.height) / figure.bbox.height
    figure.get_layout_engine().set(rect=(0.0, above, 1.0, 1.0 - above))
    figure.text(0.995, 0.3 * low, text, ha="right", fontsize=PRINT, color="0.5", parse_math=False)


def add_legend(figure, handles, columns):
    """Adds a legend between the panels and the small print."""
    low = _bottom(figure)
    at = {"loc": "outside lower center", "bbox_to_anchor": (0.0, low, 1.0, 1.0 - low)}
    figure.legend(handles=handles, ncols=columns, **at, **LEGEND)


def _bottom(figure):
    return 2.0 * PRINT / 72.0 / figure.get_size_inches()[1]


def name_ends(figure, axes, ends, far=math.inf):
    """Writes the name of each line (x, y, text, colour) beside its end, in its colour, inside the panel, which is widened.

    Names cover no text and little of the lines, within ``far`` [pt] in height. Returns whether they are legible; else (too far,
    over another line, above 40 % of the width) none is written, and the chart needs a legend.
    """
    (legible,) = name_all_ends(figure, [(axes, ends)], far)
    return legible


def name_all_ends(figure, panels, far=math.inf):
    """:func:`name_ends` for several panels (axes, ends) without common axes."""
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
    """Writes names at the ends of lines, and widens the panel if they can be legible."""
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
    """Adds room right of the lines, a share of the new width, without axis."""
    low, high = axes.get_xlim()
    more = share / (1.0 - share)
    ticks = {minor: [tick for tick in axes.get_xticks(minor=minor) if low <= tick <= high] for minor in (False, True)}
    axes.set_xlim(low, high * (high / low) ** more if axes.get_xscale() == "log" else high + (high - low) * more)
    axes.spines["bottom"].set_bounds(low, high)
    for minor, kept in ticks.items():
        axes.set_xticks(kept, minor=minor)


def _drawn(axes):
    """Returns points along all lines [pixels], (p, 2), about three pixels apart, several at markers."""
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
    """Moves a name to its best position, away from ``drawn`` points and ``taken`` boxes [pixels]; returns whether it is legible
    there.
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
