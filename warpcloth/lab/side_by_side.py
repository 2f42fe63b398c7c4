"""Solvers of warpcloth and of other simulators on one scene: each one's cheapest setting within a tolerance, and the ratios."""

import numpy as np
import warp as wp

from ..analysis.intersections import intersections
from ..core.capture import Mirror
from ..mesh.ordering import order_of_run
from ..others.simulators import simulator_of
from .choosing import choose, percent
from .clock import CLOCKS, mean_time, time_spread
from .machine import machine
from .measurements import Setup
from .setups import label
from .work_precision import WITHIN, front

_FEWEST = 3  # frames whose times are averaged
_DTYPE = "float32"  # which most other simulators have


def side_by_side(scene, others, tolerance=WITHIN, frames=None, device="cpu", **given):
    """Searches the cheapest setting of each solver on one scene, and times these settings alternately.

    Args:
        scene: The :class:`warpcloth.lab.measurements.SceneRef`.
        others: Names of simulators.
        tolerance: Largest error of the settings whose times are compared, relative to the size of the cloth.
        frames: Number of frames, by default those of the scene.
        device: A Warp device; on the CPU times are those of the process, which others do not prolong.
        given: ``solvers``, ``limit``, ``total`` and ``run`` of :func:`warpcloth.lab.choosing.choose`.

    Returns:
        dict: That of :func:`warpcloth.lab.work_precision.time_diagram` with ``searched``, for each solver of another simulator,
        how its search ended, and ``ratios``. These have a dictionary for the cheapest setting of warpcloth that meets the
        tolerance, or else of another solver, and then for that of each other solver; they are empty if none does:

        - ``label``, ``solver``, ``options``: The setting.
        - ``error``, ``own_error``: Its errors.
        - ``to``: The one that meets the tolerance, "reference" or "own".
        - ``ms``: Its mean time of a frame [ms].
        - ``ratio``: This time divided by that of the first setting.
        - ``spread``: The ratio times :func:`warpcloth.lab.clock.time_spread` of the ratios of frames.
        - ``crossings``, ``inside``: The largest number in a frame of pairs of triangles that cross, and of vertices inside
          colliders; None if libigl is not installed.

    Raises:
        ImportError: A simulator is not installed.
        ValueError: As for :func:`warpcloth.lab.choosing.choose`.
    """
    clock = "process" if wp.get_device(device).is_cpu else "wall"
    given |= {"device": device, "dtype": _DTYPE, "others": others, "clock": clock}
    choice, measured, exact = choose(scene, tolerance, frames=frames, **given)
    declared = scene.load()
    rows = [_row(each, declared.fps) for each in measured]
    for i in front(rows, exact.error):
        rows[i]["front"] = True
    best = _best(rows, exact.error, tolerance)
    ratios = _alternate(declared, [row for row, _ in best], len(exact.points) - 1, device, CLOCKS[clock])
    for (row, to), found in zip(best, ratios, strict=True):
        found |= {name: row[name] for name in ("label", "solver", "options", "error", "own_error")} | {"to": to}
    known = {name: getattr(exact, name) for name in ("error", "strain_error", "substeps", "seconds", "key", "method")}
    return {
        "diagram": "time",
        "scene": str(scene),
        "device": str(device),
        "dtype": _DTYPE,
        "machine": machine(device),
        "seed": None,
        "frames": len(exact.points) - 1,
        "reference": known,
        "others": {name: own if len(own) > 1 else None for name, own in choice.others.items()},
        "searched": {name: own["searched"] for name, own in choice.others.items()},
        "tolerance": tolerance,
        "clock": clock,
        "ratios": ratios,
        "rows": rows,
    }


def nearest_setting(found):
    """Returns in words which setting of warpcloth is nearest to the tolerance in a result, or "" if one meets it."""
    if any(simulator_of(each["solver"]) is None for each in found["ratios"]):
        return ""
    known = f"the reference is known to {percent(found['reference']['error'])}"
    rows = [row for row in found["rows"] if row["error"] is not None and simulator_of(row["solver"]) is None]
    if not rows:
        return f"no setting of warpcloth has an error; {known}"
    best = min(rows, key=lambda row: row["error"])
    comes = f"nearest is {best['label']} with {percent(best['error'])}"
    return f"no setting of warpcloth meets {percent(found['tolerance'])}; {comes}; {known}"


def _row(each, fps):
    status = each.status if each.error is not None or each.status != "ok" else "diverged"
    names = ("error", "strain_error", "own_error", "reason", "machine", "spread", "grade")
    row = {"solver": each.setup.solver, "options": each.setup.options, "label": label(each.setup), "status": status}
    ms = each.milliseconds
    return row | {name: getattr(each, name) for name in names} | {"ms": ms, "ms_per_second": ms and ms * fps}


def _best(rows, floor, tolerance):
    """Returns (row, error that counts) of the cheapest row of warpcloth, and of each other solver, that meets a tolerance.

    A solver whose cloth is another may meet it for its own motion only.
    """
    known = sorted((row for row in rows if row["status"] == "ok"), key=lambda row: row["ms"])
    best = {}
    for to, name, error in (("reference", "error", floor), ("own", "own_error", 0.0)):
        for row in known:
            other = simulator_of(row["solver"])
            if (other or to == "reference") and row[name] is not None and row[name] + error <= tolerance:
                best.setdefault((row["solver"] if other else "", to), (row, to))
    kept = [key for key in best if key[1] == "reference" or (key[0], "reference") not in best]
    return [best[key] for key in sorted(kept, key=lambda key: key[0] != "")]  # warpcloth first


def _alternate(scene, rows, frames, device, now):
    """Times the frames of settings in turns, one frame of each after the other, and counts crossings."""
    if not rows:
        return []
    with wp.ScopedDevice(device):
        runs = [_bound(scene, Setup(row["solver"], row["options"]), device) for row in rows]
        times, motions = [[] for _ in rows], [[] for _ in rows]
        for _ in range(frames):
            for run, spent, motion in zip(runs, times, motions, strict=True):
                wp.synchronize_device(device)
                began = now()
                points = run()
                spent.append(now() - began)
                motion.append(points.copy())
    times = np.array(times)[:, min(1, frames - _FEWEST) :]
    found = []
    for spent, motion in zip(times, motions, strict=True):
        ratio = mean_time(spent) / mean_time(times[0])
        given = {"ms": 1e3 * mean_time(spent), "ratio": ratio, "spread": [ratio * q for q in time_spread(spent / times[0])]}
        found.append(given | _checked(scene, np.array(motion, dtype=np.float64)))
    return found


def _bound(scene, setup, device):
    """Returns a function that takes a frame and returns its points (n, 3), in the order of the scene."""
    record = setup.record()
    if simulator_of(setup.solver):
        steps = record.bind(scene, device)

        def run():
            steps.frame()
            return steps.points()

        return run
    order = order_of_run(scene, record)
    stepper = record.bind(scene.build(device=device, dtype=_DTYPE, order=order))
    points, back = Mirror(stepper.state.x), slice(None) if order is None else np.argsort(order)

    def run_own():
        stepper.frame()
        return points.read()[back]

    return run_own


def _checked(scene, points):
    if not len(scene.mesh.triangles):
        return {"crossings": 0, "inside": 0}
    try:
        frames = intersections(points, scene.mesh, colliders=list(scene.colliders)).frames
    except ImportError:
        return {"crossings": None, "inside": None}
    return {"crossings": max(len(each.pairs) for each in frames), "inside": max(each.vertices_inside for each in frames)}
