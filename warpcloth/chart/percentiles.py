"""Plots percentiles of measures over time."""

import math

import numpy as np

from ..base.checks import choice
from ..picture.figures import GREY
from .style import COLOURS, LEGEND, SMALL, drawn, dress, small_print

# Columns of each band among the percentiles 0, 1, 5, 25, 50, 75, 95, 99 and 100 %, its grey and its label.
_BANDS = ((1, 7, "0.88", "1 to 99 %"), (2, 6, "0.76", "5 to 95 %"), (3, 5, "0.6", "25 to 75 %"))
_MEDIAN, _EXTREMES = 4, (0, 8)
_NOTE = {"ha": "right", "fontsize": SMALL, "color": GREY, "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 1.0}}


def plot_percentiles(path, summaries, along="time", neutrals=None, device="cpu"):
    """Plots each scalar in a panel: median, bands from 25 to 75, 5 to 95 and 1 to 99 %, and extremes, along "time" or "frame".

    Rows without values leave gaps; extremes far outside the bands are given as numbers. ``summaries`` have ``name``, ``unit``,
    ``time`` [s], ``frame`` and ``percentiles`` of 0, 1, 5, 25, 50, 75, 95, 99 and 100 %, ``neutrals`` the undeformed values by
    name, or None.
    """
    choice("along", along, ("time", "frame"))
    rows = {}
    for summary in summaries:
        rows.setdefault(summary.name, []).append(summary)
    if not rows:
        raise ValueError(f"{path}: there are no summaries; a plot must have one or more")
    columns = min(math.ceil(math.sqrt(len(rows))), 5)
    lines = math.ceil(len(rows) / columns)
    with drawn(path, max(3.6 * columns, 5.0), 2.6 * lines + 0.4) as figure:
        panels = figure.subplots(lines, columns, squeeze=False, sharex=True).ravel()
        for axes, (name, found) in zip(panels, rows.items(), strict=False):
            at = np.array([getattr(summary, along) for summary in found], dtype=np.float64)
            _panel(axes, at, np.array([summary.percentiles for summary in found], dtype=np.float64), (neutrals or {}).get(name))
            unit = "" if found[0].unit == "1" else f" [{found[0].unit}]"
            axes.set_ylabel(f"{name}{unit}", parse_math=False)
            axes.set_xlabel("time [s]" if along == "time" else "frame")
            dress(axes)
            axes.tick_params(labelbottom=True)
        for axes in panels[len(rows) :]:
            axes.remove()
        known = {}
        for axes in panels[: len(rows)]:
            known.update(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
        figure.legend(known.values(), known, loc="outside upper center", ncols=3, **LEGEND)
        small_print(figure, device=device)


def _panel(axes, at, percentiles, neutral):
    _frame(axes, percentiles, neutral)
    percentiles = np.where(np.isfinite(percentiles), percentiles, np.nan)
    alone = _alone(~np.isnan(percentiles[:, _MEDIAN]))
    for k, (low, high, grey, label) in enumerate(_BANDS):
        low, high = percentiles[:, low], percentiles[:, high]
        axes.fill_between(at, low, high, color=grey, linewidth=0, label=label)
        axes.vlines(at[alone], low[alone], high[alone], color=grey, linewidth=2 + 2 * k)
    for column, label in zip(_EXTREMES, ("extremes", None), strict=True):
        axes.plot(at, percentiles[:, column], color="0.45", linewidth=0.5, label=label)
        axes.plot(at[alone], percentiles[alone, column], "_", color="0.45", markersize=5, markeredgewidth=0.5)
    axes.plot(at, percentiles[:, _MEDIAN], color="black", linewidth=1.2, label="median")
    axes.plot(at[alone], percentiles[alone, _MEDIAN], "o", color="black", markersize=3)
    if neutral is not None:
        axes.axhline(neutral, color=COLOURS[2], linewidth=0.8, linestyle=(0, (4, 3)), label="undeformed")


def _alone(known):
    padded = np.pad(known, 1)
    return known & ~padded[:-2] & ~padded[2:]


def _frame(axes, percentiles, neutral):
    """Limits the panel to the bands and as much on either side, and labels extremes beyond."""
    known = percentiles[~np.isnan(percentiles)]
    finite = known[np.isfinite(known)]
    if not len(finite):
        axes.text(0.5, 0.5, "nothing finite" if len(known) else "no values", ha="center", transform=axes.transAxes, color=GREY)
        axes.set_yticks([])
        return
    bands = percentiles[:, 1:8]
    bands = np.append(bands[np.isfinite(bands)], [] if neutral is None else [neutral])
    shown = np.append(finite, bands)
    low, high = shown.min(), shown.max()
    if len(bands) and np.ptp(bands) > 0.0:
        margin = np.ptp(bands)
        low, high = max(low, bands.min() - margin), min(high, bands.max() + margin)
        axes.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
    if known.max() > high:
        axes.text(0.99, 0.98, f"to {known.max():.3g}", va="top", transform=axes.transAxes, **_NOTE)
    if known.min() < low:
        axes.text(0.99, 0.02, f"to {known.min():.3g}", va="bottom", transform=axes.transAxes, **_NOTE)
