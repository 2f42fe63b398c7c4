"""Colours of a cloth by a measure, on one scale for all frames."""

import numpy as np

from ..analysis.analysis import Analyzer
from ..analysis.measures import MEASURES, scalars
from ..analysis.summaries import PERCENTILES, percentiles
from ..base.checks import did_you_mean, shown
from .colour import Scale, range_of


def scalar_names(measure):
    """Returns the names of the scalars of a measure."""
    return list(scalars(measure, np.zeros((1, *measure.shape))))


def neutral_of(measure):
    """Returns the middle of a measure's colour scale; None for norms."""
    return measure.neutral if len(measure.shape) < 2 else None


def scale_of(analyzers, name, measure, given=None, colormap=None):
    """Returns one scale of a scalar for all rows of some analyses: ``given``, else of percentiles, symmetric about the
    undeformed value.
    """
    neutral = neutral_of(measure)
    if given is None:
        rows = (sample.values[measure.name] for each in analyzers for sample in each.of(measure.name))
        found = (scalars(measure, row)[name].astype(np.float64) for row in rows)
        given = range_of([percentiles(values[~np.isnan(values)]) for values in found], neutral)
    return Scale(*given, neutral, colormap)


class MeasuredScalar:
    """The values of a scalar on the cloths of a subject.

    Args:
        name: The scalar, such as "stretch_1".
        rest: The rest shape, or None for that of the subject.
        options: Options of :class:`warpcloth.Analyzer` by name.

    Raises:
        ValueError: There is no such scalar, it cannot be measured, or there are no triangles.
    """

    def __init__(self, subject, name, rest, device, options):
        measures = MEASURES["triangle" if options.get("neighbourhood") is None else "vertex"].values()
        listed = {scalar: measure for measure in measures for scalar in scalar_names(measure)}
        if name not in listed:
            raise ValueError(f"colour is {shown(name)}; it must be one of {', '.join(listed)}{did_you_mean(name, listed)}")
        self.name, self.measure, self.unit = name, listed[name], listed[name].unit
        chosen = {"measures": self.measure.name, "device": device}
        self.analyzers = [Analyzer(each, rest, **chosen, **options) for each in subject.sequences()]

    def scale(self, others, given, colormap):
        """Returns the scale for these values and those of others."""
        analyzers = [each for one in (self, *others) for each in one.analyzers]
        return scale_of(analyzers, self.name, self.measure, given, colormap)

    def rows(self, frames):
        """Yields values (E,) of frames with ascending indices; NaN if not measured."""
        rows = [_Rows(each, self.name, self.measure) for each in self.analyzers]
        for frame in frames:
            yield np.concatenate([each.at(frame) for each in rows])


class _Rows:
    def __init__(self, analyzer, name, measure):
        self._rows, self._name, self._measure = iter(analyzer), name, measure
        self._sample, self._none = next(self._rows, None), np.full(analyzer.count, np.nan)

    def at(self, frame):
        while self._sample is not None and self._sample.index < frame:
            self._sample = next(self._rows, None)
        if self._sample is None or self._sample.index != frame:
            return self._none
        return np.array(scalars(self._measure, self._sample.values[self._measure.name])[self._name])


class GivenScalar:
    """Values of the user, (F, n) of vertices or (F, T) of triangles."""

    unit = "1"

    def __init__(self, values, subject, name):
        shape = subject.shapes[subject.coloured]
        self.values = values if hasattr(values, "shape") else np.asarray(values)
        counts = (shape.count, len(shape.triangles))
        if self.values.dtype.kind not in "fiub":
            raise ValueError(f"colour has type {self.values.dtype}; it must be real numbers")
        if self.values.ndim != 2 or len(self.values) != len(subject) or self.values.shape[1] not in counts:
            rule = f"({len(subject)}, {counts[0]}) of vertices or ({len(subject)}, {counts[1]}) of triangles"
            raise ValueError(f"colour has shape {self.values.shape}; it must be {rule} in all frames")
        self.name = name

    def scale(self, others, given, colormap):
        if given is None:
            rows = (np.asarray(row, dtype=np.float64) for one in (self, *others) for row in one.values)
            finite = [row for row in (row[np.isfinite(row)] for row in rows) if row.size]
            given = range_of([np.percentile(row, PERCENTILES) for row in finite])
        return Scale(*given, None, colormap)

    def rows(self, frames):
        for frame in frames:
            yield np.asarray(self.values[frame], dtype=np.float64)


class GivenColours:
    """Colours of the user, linear Rec. 709, (F, n, 3) of vertices or (F, T, 3) of triangles."""

    unit, name = "1", ""

    def __init__(self, values, subject):
        shape = subject.shapes[subject.coloured]
        self.values, counts = values, (shape.count, len(shape.triangles))
        if self.values.shape[0] != len(subject) or self.values.shape[1] not in counts or self.values.shape[2] != 3:
            rule = f"({len(subject)}, {counts[0]}, 3) of vertices or ({len(subject)}, {counts[1]}, 3) of triangles"
            raise ValueError(f"colour has shape {self.values.shape}; it must be {rule} in all frames")

    def scale(self, others, given, colormap):
        """Returns None."""

    def rows(self, frames):
        for frame in frames:
            yield np.asarray(self.values[frame], dtype=np.float64)
