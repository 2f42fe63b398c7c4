"""A still picture of a cloth, coloured by a measure."""

from itertools import cycle

import numpy as np

from ..base.checks import choice
from .colour import EXCLUDED
from .figures import GREY, check_path, save
from .projection import View, brightness

# Inches: the longer side of a panel, the margins beside, above and, with several panels, below it, and gaps.
_SIDE, _RIGHT, _TOP, _FOOT, _GAP = 6.0, 1.2, 0.5, 0.3, 0.15
# Line widths [pt]: edges in the colour of their triangle close hairline gaps between neighbours, which at 150 dpi needs 0.8.
_EDGE, _LINE = 0.8, 0.7
# Smallest brightness of shading, because the bar shows the colours in full light.
_MIN_LIGHT = 0.85
_GREYS = (0.0, 1.0, 0.5)


def draw(
    path, points, triangles, values, scale, on="triangle", title="", unit="1", view=None, directions=None, both_sides=False
):
    """Writes a PNG of a cloth, points (n, 3) [m] and triangles (T, 3), in parallel projection with a colour bar.

    The values (T,), or (n,) ``on`` vertices, colour by a :class:`Scale`, NaN in dark grey; a vertex colours the nearest third
    of each triangle. Triangles that are not finite are counted, not drawn. A ``view`` without a window is fitted to these
    points. ``directions`` are segments by name, centres and vectors (E, 3) [m]: the first black, the second white, the third
    grey. ``both_sides`` adds a panel from the opposite side.

    Raises:
        OSError, ImportError: The file cannot be written, or matplotlib is not installed.
        ValueError: A shape is another, a triangle refers to no vertex, no point is finite, or the file is not .png.
    """
    check_path(path, (".png",))
    choice("on", on, ("triangle", "vertex"))
    points, values, triangles = np.asarray(points, np.float64), np.asarray(values, np.float64), np.asarray(triangles)
    _check(points, triangles, values, on)
    view = view or View()
    if view.window is None:
        view = view.fit([points])
    views = [view, view.opposite()] if both_sides else [view]
    figure, panels, beside = _layout(view.window, title, len(views))
    colours = scale.srgb(values if on == "triangle" else values[triangles])
    for axes, one in zip(panels, views, strict=True):
        left, right, bottom, top = one.window
        axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
        axes.axis("off")
        if both_sides:
            text = f"from azimuth {one.azimuth:g}°, elevation {one.elevation:g}°".replace("-", "−")
            axes.text(0.02, 0.0, text, transform=axes.transAxes, va="top", fontsize=8, color=GREY)
        unplaced = _paint_cloth(axes, one, points, triangles, colours, on, directions)
    _explain(figure, beside, scale, unit, bool(np.isnan(values).any()), unplaced)
    save(figure, path)


def _paint_cloth(axes, view, points, triangles, colours, on, directions):
    corners = view.project(points)[triangles]
    placed = np.isfinite(corners).all(axis=(1, 2))
    outlines, colours = (_whole if on == "triangle" else _thirds)(corners[placed], colours[placed])
    widths = np.full(len(outlines), _EDGE)
    depths = outlines[..., 2].mean(axis=1)
    if directions:
        segments, greys = _segments(view, directions)
        # Segments are outlines of zero width, moved a little towards the viewer, in front of the triangles that they cross.
        lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
        depths = np.append(depths, segments[..., 2].mean(axis=1) + lengths / 2.0)
        outlines = np.concatenate([outlines, segments[:, np.minimum(np.arange(outlines.shape[1]), 1)]])
        colours, widths = np.concatenate([colours, greys]), np.append(widths, np.full(len(segments), _LINE))
    paint(axes, outlines[..., :2], depths, colours, widths)
    return int((~placed).sum())


def paint(axes, outlines, depths, colours, widths):
    """Draws polygons (P, k, 2) from the back to the front by depths (P,), in sRGB (P, 3) or with alpha (P, 4), edges of widths
    [pt].
    """
    from matplotlib.collections import PolyCollection

    order = np.argsort(depths)
    colours, widths = colours[order], widths[order] if np.ndim(widths) else widths
    axes.add_collection(PolyCollection(outlines[order], facecolors=colours, edgecolors=colours, linewidths=widths))


def _check(points, triangles, values, on):
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points has shape {points.shape}; it must be (n, 3)")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        raise ValueError(f"triangles has shape {triangles.shape} and type {triangles.dtype}; it must be (T, 3), whole numbers")
    if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(points):
        raise ValueError(f"triangles refers to vertices {triangles.min()} to {triangles.max()}; there are {len(points)}")
    count = len(triangles) if on == "triangle" else len(points)
    if values.shape != (count,):
        raise ValueError(f"values has shape {values.shape}; it must be ({count},), one for each {on}")


def _whole(corners, colours):
    return corners, colours * brightness(corners, _MIN_LIGHT)[:, None]


def _thirds(corners, colours):
    """Returns outlines (3T, 4, 3) and shaded colours (3T, 3) of thirds of triangles with colours of corners (T, 3, 3)."""
    following, before = np.roll(corners, -1, axis=1), np.roll(corners, 1, axis=1)
    middle = np.broadcast_to(corners.mean(axis=1, keepdims=True), corners.shape)
    outlines = np.stack([corners, (corners + following) / 2.0, middle, (corners + before) / 2.0], axis=2)
    return outlines.reshape(-1, 4, 3), (colours * brightness(corners, _MIN_LIGHT)[:, None, None]).reshape(-1, 3)


def _segments(view, directions):
    ends, greys = [], []
    for (name, (centres, vectors)), grey in zip(directions.items(), cycle(_GREYS), strict=False):
        if np.shape(centres) != np.shape(vectors) or np.shape(centres)[1:] != (3,):
            shapes = f"centres {np.shape(centres)} and vectors {np.shape(vectors)}"
            raise ValueError(f"directions[{name!r}] has {shapes}; both must be (E, 3)")
        centres, halves = view.project(centres), view.project(vectors) / 2.0
        ends.append(np.stack([centres - halves, centres + halves], axis=1))
        greys.append(np.full((len(centres), 3), grey))
    return np.concatenate(ends), np.concatenate(greys)


def _layout(window, title, count=1):
    """Creates a figure, ``count`` axes of the window's shape, side by side if tall, and axes for the bar."""
    from matplotlib.figure import Figure

    left, right, bottom, top = window
    width, height = np.array([right - left, top - bottom]) * _SIDE / max(right - left, top - bottom)
    columns, rows = (count, 1) if width <= height else (1, count)
    foot = _FOOT if count > 1 else 0.0
    height = max(height, (2.0 - rows * foot) / rows)
    size = np.array([columns * width + _RIGHT, rows * (height + foot) + _TOP])
    figure = Figure(figsize=size)
    panels = []
    for k in range(count):
        corner = np.array([k % columns * width, (rows - 1 - k // columns) * (height + foot) + foot])
        panels.append(figure.add_axes([*(corner / size), *([width, height] / size)]))
    figure.text(_GAP / size[0], 1.0 - 0.3 * _TOP / size[1], title, va="center", color=GREY, parse_math=False)
    beside = figure.add_axes([(columns * width + _GAP) / size[0], 0.25, _GAP / size[0], 0.5])
    return figure, panels, beside


def _explain(figure, beside, scale, unit, excluded, unplaced):
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    colours = ListedColormap(scale.srgb(np.linspace(scale.low, scale.high, 257)))
    bar = figure.colorbar(ScalarMappable(Normalize(scale.low, scale.high), colours), cax=beside, extend="both")
    bar.ax.tick_params(labelsize=8, colors=GREY)
    bar.ax.yaxis.offsetText.set(size=8, color=GREY)
    bar.outline.set_visible(False)
    if unit != "1":
        bar.ax.set_title(unit, color=GREY, fontsize=8, pad=14.0)
    if excluded:
        beside.plot([0.5], [-0.25], "s", color=EXCLUDED, transform=beside.transAxes, clip_on=False)
        beside.text(1.8, -0.25, "excluded", transform=beside.transAxes, va="center", fontsize=8, color=GREY)
    if unplaced:
        text = f"{unplaced} triangle{'s' if unplaced > 1 else ''} without a finite position not drawn"
        width, height = figure.get_size_inches()
        figure.text(_GAP / width, 1.0 - 0.75 * _TOP / height, text, va="center", fontsize=8, color=GREY)
