"""Measures the error of a setup relative to the reference solution of a scene, and the cost of a frame."""

import warnings

import numpy as np

from ..base.checks import number, whole
from ..base.digest import scene_digest
from ..others.runs import run_other
from ..others.simulators import simulator_of
from ..run.simulate import simulate
from .clock import Clock, TooSlow, mean_time, time_spread
from .measurements import SceneRef, Setup, finite
from .reference import Reference, position_error, strain_error


def measure(scene, setup, frames=None, reference=None, device="cpu", dtype=None, limit=60.0, repeats=1, own=None, clock="wall"):
    """Runs a scene with a setup. Arguments and results are JSON values.

    ``reference`` is the path of a :class:`warpcloth.lab.reference.Reference` with at least as many frames, and ``own`` that to
    which the solver itself converges. ``frames`` is by default that of the reference, or without one that of the scene.
    ``limit`` [s] bounds the frames of all ``repeats``, without compilation and factorisation; it is checked once per frame.
    ``clock`` is one of :data:`warpcloth.lab.clock.CLOCKS`.

    Returns:
        dict: Unknown values are None.

        - ``status``: "ok", "diverged", "slow" or "refused"; ``reason``: a sentence, "" if ok.
        - ``error``: :func:`warpcloth.lab.reference.position_error` relative to the reference, of the frames after the start;
          ``own_error``: relative to ``own``; ``strain_error``: :func:`warpcloth.lab.reference.strain_error`.
        - ``ms``: Time of a frame [ms], :func:`warpcloth.lab.clock.mean_time` without the first frame of each run, which warms
          up. If there is one frame, a second is run.
        - ``spread``: ``ms`` times the quartiles of :func:`warpcloth.lab.clock.time_spread`, (low, high) [ms].
        - ``ms_per_second``: ``ms`` per second of simulated time.
        - ``compile_s``: Time to build, bind and warm up before the first frame, including compilation, without
          ``factorise_s``, that of constant matrices [s].
        - ``grade``, ``distance`` [m], ``residual``, ``message``: Those of the :class:`warpcloth.core.status.Status`, with
          warnings of the solver. A run that is not usable has an error too, for a reference judges it better.
        - ``frames``: Number of good frames.
        - ``dtype``: The precision of the runs.

    Raises:
        ValueError: An argument is not allowed, or the reference is of another scene or too short.
        FileNotFoundError: There is no such scene or reference.
    """
    number("limit", limit, above=0.0)
    whole("repeats", repeats, 1)
    declared, setup = SceneRef(**scene).load(), Setup(**setup)
    setup.record()  # checks the options
    exact = None if reference is None else Reference.load(reference)
    frames = _checked_frames(frames, declared, exact)
    least = max(frames, 2)  # as the first warms up
    found = dict.fromkeys(("error", "strain_error", "ms", "spread", "ms_per_second", "compile_s", "factorise_s", "residual"))
    found |= {"grade": None, "distance": None}
    found = {"status": "ok", "reason": "", **found, "message": "", "frames": 0, "dtype": setup.precision_on(device, dtype)}
    runs, spent, left = [], [], limit
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", UserWarning)
        for _ in range(repeats):
            watch = Clock(left, clock=clock)
            try:
                runs.append(_run(declared, setup, dtype, device=device, frames=least, progress=watch))
                spent.append(watch.frames if clock == "process" and watch.frames else runs[-1].timings["frames"])
            except TooSlow:
                if not runs:
                    reason = f"{len(watch.frames)} of {least} frames took {sum(watch.frames):.3g} s, more than {limit:g} s"
                    found |= {"status": "slow", "reason": reason, "frames": len(watch.frames)}
                    found |= _times([watch.frames], declared.fps)
            except ValueError as error:
                return found | {"status": "refused", "reason": str(error)}
            left -= sum(watch.frames)
            if left <= 0.0 or not runs[-1].status.complete:
                break
    if not runs:
        return found
    first = runs[0]
    status, timings = first.status, first.timings
    found |= {"frames": min(int(status.frame), frames), "residual": finite(status.residual)}
    found |= {"grade": status.grade.value, "distance": finite(status.distance)}
    found["message"] = "; ".join(dict.fromkeys([status.message, *(str(warning.message) for warning in warned)]))
    found |= _times(spent, declared.fps)
    warm_up = timings["frames"][0] - 1e-3 * found["ms"]
    found |= {"compile_s": timings["compile"] - timings["factorise"] + max(warm_up, 0.0), "factorise_s": timings["factorise"]}
    if not status.complete:
        return found | {"status": "diverged", "reason": status.message}
    if exact is not None:
        points, others = first.points[1 : frames + 1].astype(np.float64), exact.points[1 : frames + 1]
        for name, error in (("error", position_error), ("strain_error", strain_error)):
            found[name] = finite(error(points, others, declared.mesh))
        if own is not None:
            found["own_error"] = finite(position_error(points, Reference.load(own).points[1 : frames + 1], declared.mesh))
    return found


def _run(scene, setup, dtype, **given):
    """Runs a scene with a solver of warpcloth or of another simulator, which must have at least the precision asked for."""
    other = simulator_of(setup.solver)
    if other is None:
        return simulate(scene, setup.record(), dtype=dtype, **given)
    if dtype == "float64" and other.dtype != "float64":
        raise ValueError(f"dtype is {dtype!r}; {other.title} has {other.dtype} only")
    return run_other(scene, setup.record(), **given)


def _checked_frames(frames, scene, exact):
    if exact is None:
        frames = scene.frames if frames is None else frames
        whole("frames", frames, 1)
        return frames
    if exact.scene != scene_digest(scene):
        raise ValueError(f"{exact.path}: is the reference of another scene than {scene.name}, as its data are now")
    known = len(exact.points) - 1
    frames = known if frames is None else frames
    whole("frames", frames, 1)
    if frames > known:
        raise ValueError(f"frames is {frames}; {exact.path} has {known}")
    return frames


def _times(runs, fps):
    """Returns the time of a frame and its spread [ms] from the warm frames of runs, given as lists of seconds."""
    warm = [run[1:] if len(run) > 1 else run for run in runs]
    ms = 1e3 * float(np.average([mean_time(run) for run in warm], weights=[len(run) for run in warm]))
    spread = ms * np.mean([time_spread(run) for run in warm], axis=0)
    return {"ms": ms, "spread": spread.tolist(), "ms_per_second": ms * fps}
