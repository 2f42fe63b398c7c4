"""Diagrams of accuracy against time: measurements, the Pareto front, and tables.

Each diagram is a function of a :class:`warpcloth.lab.measurements.SceneRef` that returns a dictionary of JSON values, with a
dictionary for each setting in ``rows``. ``run`` has arguments of :func:`sweep`; ``limit`` [s] is that of each setting.
"""

import math
import re

from ..base.digest import scene_digest
from ..base.outputs import write_table
from ..others.simulators import SIMULATORS, shown_name
from . import convergence, physics, spectrum, trajectory
from .campaign import collect
from .machine import machine
from .measurements import task
from .own_reference import SHARE, of_own, own_facts, own_references
from .reference import reference
from .results import cells_of
from .setups import label, precisions, setups_of_runs, setups_of_steps

# Divisors of a scene's frames: the frames before the step of "solver" and "spectrum", and the frames of "time". Later motion is
# chaotic, so that its error says little about a method.
_BEFORE, _RUN = 3, 2
SUBSTEPS = 4  # steps a frame of the one step
WITHIN = 0.01  # error at which the cheapest setting of each solver is named
# Tolerance of the reference solution, relative to the size of the cloth; its time limit in time limits of a setting; and its
# minimum time limit [s].
_KNOWN, _TIMES, _SECONDS = 1e-4, 6.0, 120.0
# Columns of a CSV for a setting; unknown values are empty.
COLUMNS = (
    "solver",
    "label",
    "options",
    "status",
    "reason",
    "front",
    "error",
    "strain_error",
    "own_error",
    "ms",
    "ms_low",
    "ms_high",
)
COLUMNS += ("h", "stiffness", "ms_per_second", "iterations", "gap", "predicted", "floor", "compile_s", "factorise_s")
COLUMNS += ("residual", "grade", "distance", "frames", "message", "machine")
# Columns that are equal for all settings.
FACTS = (
    "scene",
    "dtype",
    "seed",
    "processor",
    "cores",
    "device",
    "system",
    "python",
    "numpy",
    "scipy",
    "warp",
    *SIMULATORS,
    "warpcloth",
)
FACTS += ("source",)


def solver_diagram(scene, solvers=None, frames=None, device="cpu", dtype="float64", limit=20.0, **run):
    """Measures one implicit Euler step from the same x̃ with every method that minimises it.

    The step comes after ``frames`` frames, by default a third of the scene's.

    Raises:
        ValueError: A name is not that of a solver that minimises.
    """
    setups = setups_of_steps(solvers)
    declared = scene.load()
    frame = frames or max(declared.frames // _BEFORE, 1)
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


def time_diagram(scene, solvers=None, frames=None, device="cpu", dtype=None, limit=20.0, watch=None, others=(), **run):
    """Measures the error of trajectories and their time, over steps and iterations.

    The rows of solvers of other simulators also have ``own_error``, that relative to the motion to which the solver itself
    converges, if it does. ``frames`` is by default half of the scene's. The reference solution has float64, and a time limit of
    six times ``limit``, but at least 120 s; ``watch`` is called with its progress. ``others`` are simulators, such as
    ``["newton"]``.

    Returns:
        dict: As of the module; ``reference`` describes the reference solution. ``others`` has for each solver of another
        simulator the :func:`warpcloth.lab.own_reference.own_facts` of its own motion, which counts as converged if it is known
        to a tenth of :data:`WITHIN`; or None if it has none.

    Raises:
        ImportError: A simulator is not installed.
        ValueError: There is no solver of a name, or the scene has no reference solution.
    """
    setups = setups_of_runs(scene, solvers, device, dtype, others)
    frames = frames or max(scene.load().frames // _RUN, 1)
    longest = max(_TIMES * limit, _SECONDS)
    exact = reference(scene, frames=frames, tolerance=_KNOWN, limit=longest, progress=watch, device=device)
    if (exact.points == exact.points[0]).all():
        raise ValueError(f"nothing moves in {scene} within {frames} frames; a chart of errors needs motion")
    given = {"frames": frames, "reference": str(exact.path), "device": str(device), "dtype": dtype, "limit": limit}
    own, bound, mesh = own_references(scene, setups, frames, device, _KNOWN, longest, watch), SHARE * WITHIN, scene.load().mesh
    more = [of_own(own.get(setup.solver), bound) for setup in setups]
    rows = _measured(trajectory.measure, scene, setups, given, run, more)
    for i in front(rows, exact.error):
        rows[i]["front"] = True
    known = {name: getattr(exact, name) for name in ("error", "strain_error", "substeps", "seconds", "key")}
    facts = {"seed": None, "frames": frames, "reference": known}  # nothing is drawn at random
    if own:
        facts["others"] = {name: own_facts(each, exact, mesh, bound) for name, each in own.items()}
    return {**_facts("time", scene, device, precisions(setups, device, dtype)), **facts, "rows": rows}


def spectrum_diagram(scene, frames=None, device="cpu", limit=20.0, **run):
    """Measures errors of plain projective dynamics within a step, for several step sizes, and predicts them by the spectrum.

    The step comes after ``frames`` frames, by default a third of the scene's.

    Raises:
        ValueError: The mesh is too fine.
    """
    declared = scene.load()
    frame = frames or max(declared.frames // _BEFORE, 1)
    given = {"scene": scene, "digest": scene_digest(declared), "frame": frame, "device": str(device), "limit": limit}
    tasks = [task(spectrum.measure, **given, substeps=substeps) for substeps in (1, 2, 4, 8, 16)]
    results = _results(tasks, run)
    if all(each["status"] == "refused" for each in results):
        raise ValueError(results[0]["reason"])
    rows = [
        {
            "solver": "projective-dynamics",
            "options": {},
            "label": f"1/{declared.fps * each.arguments['substeps']:g} s",
            **result,
        }
        for each, result in zip(tasks, results, strict=True)
    ]
    facts = {"seed": convergence.SEED, "frame": frame}
    return {**_facts("spectrum", scene, device, "float64"), **facts, "rows": rows}


# Measurements of the diagram "physics" for each scene: arguments of `physics.measure`, and resolutions.
PHYSICS = {
    "cantilever": (
        [
            {"case": "cantilever", "bending": bending, "pattern": pattern, "angle": angle}
            for pattern in ("equilateral", "diagonal", "alternating", "jittered")
            for angle in (0.0, math.pi / 4)
            for bending in physics.BENDING
        ],
        (8, 12, 16, 24),
    ),
    "chain": ([{"case": "chain"}], (5, 10, 20, 40, 80)),
    "catenary": ([{"case": "catenary"}], (8, 16, 32, 64, 128)),
}


def physics_diagram(scene, device="cpu", dtype="float64", limit=20.0, **run):
    """Measures errors of equilibria relative to closed forms, over mesh size and time, with the ``arguments`` of each.

    The scene is "cantilever", "chain" or "catenary", without parameters, because these are varied.

    Raises:
        ValueError: The scene has no closed form here, or has parameters.
    """
    if scene.name not in PHYSICS or scene.parameters:
        raise ValueError(f"{scene}: the diagram physics is of {', '.join(PHYSICS)}, without parameters, which it varies itself")
    plans, resolutions = PHYSICS[scene.name]
    given = {"device": str(device), "dtype": dtype, "limit": limit}
    plans = [{**plan, "resolution": resolution} for plan in plans for resolution in resolutions]
    tasks = [task(physics.measure, **plan, **given) for plan in plans]
    rows = [
        {"solver": "equilibrium", "options": {}, "label": _label_of(plan), "arguments": plan, **result}
        for plan, result in zip(plans, _results(tasks, run), strict=True)
    ]
    return {**_facts("physics", scene, device, dtype), "seed": physics.SEED, "rows": rows}


def _label_of(plan):
    words = [plan["case"], *(plan[name] for name in ("bending", "pattern") if name in plan)]
    words += [f"{math.degrees(plan['angle']):.0f}°"] if "angle" in plan else []
    return " ".join([*words, str(plan["resolution"])])


def cheapest(rows, floor=0.0):
    """Returns the fastest row of each solver with an error of at most :data:`WITHIN`, the fastest solver first.

    ``floor`` is the error of the reference, by which each error may be wrong.
    """
    found = {}
    for row in sorted(filter(_has_error, rows), key=lambda row: row["ms_per_second"]):
        if row["error"] + floor <= WITHIN:
            found.setdefault(row["solver"], row)
    return list(found.values())


def front(rows, floor=0.0, name="error"):
    """Returns the indices of the rows that no other beats in time and error by more than the spread of times, fastest first.

    A row is left out if another has a smaller error and its time is no longer, within the quartiles of both. Errors below
    ``floor``, that of the reference, are equal; ``name`` is "error" or "strain_error".
    """
    eligible = [i for i, row in enumerate(rows) if row["status"] == "ok" and row[name] is not None]
    levels, spreads = {i: max(rows[i][name], floor) for i in eligible}, {i: quartiles(rows[i]) for i in eligible}
    order = {i: (rows[i]["ms_per_second"], rows[i][name], i) for i in eligible}

    def beats(i, j):
        if levels[i] == levels[j]:
            return order[i] < order[j]
        return levels[i] < levels[j] and spreads[i][0] <= spreads[j][1]

    return sorted((j for j in eligible if not any(beats(i, j) for i in eligible)), key=order.get)


def quartiles(row):
    """Returns the spread of the time for a second of motion, (low, high) [ms]."""
    if not row.get("spread"):
        return row["ms_per_second"], row["ms_per_second"]
    return tuple(each * row["ms_per_second"] / row["ms"] for each in row["spread"])


def without_point(found):
    """Returns (label, status and reason) of rows without a point, one for all rows of a solver that differ in numbers only."""
    groups = {}
    for row in found["rows"]:
        if row["status"] != "ok":
            why = f"{row['status']}: {row['reason']}"
            groups.setdefault((row["solver"], re.sub(r"\d[\d.e+]*", "", why)), []).append((row["label"], why))
    said = []
    for (solver, _), rows in groups.items():
        labels, whys = zip(*rows, strict=True)
        label = labels[0] if len(rows) == 1 else f"{shown_name(solver)}, {len(rows)} settings"
        said.append((label, whys[0] + ("; the others alike" if len(set(whys)) > 1 else "")))
    return said


def write_csv(path, found):
    """Writes a line for each setting, or in the diagram "solver" for each of its points, with the machine.

    Raises:
        FileNotFoundError: The folder does not exist.
    """

    def lines():
        for row in found["rows"]:
            facts = {**found, **found["machine"], **cells_of(row)}
            for point in row.get("points") or [row]:
                yield map({**facts, **cells_of(point)}.get, COLUMNS + FACTS)

    write_table(path, COLUMNS + FACTS, lines())


def _facts(kind, scene, device, dtype):
    return {"diagram": kind, "scene": str(scene), "device": str(device), "dtype": dtype, "machine": machine(device)}


def _has_error(row):
    return row["status"] == "ok" and row["error"] is not None


def _measured(function, scene, setups, given, run, more=None):
    more = more or [{}] * len(setups)
    tasks = [task(function, scene=scene, setup=setup, **given, **each) for setup, each in zip(setups, more, strict=True)]
    return [
        {"solver": setup.solver, "options": setup.options, "label": label(setup), **result}
        for setup, result in zip(setups, _results(tasks, run), strict=True)
    ]


def _results(tasks, run):
    return [{**result, "machine": where} for result, where in collect(tasks, "work-precision", **run)]
