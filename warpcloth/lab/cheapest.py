"""Maps of the cheapest solver and settings that meet a tolerance, over one or two parameters of a scene."""

import itertools
import json
import time
import warnings
from dataclasses import asdict

from ..base.checks import number, whole
from ..base.digest import scene_digest
from ..base.outputs import write_table
from . import trajectory
from .campaign import collect
from .choosing import FINER, Measured, climb, ladders, measured, percent
from .machine import machine
from .measurements import SceneRef, task
from .reference import reference
from .results import cells_of
from .setups import label, precisions, setups_of_runs

# Settings that take more than this many times the cheapest are not searched, so the second best is known up to this ratio.
BEYOND = 4.0
# Shortest time limit of a run after the first of its solver, for frames that are slow while they warm up [s].
_WARM_UP = 2.0
# Time limit of a reference solution, in limits of a cell.
_TIMES = 6.0
# What a CSV says of the cheapest setting, and with "second_" of the second best; unknown values are empty.
_OF_SETTING = ("label", "options", "ms", "ms_low", "ms_high", "error", "strain_error", "grade")
_OF_REFERENCE = ("error", "method", "substeps", "seconds")
COLUMNS = ("x", "x_value", "y", "y_value", "status", "reason", "solver", *_OF_SETTING)
COLUMNS += ("second_solver", *(f"second_{name}" for name in _OF_SETTING), "ratio", "complete", "settings", "seconds")
COLUMNS += tuple(f"reference_{name}" for name in _OF_REFERENCE)
FACTS = ("scene", "frames", "tolerance", "limit", "dtype", "processor", "cores", "device", "system", "python", "numpy", "scipy")
FACTS += ("warp", "warpcloth", "source")

# Solvers and options whose kernels this process has compiled, without substeps.
_compiled = set()


def cheapest_map(scene, x, y=None, tolerance=0.01, solvers=None, frames=None, device="cpu", dtype=None, limit=60.0, **run):
    """Measures which solver and settings are the cheapest that meet a tolerance, for each pair of values of two parameters.

    Args:
        scene: A :class:`SceneRef`.
        x: (name of a parameter of the scene, its values).
        y: Another parameter, or None for a map of one row.
        tolerance: Largest error, relative to the size of the cloth; see :func:`warpcloth.lab.reference.position_error`.
        solvers: Names of solvers, by default all.
        frames: Number of frames, by default those of the scene.
        device: A Warp device, also for the reference solutions.
        dtype: Precision, by default that of a run with each solver; reference solutions have float64.
        limit: Time limit of the search in each cell [s].
        run: ``store``, ``progress``, ``executor``, ``workers`` of :func:`warpcloth.lab.campaign.sweep`.

    Returns:
        dict: The arguments, ``machine``, and ``cells``: a list of the results of :func:`measure`, with ``x`` and ``y``, in rows
        of y.

    Raises:
        ValueError: An argument is not allowed, or the scene has no such parameter or has it already.
    """
    number("tolerance", tolerance, above=0.0)
    number("limit", limit, above=0.0)
    pairs = list(itertools.product([None] if y is None else y[1], x[1]))
    if y is not None and y[0] == x[0]:
        raise ValueError(f"x and y are both {x[0]}; they must be two parameters")
    for of, axis in (("x", x), ("y", y)):
        if axis is not None and axis[0] in scene.parameters:
            raise ValueError(f"{axis[0]} is given as a parameter of the scene and as {of}; give it once")
    tasks, setups = [], []
    for below, across in pairs:
        at = SceneRef(scene.name, {**scene.parameters, x[0]: across, **({} if y is None else {y[0]: below})}, scene.pins)
        declared = at.load()
        given = {"scene": at, "digest": scene_digest(declared), "frames": declared.frames if frames is None else frames}
        whole("frames", given["frames"], 1)
        given |= {"tolerance": tolerance, "solvers": solvers, "device": str(device), "dtype": dtype, "limit": limit}
        setups += setups_of_runs(at, solvers, device, dtype)  # checks names
        tasks.append(task(measure, **given))
    # One at a time, because parallel runs would slow one another.
    found = collect(tasks, "cheapest", **{"workers": 1, **run})
    cells = [
        {"x": across, "y": below, **cell, "machine": where} for (below, across), (cell, where) in zip(pairs, found, strict=True)
    ]
    facts = {"scene": str(scene), "device": str(device), "dtype": precisions(setups, device, dtype), "machine": machine(device)}
    return {**facts, "x": x, "y": y, "tolerance": tolerance, "frames": frames, "limit": limit, "cells": cells}


def measure(scene, digest, frames, tolerance, solvers, device, dtype, limit):
    """Finds the cheapest setting of any solver that meets a tolerance. Arguments and results are JSON values.

    The settings of each solver are climbed by :func:`warpcloth.lab.choosing.climb`, one solver after another in the order
    given. The search goes on up to :data:`BEYOND` times the cheapest setting, so that the second best is known too. Each run
    ends once it takes longer. ``digest`` is in the key of the measurement. ``limit`` [s] bounds all runs and what they bind,
    without the kernels that each solver compiles first and the reference solution, which may take six times as long.

    Returns:
        dict: Unknown values are None.

        - ``status``: "found", "none" if no setting was accurate within the limit, or "unknown" if the reference solution is
          not accurate enough to tell; ``reason``: a sentence, "" if found.
        - ``solver``, ``options``, ``label``, ``ms``, ``spread``, ``error``, ``strain_error``, ``grade``: the cheapest setting,
          the time of a frame and its spread [ms], its errors, and the grade of its run.
        - ``second``: The cheapest setting of another solver, with its ``ratio`` of times, or None.
        - ``complete``: Whether the search ended before the limit.
        - ``reference_error``, ``reference_method``, ``reference_substeps``, ``reference_seconds``: The reference solution.
        - ``seconds``: Time of the search; ``measured``: what was measured, a list.
    """
    at = SceneRef(**scene)
    names = ("solver", "options", "label", "ms", "spread", "error", "strain_error", "grade", "second", "complete", "seconds")
    cell = {"status": "unknown", "reason": ""} | dict.fromkeys((*names, *(f"reference_{name}" for name in _OF_REFERENCE)))
    cell["measured"] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the error of the reference is in the cell
        try:
            exact = reference(at, frames, tolerance / FINER, _TIMES * limit, device=device)
        except ValueError as error:
            return cell | {"reason": str(error)}
    cell |= {f"reference_{name}": getattr(exact, name) for name in _OF_REFERENCE}
    if exact.error >= tolerance:
        return cell | {"reason": f"the reference is known to {percent(exact.error)} only"}
    search, found = _Search(at, frames, exact, tolerance, device, dtype, limit), []
    for ladder in ladders(setups_of_runs(at, solvers, device, dtype)):
        found += climb([ladder], search, tolerance, search.most, exact.error)[1]
    cell |= {"complete": search.left > 0.0, "seconds": limit - search.left}
    cell["measured"] = [{**asdict(each), "label": label(each.setup)} for each in found]
    best = cheapest_of_each(found, tolerance, exact.error)
    if not best:
        return cell | {"status": "none", "reason": _why(found, tolerance, exact.error, limit, cell["complete"])}
    first, *others = (_facts(each) for each in best)
    second = {**others[0], "ratio": others[0]["ms"] / first["ms"]} if others else None
    return cell | first | {"status": "found", "second": second}


class _Search:
    """Measures setups one after another until the time of a cell is over.

    It has ``left`` [s], and runs up to ``most``, :data:`BEYOND` times the cheapest frame that is accurate [ms], or None.
    """

    def __init__(self, scene, frames, exact, tolerance, device, dtype, limit):
        self.given = {"scene": asdict(scene), "frames": frames, "reference": str(exact.path), "device": device, "dtype": dtype}
        self.frames, self.floor, self.tolerance, self.left, self.most = frames, exact.error, tolerance, limit, None

    def __call__(self, setups):
        return [self._measured(setup) for setup in setups]

    def _measured(self, setup):
        if self.left <= 0.0:
            return Measured(setup, None, None, reason="not tried, for the time of the cell was over", final=True)
        others = {name: value for name, value in setup.options.items() if name not in ("substeps", "error")}
        key = json.dumps([setup.solver, others, self.given["device"], self.given["dtype"]], sort_keys=True)
        limit = self.left
        if self.most is not None and key in _compiled:
            limit = min(limit, max(_WARM_UP, 1e-3 * self.most * self.frames))
        began = time.perf_counter()
        found = trajectory.measure(setup=asdict(setup), limit=limit, **self.given)
        self.left -= time.perf_counter() - began - (0.0 if key in _compiled else found["compile_s"] or 0.0)
        _compiled.add(key)
        if found["error"] is not None and found["error"] + self.floor <= self.tolerance:
            self.most = min(BEYOND * found["ms"], self.most or float("inf"))
        return measured(setup, found, "")


def cheapest_of_each(found, tolerance, floor):
    """Returns the cheapest :class:`warpcloth.lab.choosing.Measured` of each solver that meets a tolerance, cheapest first."""
    best = {}
    for each in sorted((each for each in found if each.error is not None), key=lambda each: each.milliseconds):
        if each.error + floor <= tolerance:
            best.setdefault(each.setup.solver, each)
    return list(best.values())


def _facts(each):
    facts = {"solver": each.setup.solver, "options": each.setup.options, "label": label(each.setup), "dtype": each.dtype}
    facts |= {"ms": each.milliseconds, "spread": each.spread, "error": each.error, "strain_error": each.strain_error}
    return facts | {"grade": each.grade}


def _why(found, tolerance, floor, limit, complete):
    known = [each for each in found if each.error is not None]
    within = "" if complete else f" within {limit:g} s"
    if not known:
        return f"no setting ended well{within}"
    near = min(known, key=lambda each: each.error)
    only = f", and the reference is known to {percent(floor)} only" if near.error <= tolerance else ""
    return f"no setting meets {percent(tolerance)}{within}; {label(near.setup)} comes to {percent(near.error)}{only}"


def write_csv(path, found):
    """Writes a line for each cell of :func:`cheapest_map`, with the machine.

    Raises:
        FileNotFoundError: The folder does not exist.
    """

    def lines():
        for cell in found["cells"]:
            second = cell["second"] or {}
            line = {**found, **found["machine"], **cells_of(cell)}
            line |= {f"second_{name}": value for name, value in cells_of(second).items()}
            line |= {
                "x_value": cell["x"],
                "y_value": cell["y"],
                "ratio": second.get("ratio"),
                "settings": len(cell["measured"]),
            }
            line |= {of: found[of] and found[of][0] for of in "xy"}
            yield map(line.get, COLUMNS + FACTS)

    write_table(path, COLUMNS + FACTS, lines())
