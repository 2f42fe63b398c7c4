"""Summaries of fields against NumPy, and the files of an analysis: exact, strict, whole, and written in flat memory."""

import csv
import json
import math
import tracemalloc
import zipfile
from dataclasses import astuple, dataclass

import numpy as np
import pytest

from support.rows import slow_but
from warpcloth.analysis.stacks import NpzWriter
from warpcloth.analysis.summaries import PERCENTILES, CsvWriter, JsonWriter, Summary, summarise

EPS = np.finfo(np.float64).eps
INF, NAN = math.inf, math.nan


@dataclass(frozen=True)
class Measure:
    """What the writers read of a measure."""

    name: str
    shape: tuple[int, ...]
    unit: str
    neutral: float | None


@dataclass(frozen=True)
class Exclusion:
    """What the writers read of an exclusion."""

    kind: str
    elements: np.ndarray
    reason: str


def summary(values, weights=None, frame=7, reference=None, time=0.25):
    places = np.arange(3.0 * len(values)).reshape(-1, 3) / 7.0
    weights = np.ones(len(values)) if weights is None else weights
    return summarise("stretch_1", "1", values, places, weights, frame=frame, reference=reference, time=time)


# --- numbers


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("excluded", [0.0, 0.3])
@pytest.mark.parametrize("count", [1, 2, 3, 10, 101, 5000])
def test_summary_is_that_of_numpy(count, excluded, dtype):
    """Bit for bit, but for the sum of the area mean: its n products and n − 1 sums round by no more than nε Σ|wv| together,
    and the sum of the weights, relatively, by as much."""
    random = np.random.default_rng(count)
    values = random.normal(size=count).astype(dtype)
    values[1:][random.uniform(size=count - 1) < excluded] = np.nan
    places, weights = random.normal(size=(count, 3)), random.uniform(size=count)
    found = summarise("a", "1", values, places, weights, frame=0, reference=3, time=0.0)
    there = ~np.isnan(values)
    exact = values[there].astype(np.float64)
    assert (found.measured, found.excluded) == (there.sum(), (~there).sum())
    assert found.percentiles == tuple(np.percentile(exact, PERCENTILES))
    assert found.mean == exact.mean()
    assert (found.smallest, found.largest) == (np.nanargmin(values), np.nanargmax(values))
    assert found.smallest_at == tuple(places[found.smallest]) and found.largest_at == tuple(places[found.largest])
    shares = exact * weights[there]
    total = math.fsum(weights[there])
    bound = 2 * count * EPS * math.fsum(abs(shares)) / total
    assert abs(found.area_mean - math.fsum(shares) / total) <= bound


@pytest.mark.parametrize(
    ("values", "percentiles", "mean", "ends"),
    [
        ([NAN, 2.0, INF], [2.0, *[INF] * 8], INF, (1, 2)),
        ([-INF, 0.0, 4.0], [-INF, -INF, -INF, -INF, 0.0, 2.0, 3.6, 3.92, 4.0], -INF, (0, 2)),
        ([-INF, INF], [-INF, *[NAN] * 7, INF], NAN, (0, 1)),
        ([INF, INF], [INF] * 9, INF, (0, 0)),
        ([1.0, 3.0, 1.0, 3.0], [1, 1, 1, 1, 2, 3, 3, 3, 3], 2.0, (0, 1)),
        ([NAN, NAN], [NAN] * 9, NAN, (-1, -1)),
        ([], [NAN] * 9, NAN, (-1, -1)),
    ],
    ids=["+inf", "-inf", "both", "only inf", "ties", "nothing", "no elements"],
)
@pytest.mark.filterwarnings("error")
def test_infinite_values_count_and_nan_does_not(values, percentiles, mean, ends):
    """Interpolated between a number and an infinite one a percentile is infinite; of ties the first element counts."""
    found = summary(np.array(values))
    # 3.6 and 3.92 are not float64: a product and a sum.
    assert found.percentiles == pytest.approx(tuple(percentiles), rel=2 * EPS, nan_ok=True)
    assert found.mean == pytest.approx(mean, nan_ok=True) and found.area_mean == pytest.approx(mean, nan_ok=True)
    assert (found.smallest, found.largest) == ends
    assert np.isnan(found.smallest_at).all() == (ends[0] < 0) and np.isnan(found.largest_at).all() == (ends[1] < 0)


def test_weights_of_what_is_excluded_are_not_read():
    """An element without area has no share, whatever its value; where none has area there is no area mean."""
    assert summary(np.array([1.0, NAN, 4.0]), np.array([2.0, NAN, 1.0])).area_mean == 2.0
    assert summary(np.array([1.0, INF]), np.array([2.0, 0.0])).area_mean == 1.0
    assert math.isnan(summary(np.array([1.0, 2.0]), np.zeros(2)).area_mean)


@pytest.mark.parametrize(
    ("values", "weights", "message"),
    [
        (np.zeros((2, 3)), np.ones(2), r"a: values \(2, 3\), weights \(2,\) and positions \(2, 3\) do not go together"),
        (np.zeros(2), np.ones(3), r"a: values \(2,\), weights \(3,\)"),
        (np.zeros(3), np.ones(3), r"positions \(2, 3\)"),
        (np.zeros(2), np.array([1.0, -1.0]), "a: the weight of a measured element is negative or not finite"),
        (np.zeros(2), np.array([1.0, NAN]), "negative or not finite"),
        (np.zeros(2), np.array([1.0, INF]), "negative or not finite"),
    ],
)
def test_what_does_not_go_together_is_refused(values, weights, message):
    with pytest.raises(ValueError, match=message):
        summarise("a", "1", values, np.zeros((2, 3)), weights, frame=0, reference=None, time=0.0)


# --- files


def many(count):
    """Summaries of fields of 40 elements, one of them of nothing."""
    random = np.random.default_rng(0)
    fields = random.normal(size=(count, 40))
    fields[:1] = np.nan
    fields[1:, 3] = np.nan
    fields[1:2, 5] = np.inf
    return [summary(field, frame=row, reference=None if row % 2 else -row) for row, field in enumerate(fields)]


def same(cell, value):
    """Whether a cell is exactly a value, NaN and no element being empty."""
    if isinstance(value, str):
        return cell == value
    return cell == "" if math.isnan(value) or value == -1 else float(cell) == value


def test_csv_is_read_back_exactly(tmp_path):
    rows = many(5)
    with CsvWriter(tmp_path / "a.csv") as writer:
        for row in rows:
            writer.append(row)
    with open(tmp_path / "a.csv", encoding="utf-8", newline="") as file:
        header, *lines = csv.reader(file)
    assert tuple(header) == CsvWriter.COLUMNS and len(lines) == len(rows)
    for line, row in zip(lines, rows, strict=True):
        flat = [item for value in astuple(row) for item in (value if isinstance(value, tuple) else (value,))]
        flat[1] = "rest" if row.reference is None else row.reference
        assert all(same(cell, value) for cell, value in zip(line, flat, strict=True))
    place = {name: at for at, name in enumerate(header)}
    assert lines[0][place["p0"] :] == [""] * 17 and lines[1][place["p100"]] == "inf"
    assert lines[1][place["reference"]] == "rest" and lines[2][place["min_element"]] == str(rows[2].smallest)


def strict(text):
    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    return json.loads(text, parse_constant=refuse)


@pytest.mark.parametrize("count", [0, 1, 4])
def test_json_is_strict_and_whole(tmp_path, count):
    """Measures, rows and exclusions are what was given; no value is null, an infinite one a text."""
    measures = {"stretch": Measure("stretch", (2,), "1", 1.0), "energy": Measure("energy", (), "J/m²", None)}
    exclusions = [
        (Exclusion("triangle", np.array([3, 5]), "no area"), None),
        (Exclusion("vertex", np.array([], dtype=int), '"lost"\n'), np.int64(12)),
    ][:count]
    rows = many(count)
    with JsonWriter(tmp_path / "a.json", {"path": tmp_path, "fps": np.float32(24), "start": NAN}, measures) as writer:
        for row in rows:
            writer.append(row)
        for exclusion, frame in exclusions:
            writer.exclude(exclusion, frame)
        writer.facts["worst"] = [np.float64(INF), -INF, True]
    document = strict((tmp_path / "a.json").read_text(encoding="utf-8"))
    assert document["input"] == {"path": str(tmp_path), "fps": 24.0, "start": None}
    assert document["facts"] == {"worst": ["inf", "-inf", True]}
    assert document["measures"] == {
        "stretch": {"shape": [2], "unit": "1", "neutral": 1.0},
        "energy": {"shape": [], "unit": "J/m²", "neutral": None},
    }
    assert (
        document["exclusions"]
        == [
            {"frame": "rest", "kind": "triangle", "reason": "no area", "count": 2, "elements": [3, 5]},
            {"frame": 12, "kind": "vertex", "reason": '"lost"\n', "count": 0, "elements": []},
        ][:count]
    )
    if rows:
        nothing = document["rows"][0]
        assert nothing["mean"] is nothing["smallest"] is nothing["largest_at"] is nothing["percentiles"]["50"] is None
    for found, row in list(zip(document["rows"], rows, strict=True))[1:]:
        found["reference"] = None if found["reference"] == "rest" else found["reference"]
        found["percentiles"] = tuple(float(found["percentiles"][str(each)]) for each in PERCENTILES)
        found |= {name: tuple(found[name]) for name in ("smallest_at", "largest_at")}
        found |= {name: float(found[name]) for name in ("mean", "area_mean")}
        assert Summary(**found) == row


FIELDS = {"f": ((6, 3, 2), "float32"), "angle": ((6,), ">f8"), "none": ((0, 2), "float64")}


def stacked(count):
    random = np.random.default_rng(1)
    return {name: random.normal(size=(count, *shape)).astype(dtype) for name, (shape, dtype) in FIELDS.items()}


def write_npz(path, promised, arrays, count):
    with NpzWriter(path, promised, FIELDS) as writer:
        for row in range(count):
            values = {name: array[row] for name, array in arrays.items()}
            writer.append(row + 0.5, row or None, row / 24, {**values, "another": 1.0})


@pytest.mark.parametrize("count", [0, 1, 4])
def test_npz_stacks_rows(tmp_path, count, monkeypatch):
    """As many rows as came, of the dtype they had, also where a field is larger than a plain ZIP takes; equal, equal files."""
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 100)  # stands for 2 GiB
    arrays = stacked(count)
    for name in ("a", "b"):
        write_npz(tmp_path / f"{name}.npz", 4, arrays, count)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as found:
        assert set(found) == {"frames", "references", "times", *FIELDS}
        for name, array in arrays.items():
            assert found[name].dtype == array.dtype and np.array_equal(found[name], array)
        assert found["frames"].tolist() == [row + 0.5 for row in range(count)]
        assert np.array_equal(found["references"], [row or np.nan for row in range(count)], equal_nan=True)
        assert found["times"].tolist() == [row / 24 for row in range(count)]
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_npz_interrupted_in_a_row_has_the_rows_before(tmp_path):
    """Also where some fields of a row are written and others are not."""
    arrays = stacked(3)
    rows = [{name: array[row] for name, array in arrays.items()} for row in range(3)]
    with pytest.raises(KeyboardInterrupt), NpzWriter(tmp_path / "a.npz", 3, FIELDS) as writer:
        for row in (0, 1):
            writer.append(row, None, 0.0, rows[row])
        writer._parts["f"].write(b"half")  # as a row leaves it that is interrupted while it is written
        raise KeyboardInterrupt
    with NpzWriter(tmp_path / "b.npz", 2, FIELDS) as writer:
        for row in (0, 1):
            writer.append(row, None, 0.0, rows[row])
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_npz_refuses_what_was_not_promised(tmp_path):
    values = {name: array[0] for name, array in stacked(1).items()}
    with NpzWriter(tmp_path / "a.npz", 1, FIELDS) as writer:
        with pytest.raises(ValueError, match=r"field angle has shape \(5,\) and dtype >f8; it must be \(6,\), >f8"):
            writer.append(0, None, 0.0, {**values, "angle": values["angle"][:5]})
        with pytest.raises(ValueError, match=r"field f has shape \(6, 3, 2\) and dtype float64; it must be .*, float32"):
            writer.append(0, None, 0.0, {**values, "f": values["f"].astype(np.float64)})
        writer.append(0, None, 0.0, values)
        with pytest.raises(ValueError, match=r"a\.npz: 1 rows were promised, and this is one more"):
            writer.append(0, None, 0.0, values)
    with np.load(tmp_path / "a.npz") as found:
        assert all(np.array_equal(found[name], [value]) for name, value in values.items())
    with pytest.raises(ValueError, match="field times: the name is taken by the times of the rows"):
        NpzWriter(tmp_path / "b.npz", 1, {"times": ((2,), "float32")})
    assert [each.name for each in tmp_path.iterdir()] == ["a.npz"]


# --- whole or not at all


def append_npz(writer, row):
    writer.append(row.frame, row.reference, row.time, {"f": np.full(4, row.mean)})


WRITERS = {
    "csv": (CsvWriter, CsvWriter.append),
    "json": (lambda path: JsonWriter(path, {}, {}), JsonWriter.append),
    "npz": (lambda path: NpzWriter(path, 100, {"f": ((4,), "float64")}), append_npz),
}


def count_rows(path):
    """Number of rows in a finished file."""
    if path.suffix == ".npz":
        return len(np.load(path)["f"])
    text = path.read_text(encoding="utf-8")
    return len(text.splitlines()) - 1 if path.suffix == ".csv" else len(strict(text)["rows"])


@pytest.mark.parametrize("ending", WRITERS)
def test_failure_leaves_what_was_there(tmp_path, ending):
    """Where nothing stood nothing stands, and of an earlier file every byte; there is no other file."""
    start, append = WRITERS[ending]
    path = tmp_path / f"a.{ending}"
    for earlier in (None, b"earlier"):
        if earlier:
            path.write_bytes(earlier)
        with pytest.raises(ZeroDivisionError), start(path) as writer:
            append(writer, many(2)[1])
            raise ZeroDivisionError
        assert [each.read_bytes() for each in tmp_path.iterdir()] == ([earlier] if earlier else [])


@pytest.mark.parametrize("ending", WRITERS)
def test_failure_at_the_end_leaves_what_was_there(tmp_path, ending, monkeypatch):
    start, append = WRITERS[ending]
    path = tmp_path / f"a.{ending}"
    path.write_bytes(b"earlier")

    def full(*_):
        raise OSError("No space left on device")

    with pytest.raises(OSError, match="No space"), start(path) as writer:
        append(writer, many(2)[1])
        monkeypatch.setattr(writer, "finish", full)
    assert [each.read_bytes() for each in tmp_path.iterdir()] == [b"earlier"]


@pytest.mark.parametrize("ending", WRITERS)
def test_interrupt_keeps_the_rows_there(tmp_path, ending):
    start, append = WRITERS[ending]
    path = tmp_path / f"a.{ending}"
    path.write_bytes(b"earlier")
    with pytest.raises(KeyboardInterrupt), start(path) as writer:
        for row in many(3):
            append(writer, row)
        assert path.read_bytes() == b"earlier"
        raise KeyboardInterrupt
    assert count_rows(path) == 3 and list(tmp_path.iterdir()) == [path]
    writer.close()
    writer.discard()
    assert count_rows(path) == 3


@pytest.mark.parametrize("ending", WRITERS)
def test_link_stays_and_its_file_is_written(tmp_path, ending):
    start, append = WRITERS[ending]
    (tmp_path / "folder").mkdir()
    link, file = tmp_path / f"a.{ending}", tmp_path / "folder" / f"b.{ending}"
    link.symlink_to(file)
    with start(link) as writer:
        append(writer, many(2)[1])
    assert link.is_symlink() and count_rows(file) == 1 and list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize("ending", WRITERS)
def test_places_that_cannot_be_written_are_refused_at_once(tmp_path, ending):
    start, _ = WRITERS[ending]
    with pytest.raises(FileNotFoundError, match=rf"a\.{ending}: the folder .*missing does not exist$"):
        start(tmp_path / "missing" / f"a.{ending}")
    for place in (tmp_path, "/dev/null"):
        with pytest.raises(ValueError, match=f"{place}: is no regular file; it must be one, or free"):
            start(place)
    assert not list(tmp_path.iterdir())


def peak(write, count):
    """What ``write`` returns, and the most memory that Python and NumPy held at once meanwhile [bytes]."""
    tracemalloc.start()
    try:
        return write(count), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("ending", slow_but(["csv", "npz"], WRITERS))
def test_memory_does_not_grow_with_rows(tmp_path, ending):
    """3000 rows more, more than half a MiB on the disk, take no more memory than a buffer of 64 KiB; NPZ holds labels."""
    row = many(2)[1]
    field = np.ones(100)

    def write(count):
        path = tmp_path / f"{count}.{ending}"
        writer = NpzWriter(path, count, {"f": ((100,), "float64")}) if ending == "npz" else WRITERS[ending][0](path)
        with writer:
            for at in range(count):
                if ending == "npz":
                    writer.append(at, None, 0.0, {"f": field})
                else:
                    writer.append(row)
                if ending == "json":
                    writer.exclude(Exclusion("triangle", np.arange(10), "no area"), at)
        return path.stat().st_size

    write(2)  # imports and caches
    (small, few), (large, more) = peak(write, 1000), peak(write, 4000)
    assert large - small > 1 << 19 and more - few < (1 << 16) + (3 * 8 * 3000 if ending == "npz" else 0)
