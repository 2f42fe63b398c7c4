"""Speed against accuracy: what all settings are measured by, which of them nothing beats, and the results as tables.

Each diagram is a function of a :class:`warpcloth.chart.tasks.SceneRef` that returns a dictionary of JSON values, with a
dictionary for each setting in ``rows``; :mod:`warpcloth.chart.fronts` draws it.
"""

import csv
import json

from ..outputs import TEXT, Output
from . import convergence, reference, trajectory
from .digest import scene_digest
from .machine import machine
from .setups import label, setups_of_runs, setups_of_steps
from .sweep import Store, cache_folder, sweep
from .tasks import task

# Frames before the one step of the diagram "solver", as part of those of the scene, and its steps a frame.
_PART, SUBSTEPS = 3, 4
# What a CSV has of a setting, in this order; what it does not know is empty.
COLUMNS = ("solver", "label", "options", "status", "reason", "front", "error", "strain_error", "ms", "ms_low", "ms_high")
COLUMNS += ("ms_per_second", "iterations", "gap", "compile_s", "factorise_s", "residual", "frames", "message")


def solver_diagram(scene, solvers=None, frames=None, device="cpu", dtype="float64", limit=20.0, **run):
    """One step of implicit Euler from the same x̃ by every method that minimises it, see :func:`convergence.measure`.

    Args:
        scene: A :class:`SceneRef`.
        solvers: Names as on the command line; None is all that minimise.
        frames: Frames before the step; a third of the scene's where not given.
        device: A Warp device.
        dtype: Of the methods.
        limit: Seconds a setting.
        run: ``store``, ``progress``, ``executor``, ``workers`` of :func:`sweep`.

    Returns:
        dict: See the module.

    Raises:
        ValueError: A name is none of a method that minimises.
    """
    setups = setups_of_steps(solvers)
    declared = scene.load()
    frame = max(declared.frames // _PART, 1) if frames is None else frames
    given = {
        "digest": scene_digest(declared),
        "frame": frame,
        "substeps": SUBSTEPS,
        "device": str(device),
        "dtype": dtype,
        "limit": limit,
    }
    rows = _measured(convergence.measure, scene, setups, given, run)
    facts = {"seed": convergence.SEED, "frame": frame, "rate": declared.fps * SUBSTEPS}
    return {**_facts("solver", scene, device, dtype), **facts, "rows": rows}


def time_diagram(scene, solvers=None, frames=None, device="cpu", dtype="float32", limit=20.0, tolerance=1e-3, **run):
    """The error of a trajectory against the time it takes, over steps and iterations, see :func:`trajectory.measure`.

    Args:
        scene: A :class:`SceneRef`.
        solvers: Names as on the command line; None is all.
        frames: Frames that are run, those of the scene where not given.
        device: A Warp device.
        dtype: Of the runs; the reference solution has float64.
        limit: Seconds a setting.
        tolerance: Error of the reference solution, relative to the size of the cloth.
        run: ``store``, ``progress``, ``executor``, ``workers`` of :func:`sweep`.

    Returns:
        dict: See the module; with ``reference`` what the errors are measured against.

    Raises:
        ValueError: A name is no solver's, or the scene has no reference solution.
    """
    setups = setups_of_runs(scene, solvers, device, dtype)
    exact = reference.reference(scene, frames=frames, tolerance=tolerance)
    given = {"frames": frames, "reference": str(exact.path), "device": str(device), "dtype": dtype, "limit": limit}
    rows = _measured(trajectory.measure, scene, setups, given, run)
    for place in front(rows):
        rows[place]["front"] = True
    known = {name: getattr(exact, name) for name in ("error", "strain_error", "substeps", "seconds", "key")}
    facts = {"seed": None, "frames": len(exact.points) - 1, "reference": known}  # nothing is drawn at random
    return {**_facts("time", scene, device, dtype), **facts, "rows": rows}


DIAGRAMS = {"solver": solver_diagram, "time": time_diagram}


def front(rows):
    """Places of the rows that no other beats in both time and error, the fastest first."""
    places = [i for i, row in enumerate(rows) if row["status"] == "ok" and row["error"] is not None]
    found, least = [], float("inf")
    for i in sorted(places, key=lambda i: (rows[i]["ms_per_second"], rows[i]["error"])):
        if rows[i]["error"] < least:
            found.append(i)
            least = rows[i]["error"]
    return found


def left_out(found):
    """(label, status and reason) of the rows of a diagram that have no point in the picture."""
    return [(row["label"], f"{row['status']}: {row['reason']}") for row in found["rows"] if row["status"] != "ok"]


def write_csv(path, found):
    """Writes a line for each setting, in the diagram "solver" for each of its points.

    Raises:
        FileNotFoundError: The folder does not exist.
    """
    with Output(path, "x", **TEXT) as output:
        table = csv.DictWriter(output.file, COLUMNS, lineterminator="\n", extrasaction="ignore")
        table.writeheader()
        for row in found["rows"]:
            facts = {**row, "options": json.dumps(row["options"])}
            for point in row.get("points") or [row]:
                low, high = point.get("spread") or (None, None)
                table.writerow({**facts, **point, "options": facts["options"], "ms_low": low, "ms_high": high})


def _facts(kind, scene, device, dtype):
    return {
        "diagram": kind,
        "scene": str(scene),
        "device": str(device),
        "dtype": dtype,
        "machine": machine(device),
    }


def _measured(function, scene, setups, given, run):
    """A row for each setup, in their order."""
    run = {"store": Store(cache_folder() / "work-precision.jsonl"), **run}
    tasks = [task(function, scene=scene, setup=setup, **given) for setup in setups]
    results = {each.key: result for each, result in sweep(tasks, **run)}
    return [
        {"solver": setup.solver, "options": setup.options, "label": label(setup), **results[each.key]}
        for setup, each in zip(setups, tasks, strict=True)
    ]
