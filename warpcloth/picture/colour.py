"""Colour scales of measures."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from ..base.checks import number, shown
from .figures import require_matplotlib

SEQUENTIAL = "viridis"
# The most even of matplotlib's diverging maps (Moreland 2009, "Diverging color maps for scientific visualization"). Its
# lightness L* rises from 38 to 88 and falls back symmetrically to within 0.3; red to blue through white, the next best, differs
# by 4.4 between its sides. Its middle is a neutral grey, visible on a white page, and its ends are light enough to be shaded.
DIVERGING = "coolwarm"
# sRGB of excluded elements, at least 31 ΔE from every colour of the one map and 60 from the other.
EXCLUDED = (0.25, 0.25, 0.25)
# Smallest width of a scale, relative to the largest magnitude, so that float32 rounding, 6e-8 of it, does not fill a scale.
_NARROWEST = 1e-6


@dataclass(frozen=True)
class Scale:
    """Maps values to colours. Values beyond an end have its colour, NaN the grey `EXCLUDED`.

    Attributes:
        low: Value at the lower end.
        high: Value at the upper end.
        neutral: Value in the middle of a diverging map, about which the ends become symmetric; None for a sequential map.
        colormap: Map of matplotlib; by default `DIVERGING` with a neutral value, else `SEQUENTIAL`.

    Raises:
        ValueError: A value is not finite, low is not below high, or there is no such map.
    """

    low: float
    high: float
    neutral: float | None = None
    colormap: str | None = None

    def __post_init__(self):
        if self.colormap is not None:
            check_colormap(self.colormap)
        number("low", self.low)
        number("high", self.high)
        if not self.low < self.high:
            raise ValueError(f"low is {self.low:g} and high {self.high:g}; low must be below high")
        if self.neutral is not None:
            number("neutral", self.neutral)
        low, high = _symmetric(self.low, self.high, self.neutral)
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    @property
    def map(self):
        """Name of the map in matplotlib."""
        return self.colormap or (SEQUENTIAL if self.neutral is None else DIVERGING)

    def srgb(self, values):
        """Returns the colours (…, 3) of values (…) in sRGB, for plots.

        Raises:
            ImportError: matplotlib is not installed.
        """
        values = np.asarray(values, dtype=np.float64)
        stops = table(self.map)
        at = np.linspace(self.low, self.high, len(stops))
        if self.neutral is not None:
            at[len(at) // 2] = self.neutral  # to the last bit
        colours = np.stack([np.interp(values, at, channel) for channel in stops.T], axis=-1)
        colours[np.isnan(values)] = EXCLUDED
        return colours

    def linear(self, values):
        """Returns the colours (…, 3) of values (…) in linear Rec. 709, for displayColor of USD.

        Raises:
            ImportError: matplotlib is not installed.
        """
        return to_linear(self.srgb(values))

    def legend(self, measure, unit):
        """Returns the scale of a ``measure`` with a ``unit`` as numbers and texts for metadata, in linear Rec. 709."""
        values = np.linspace(self.low, self.high, 9)
        if self.neutral is not None:
            values[4] = self.neutral
        facts = {"measure": measure, "unit": unit, "map": self.map, "low": self.low, "high": self.high}
        if self.neutral is not None:
            facts["neutral"] = float(self.neutral)
        for k, (value, colour) in enumerate(zip(values.tolist(), self.linear(values), strict=True)):
            facts[f"stop_{k}"] = {"value": value, **_channels(colour)}
        return {**facts, "excluded": _channels(self.linear(np.nan))}


def range_over(summaries, neutral=None):
    """Returns (low, high) over all frames: the smallest 1st and the largest 99th percentile of ``summaries``, symmetric about
    ``neutral``.
    """
    return range_of([summary.percentiles for summary in summaries], neutral)


def range_of(rows, neutral=None):
    """:func:`range_over` for percentiles (F, 9)."""
    ends = np.array(rows, dtype=np.float64).reshape(-1, 9)[:, [1, -2]]
    ends = ends[np.isfinite(ends)]
    if not len(ends):
        ends = np.array([neutral or 0.0])
    low, high = _symmetric(ends.min(), ends.max(), neutral)
    width = _NARROWEST * max(abs(low), abs(high))
    if high - low <= width:
        width = width or 1.0
        return (low, low + width) if neutral is None else (neutral - width, neutral + width)
    return low, high


def to_linear(colours):
    """Converts sRGB to linear Rec. 709 (IEC 61966-2-1)."""
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)


def byte_colour(linear):
    """Converts linear Rec. 709 to sRGB from 0 to 255. 709 to a tuple of sRGB from 0 to 255."""
    c = np.asarray(linear)
    coded = np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)
    return tuple(np.round(255.0 * coded).astype(int).tolist())


def check_colormap(name):
    """Raises ValueError if matplotlib has no colour map of a name, with similar names."""
    require_matplotlib()
    from difflib import get_close_matches

    from matplotlib import colormaps

    if not isinstance(name, str) or name not in colormaps:
        near = get_close_matches(str(name), list(colormaps), 3) or ["viridis", "cividis", "coolwarm", "RdBu"]
        raise ValueError(f"colormap is {shown(name)}; it must be a colour map of matplotlib, such as {', '.join(near)}")


@cache
def table(name):
    """Returns a map of matplotlib as sRGB (257, 3), with one colour in the middle.

    Raises:
        ImportError: matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib import colormaps

    return colormaps[name].resampled(257)(np.arange(257))[:, :3]


def _symmetric(low, high, neutral):
    if neutral is None:
        return float(low), float(high)
    half = max(abs(high - neutral), abs(low - neutral))
    return float(neutral - half), float(neutral + half)


def _channels(colour):
    return dict(zip(("red", "green", "blue"), map(float, colour), strict=True))
