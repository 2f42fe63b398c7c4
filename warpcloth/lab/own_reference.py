"""The motion to which a solver of another simulator converges, by its own steps."""

import hashlib
import json
import math
import time
from dataclasses import replace

import numpy as np

from ..base.digest import scene_digest, source_digest
from ..base.version import installed_version
from ..others.runs import run_other
from ..others.simulators import other_solvers, simulator_of
from .campaign import cache_folder
from .clock import Clock, TooSlow
from .reference import Reference, kept_reference, position_error, strain_error

_MAX_RUNS = 12  # runs, each with twice the substeps of the one before
# A motion counts as converged if two successive doublings moved it by at most this share of the tolerance.
SHARE = 0.1
# Stands for a reference that is not known because the total time was used up.
CUT = "cut"


class UsedUp(Exception):
    """Raised when the total time is used up."""


def own_reference(
    scene, setups, frames, device="cpu", tolerance=1e-3, limit=120.0, progress=None, clock="wall", until=math.inf
):
    """Returns the :class:`warpcloth.lab.reference.Reference` of a solver of another simulator, from its file, or computed.

    It runs the scene with the fewest substeps and the most iterations of ``setups``, with twice the substeps, and so on. It
    ends when two successive doublings both move the cloth by at most the ``tolerance``, relative to the size of the cloth; or
    further than an earlier one did, because float32 rounds the motion or the solver does not converge.

    Two successive doublings count if the second moves the cloth no further than the first, or both move it by at most the
    tolerance. Of those, the two with the smallest moves are taken, and the middle run is repeated with twice the iterations.
    The largest of the three moves is the error, which bounds that of the finest run if each doubling at least halves the error.

    ``limit`` [s] bounds the frames of all runs that double the substeps; the run with twice the iterations may take as long
    again. ``progress`` is called with (substeps, frame, frames).

    Returns:
        The reference, or None if the solver does not take the scene, diverges, or takes too long for two runs. Its error is
        infinite if no two doublings count, or if there was no time for the run with more iterations.

    Raises:
        UsedUp: The time ``until`` of ``time.perf_counter`` [s] has come before the end.
    """
    records = [setup.record() for setup in setups]
    iterations = max(record.iterations for record in records)
    declared, name = scene.load(), setups[0].solver
    digest = scene_digest(declared)
    version = installed_version(simulator_of(name).package)
    facts = [digest, int(frames), source_digest(), name, str(device), version, limit, tolerance, iterations]
    key = hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:24]
    path = cache_folder() / "references" / f"{key}.npz"
    found = kept_reference(path, key)
    if found is not None:
        return found

    def run(substeps, iterations, left):
        """Returns the time of the frames of a run [s], and its points; None if it is refused or too slow, or "diverged"."""

        def note(*at):
            if time.perf_counter() >= until:
                raise UsedUp
            if progress is not None:
                progress(substeps, *at)

        watch = Clock(left, note, clock)
        record = replace(records[0], substeps=substeps, iterations=iterations)
        try:
            ran = run_other(declared, record, device, frames, watch)
        except (TooSlow, ValueError):
            return sum(watch.frames), None
        return sum(watch.frames), ran.points.astype(np.float64) if ran.status.complete else "diverged"

    runs, moves, spent, substeps = [], [], 0.0, min(each.substeps for each in records)
    started = time.perf_counter()
    for _ in range(_MAX_RUNS):
        took, points = run(substeps, iterations, limit - spent)
        spent += took
        if points is None or (runs and isinstance(points, str)):
            break
        if not isinstance(points, str):
            runs.append((substeps, points))
        if len(runs) > 1:
            moves.append(position_error(runs[-1][1][1:], runs[-2][1][1:], declared.mesh))
            if max(moves[-2:]) <= tolerance and len(moves) > 1:
                break
            if len(moves) > 2 and min(moves[-2:]) > min(moves):
                break
        if spent + 2.0 * took > limit:
            break
        substeps *= 2
    if not moves:
        return None
    best, error = _settled(moves, tolerance)
    (coarser, coarse), (substeps, fine) = runs[best : best + 2]
    if other_solvers()[name].iterates and np.isfinite(error):
        _took, more = run(coarser, 2 * iterations, limit)
        known = isinstance(more, np.ndarray)
        error = max(error, position_error(more[1:], coarse[1:], declared.mesh)) if known else np.inf
    found = Reference(
        points=fine,
        times=np.arange(frames + 1) / declared.fps,
        error=float(error),
        strain_error=strain_error(fine[1:], coarse[1:], declared.mesh),
        substeps=substeps,
        seconds=time.perf_counter() - started,
        path=str(path),
        key=key,
        scene=digest,
        method=name,
        limit=limit,
    )
    found.save()
    return found


def _settled(moves, tolerance):
    """Returns (index, error) of the second of the two successive doublings that move the cloth least and count.

    If no two count, the index is that of the smallest move, and the error is infinite.
    """
    pairs = {k: (moves[k - 1], moves[k]) for k in range(1, len(moves))}
    errors = {k: max(pair) for k, pair in pairs.items() if pair[1] <= pair[0] or max(pair) <= tolerance}
    best = min(errors, key=errors.get, default=int(np.argmin(moves)))
    return best, errors.get(best, np.inf)


def own_references(scene, setups, frames, device, tolerance, limit, progress=None, clock="wall", until=math.inf):
    """Returns the :func:`own_reference` of each solver of another simulator among setups, by its name.

    Solvers whose reference is not known at the time ``until`` have ``CUT``.
    """
    of_each, found = {}, {}
    for setup in setups:
        if simulator_of(setup.solver):
            of_each.setdefault(setup.solver, []).append(setup)
    for name, same in of_each.items():
        try:
            found[name] = own_reference(scene, same, frames, device, tolerance, limit, progress, clock, until)
        except UsedUp:
            found[name] = CUT
    return found


def own_facts(own, exact, mesh, bound):
    """Returns what is known of the motion to which a solver converges, as JSON values, or None if there is none.

    ``own`` is the :func:`own_reference`, None or ``CUT``, and ``bound`` the largest error of a motion that counts as converged.

    Returns:
        dict: ``substeps``, ``error``, ``converged``, ``bound``, ``seconds``, and ``apart``, the distance from the reference; or
        only ``cut``, which is true.
    """
    if own is None:
        return None
    if own == CUT:
        return {"cut": True}
    frames = len(own.points) - 1
    apart = position_error(own.points[1:], exact.points[1 : frames + 1], mesh)
    error = own.error if np.isfinite(own.error) else None
    facts = {"substeps": own.substeps, "error": error, "converged": own.error <= bound, "bound": bound}
    return facts | {"apart": apart, "seconds": own.seconds}


def of_own(own, bound):
    """Returns the argument of :func:`warpcloth.lab.trajectory.measure` for an :func:`own_reference`, if it has converged."""
    return {"own": str(own.path)} if isinstance(own, Reference) and own.error <= bound else {}


def words_of_own(facts):
    """Returns in words whether the motion of :func:`own_facts` has converged, and how far it is from the reference."""
    if facts is None:
        return "not known: fewer than two runs completed in the time limit"
    if facts.get("cut"):
        return "not known: the total time was used up"
    said = "converged" if facts["converged"] else "not converged"
    moved = "no doubling moved it less than the one before, or twice the iterations took too long"
    if facts["error"] is not None:
        moved = f"two doublings up to {facts['substeps']} steps a frame moved it by {100.0 * facts['error']:.2g} % at most"
    return f"{said}: {moved} (bound {100.0 * facts['bound']:.2g} %); {100.0 * facts['apart']:.2g} % from the reference"
