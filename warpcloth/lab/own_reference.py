"""The motion to which a solver of another simulator converges, by its own steps."""

import hashlib
import json
import time
from dataclasses import replace

import numpy as np

from ..base.digest import scene_digest, source_digest
from ..base.version import installed_version
from ..others.runs import run_other
from ..others.simulators import simulator_of
from .campaign import cache_folder
from .clock import Clock, TooSlow
from .reference import Reference, kept_reference, position_error, strain_error

_MOST = 12  # runs, each with twice the substeps of the one before


def own_reference(scene, setups, frames, device="cpu", tolerance=1e-3, limit=120.0, progress=None):
    """Returns the :class:`warpcloth.lab.reference.Reference` of a solver of another simulator, from its file, or computed.

    It runs the scene with the fewest substeps and the most iterations of its settings, with twice the substeps, and so on. It
    ends when a doubling moves the cloth by at most the tolerance. It also ends when the last two doublings both move it further
    than an earlier one did; then float32 rounds the motion, or the solver does not converge. The two successive runs that are
    nearest to each other count. Their distance is the error, which bounds that of the finer one if each doubling at least
    halves the error.

    Args:
        scene: The :class:`warpcloth.lab.measurements.SceneRef`.
        setups: The :class:`warpcloth.lab.measurements.Setup`\\s of the solver.
        frames: Number of frames.
        device: A Warp device.
        tolerance: Relative to the size of the cloth.
        limit: Time limit [s] of all runs.
        progress: Function called with (substeps, frame, frames) after each frame, or None.

    Returns:
        The reference, or None if the solver does not take the scene, diverges, or takes too long for three runs, or if no
        doubling moves the cloth by less than the first.
    """
    records = [setup.record() for setup in setups]
    iterations = max(record.iterations for record in records)
    declared = scene.load()
    digest = scene_digest(declared)
    version = installed_version(simulator_of(setups[0].solver).package)
    facts = [digest, int(frames), source_digest(), setups[0].solver, str(device), version, limit, tolerance]
    key = hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:24]
    path = cache_folder() / "references" / f"{key}.npz"
    found = kept_reference(path, key)
    if found is not None:
        return found
    runs, moves, began, substeps = [], [], time.perf_counter(), min(each.substeps for each in records)
    while len(runs) < _MOST:
        before = time.perf_counter()
        clock = Clock(limit - (before - began), progress and (lambda *at, s=substeps: progress(s, *at)))
        try:
            run = run_other(declared, replace(records[0], substeps=substeps, iterations=iterations), device, frames, clock)
        except (TooSlow, ValueError):
            break
        if run.status.ok:
            runs.append((substeps, run.points.astype(np.float64)))
        elif runs:
            break
        if len(runs) > 1:
            moves.append(position_error(runs[-1][1][1:], runs[-2][1][1:], declared.mesh))
            if moves[-1] <= tolerance or (len(moves) > 2 and min(moves[-2:]) > min(moves)):
                break
        now = time.perf_counter()
        if now - began + 2.0 * (now - before) > limit:
            break
        substeps *= 2
    best = int(np.argmin(moves)) if moves else 0
    if not moves or (best == 0 and moves[0] > tolerance):
        return None
    (_, coarse), (substeps, fine) = runs[best : best + 2]
    found = Reference(
        points=fine,
        times=np.arange(frames + 1) / declared.fps,
        error=moves[best],
        strain_error=strain_error(fine[1:], coarse[1:], declared.mesh),
        substeps=substeps,
        seconds=time.perf_counter() - began,
        path=str(path),
        key=key,
        scene=digest,
        method=setups[0].solver,
        limit=limit,
    )
    found.save()
    return found
