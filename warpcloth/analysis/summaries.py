"""Summaries of fields, and their CSV and JSON files."""

import csv
import math
import shutil
import tempfile
from dataclasses import dataclass

import numpy as np

from ..base.outputs import TEXT, Output
from ..base.texts import json_text

PERCENTILES = (0, 1, 5, 25, 50, 75, 95, 99, 100)


@dataclass(frozen=True)
class Summary:
    """Statistics of a scalar field of one row, over elements with a value (not NaN).

    Attributes:
        frame: Label of the frame.
        reference: Label of its reference, or None for the rest shape.
        time: Its time [s].
        measured: Elements with a value.
        excluded: Elements without.
        area_mean: Σ wᵢvᵢ / Σ wᵢ, w the rest areas.
        percentiles: `PERCENTILES` (9,), interpolated linearly.
        smallest: First element with the smallest value, or -1.
        smallest_at: Its position in this frame (3,) [m].
        largest: First element with the largest value, or -1.
        largest_at: Its position in this frame (3,) [m].
    """

    frame: float
    reference: float | None
    time: float
    name: str
    unit: str
    measured: int
    excluded: int
    mean: float
    area_mean: float
    percentiles: tuple[float, ...]
    smallest: int
    smallest_at: tuple[float, float, float]
    largest: int
    largest_at: tuple[float, float, float]


def summarise(name, unit, values, positions, weights, *, frame, reference, time):
    """Returns the `Summary` of values (E,), NaN where excluded, at positions (E, 3) [m], weighted by rest areas (E,) [m²]."""
    values, weights, positions = np.asarray(values, dtype=np.float64), np.asarray(weights), np.asarray(positions)
    if values.ndim != 1 or weights.shape != values.shape or positions.shape != (*values.shape, 3):
        shapes = f"values {values.shape}, weights {weights.shape} and positions {positions.shape}"
        raise ValueError(f"{name}: {shapes} do not go together; they must be (E,), (E,) and (E, 3)")
    total, elements = len(values), np.flatnonzero(~np.isnan(values))
    values, weights = values[elements], weights[elements]
    if not (np.isfinite(weights) & (weights >= 0.0)).all():
        raise ValueError(f"{name}: the weight of a measured element is negative or not finite; it must be an area")
    smallest, largest = (int(elements[find(values)]) if len(values) else -1 for find in (np.argmin, np.argmax))
    with np.errstate(invalid="ignore", over="ignore"):  # ∞ − ∞ has no mean
        mean = float(values.mean()) if len(values) else math.nan
    return Summary(
        frame=frame,
        reference=reference,
        time=float(time),
        name=name,
        unit=unit,
        measured=len(values),
        excluded=total - len(values),
        mean=mean,
        area_mean=_weighted_mean(values, weights),
        percentiles=percentiles(values),
        smallest=smallest,
        smallest_at=_position(positions, smallest),
        largest=largest,
        largest_at=_position(positions, largest),
    )


def _position(positions, element):
    return (math.nan,) * 3 if element < 0 else tuple(positions[element].astype(np.float64).tolist())


def _weighted_mean(values, weights):
    total = weights.sum(dtype=np.float64)
    if not total > 0.0:
        return math.nan
    with np.errstate(invalid="ignore", over="ignore"):
        return float(np.where(weights > 0.0, values, 0.0) @ weights / total)  # avoids 0·∞


def percentiles(values):
    """Returns `PERCENTILES` of values without NaN, like NumPy's; beside infinity, infinity."""
    if not len(values):
        return (math.nan,) * len(PERCENTILES)
    ordered = np.sort(values)  # vectorised, and so several times as fast as a partition
    at = np.array(PERCENTILES) / 100 * (len(values) - 1)
    low, high = ordered[np.floor(at).astype(int)], ordered[np.ceil(at).astype(int)]
    t = at - np.floor(at)
    with np.errstate(invalid="ignore", over="ignore"):
        between = np.where(t < 0.5, low + (high - low) * t, high - (high - low) * (1.0 - t))
        finite = np.isfinite(low) & np.isfinite(high)
        return tuple(np.where(finite, between, low + high).tolist())


def _label(reference):
    return "rest" if reference is None else reference


class CsvWriter(Output):
    """Writes a CSV table, a line per frame and scalar, with `COLUMNS`, in UTF-8.

    Numbers have all digits of float64; missing ones are empty.
    """

    COLUMNS = (
        *("frame", "reference", "time", "name", "unit", "measured", "excluded", "mean", "area_mean"),
        *(f"p{percentile}" for percentile in PERCENTILES),
        *(f"{end}_{what}" for end in ("min", "max") for what in ("element", "x", "y", "z")),
    )

    def __init__(self, path):
        """Starts the table; raises FileNotFoundError without the folder, ValueError for a folder or a device."""
        super().__init__(path, "x", **TEXT)
        self._table = csv.writer(self.file, lineterminator="\n")
        self._table.writerow(self.COLUMNS)

    def append(self, summary):
        """Adds the line of a `Summary`."""
        s = summary
        cells = [s.frame, _label(s.reference), s.time, s.name, s.unit, s.measured, s.excluded, s.mean, s.area_mean]
        cells += [*s.percentiles, s.smallest, *s.smallest_at, s.largest, *s.largest_at]
        for column in (self.COLUMNS.index("min_element"), self.COLUMNS.index("max_element")):
            cells[column] = "" if cells[column] < 0 else cells[column]
        self._table.writerow(["" if isinstance(cell, float) and math.isnan(cell) else cell for cell in cells])


class JsonWriter(Output):
    """Writes a strict JSON object as a stream: ``input``, ``measures``, ``rows``, ``exclusions``, ``facts``.

    Missing values are null, infinities "inf" and "-inf".

    Attributes:
        facts: Further facts by name, written by `close`.
    """

    def __init__(self, path, input, measures):
        """Starts the document with texts and numbers about the input, and the measures by name with ``shape``, ``unit`` and
        ``neutral``.
        """
        self.facts = {}
        shown = {name: {key: getattr(each, key) for key in ("shape", "unit", "neutral")} for name, each in measures.items()}
        start = f'{{"input": {_json(input)},\n"measures": {_json(shown)},\n"rows": ['
        super().__init__(path, "x", **TEXT)
        self.file.write(start)
        self._exclusions = tempfile.TemporaryFile("w+", dir=self.folder, **TEXT)
        self._rows_begun = self._exclusions_begun = False

    def append(self, summary):
        """Adds a `Summary` to the rows."""
        row = {**vars(summary), "reference": _label(summary.reference)}
        row["percentiles"] = dict(zip(map(str, PERCENTILES), summary.percentiles, strict=True))
        for end in ("smallest", "largest"):
            there = row[end] >= 0
            row[end], row[f"{end}_at"] = (row[end], row[f"{end}_at"]) if there else (None, None)
        self.file.write((",\n" if self._rows_begun else "\n") + _json(row))
        self._rows_begun = True

    def exclude(self, exclusion, frame):
        """Adds an exclusion of a frame, or of the rest shape (None)."""
        elements = np.asarray(exclusion.elements)
        entry = {"frame": _label(frame), "kind": exclusion.kind, "reason": exclusion.reason}
        entry |= {"count": len(elements), "elements": elements}
        self._exclusions.write((",\n" if self._exclusions_begun else "\n") + _json(entry))
        self._exclusions_begun = True

    def parts(self):
        return (self._exclusions,)

    def finish(self):
        self.file.write('\n],\n"exclusions": [')
        with self._exclusions as part:
            part.seek(0)
            shutil.copyfileobj(part, self.file)
        self.file.write(f'\n],\n"facts": {_json(self.facts)}}}\n')


def _json(value):
    return json_text(value, nan=None, ensure_ascii=False)
