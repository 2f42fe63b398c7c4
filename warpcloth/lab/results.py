"""Results of benchmarks: growth with size, ratios of two results, tables and files."""

import json
from pathlib import Path

import numpy as np

from ..base.outputs import write_table
from ..base.tables import distinct

# Columns that identify a row in two results.
_SAME = ("scene", "parameters", "solver", "options", "device", "dtype", "copies", "threads")
# Columns of a CSV; unknown values are empty.
COLUMNS = (
    *("scene", "parameters", "solver", "options", "device", "dtype", "copies", "threads", "status", "reason"),
    *("vertices", "elements", "substeps", "iterations", "frames", "ms", "ms_low", "ms_high", "cloths_per_s", "ns", "bytes"),
    *("bytes_per_s", "share", "launches"),
    *("start_s", "cold_start_s", "bind_s", "factorise_s", "memory", "triangles", "ms_without", "contact_ns"),
    *("pairs", "lists", "kept", "least_gap", "list_ns", "find_ns"),
    *("grade", "distance"),
)


def exponent(sizes, values):
    """Fits values ∝ sizesᵖ, each (m,) above 0, by least squares of logarithms, and returns p and its standard error.

    The error is None for two points; both are None for fewer points or if all sizes are equal.
    """
    x, y = (np.log(np.asarray(each, dtype=np.float64)) for each in (sizes, values))
    x = x - x.mean() if len(x) else x
    square = float(x @ x)
    if square == 0.0:
        return None, None
    p = float(x @ y) / square
    if len(x) == 2:
        return p, None
    left = y - y.mean() - p * x
    return p, float(np.sqrt(left @ left / (len(x) - 2) / square))


def growth(rows):
    """Returns how the times of a frame and of an iteration grow with the number of vertices, for benchmarks of several sizes.

    They differ if finer scenes take more substeps or iterations. For one cloth on mesh colliders of several sizes, growth is
    relative to the triangles of the colliders.

    Returns:
        list: For each benchmark ``solver``, the ``options`` that all sizes share, ``over``, "vertices" or "triangles", and
        ``frame`` and ``iteration``, each [p, error] of :func:`exponent`; with self-contact also ``list`` and ``find``.
    """
    found, known = [], [row for row in rows if row["status"] == "ok"]
    for number in dict.fromkeys(row["benchmark"] for row in known):
        of = [row for row in known if row["benchmark"] == number]
        triangles = [row.get("triangles") for row in of]
        over = "triangles" if len({row["vertices"] for row in of}) == 1 and all(triangles) else "vertices"
        sizes = [row[over] for row in of]
        frame = exponent(sizes, [row["ms"] for row in of])
        if frame[0] is None:
            continue
        iteration = exponent(sizes, [row["ms"] / (row["substeps"] * max(row["iterations"], 1.0)) for row in of])
        shared = {k: v for k, v in of[0]["options"].items() if all(row["options"].get(k) == v for row in of)}
        one = {"benchmark": number, "solver": of[0]["solver"], "options": shared, "over": over}
        one |= {"frame": list(frame), "iteration": list(iteration)}
        for name in ("list", "find"):
            if all(row.get(f"{name}_ns") for row in of):
                one[name] = list(exponent(sizes, [row[f"{name}_ns"] * row["vertices"] for row in of]))
        found.append(one)
    return found


def ratios(old, new):
    """Returns the ratios new over old of rows that are "ok" in both results.

    The spread of a ratio of times goes from lower quartile over upper quartile to the reverse, so a difference exceeds it if
    the quartiles do not overlap.

    Returns:
        list: For each row the columns that identify it, ``label``, ``ms`` (old, new), ``ratio``, ``spread`` (low, high),
        ``verdict`` ("faster", "slower" or "" within the spread), and the ratios ``launches``, ``bytes``, ``start`` and
        ``memory``, None if unknown.
    """
    before, found = {_key(row): row for row in old["rows"] if row["status"] == "ok"}, []
    for row in new["rows"]:
        was = before.get(_key(row))
        if was is None or row["status"] != "ok":
            continue
        spread = [row["spread"][0] / was["spread"][1], row["spread"][1] / was["spread"][0]]
        one = {name: row[name] for name in (*_SAME, "label")}
        one |= {"ms": [was["ms"], row["ms"]], "ratio": row["ms"] / was["ms"], "spread": spread}
        one["verdict"] = "faster" if spread[1] < 1.0 else "slower" if spread[0] > 1.0 else ""
        for name, column in (("launches", "launches"), ("bytes", "bytes"), ("start", "start_s"), ("memory", "memory")):
            one[name] = row[column] / was[column] if row[column] and was[column] else None
        found.append(one)
    return found


def _key(row):
    return json.dumps([row[name] for name in _SAME], sort_keys=True)


def read(path):
    """Reads a result that ``warpcloth bench --json`` printed.

    Raises:
        ValueError: The file has no such result.
    """
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8"), object_pairs_hook=distinct)
        found["rows"] = [{"copies": 1, "threads": 1, **row} for row in found["rows"]]
        known = {*_SAME, "label", "status", "ms", "spread", "launches", "bytes", "start_s", "memory"}
        if all(known <= set(row) for row in found["rows"]) and {"device", "processor"} <= set(found["machine"]):
            return found
    except (ValueError, TypeError, KeyError, RecursionError):
        pass
    raise ValueError(f"{path}: is no result of benchmarks; it must be what warpcloth bench --json prints")


def write_csv(path, rows):
    """Writes a line for each row.

    Raises:
        FileNotFoundError: The folder does not exist.
    """
    write_table(path, COLUMNS, (map(cells_of(row).get, COLUMNS) for row in rows))


def cells_of(row):
    """Returns a row as cells of a table: its dictionaries as JSON, and its spread of times as two columns, None if unknown."""
    low, high = row.get("spread") or (None, None)
    texts = {name: json.dumps(value) for name, value in row.items() if isinstance(value, dict)}
    return row | texts | {"ms_low": low, "ms_high": high}
