"""Measures one row of a benchmark: a scene with a solver in its own process, from its start to warm frames."""

import contextlib
import time
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import warp as wp

from ..core.capture import Mirror, Segment
from ..core.status import Result
from ..mesh.ordering import order_of_run
from ..run.watch import Watch, watched_frames
from .counts import compulsory_bytes, elements_of, launches_of
from .measurements import SceneRef, Setup, finite

# Number of warm-up frames, time after which no further frame begins [s], and minimum number of frames.
_WARM_UP, _SECONDS, _FEWEST = 2, 10.0, 3
OF_SELF_CONTACT = ("pairs", "lists", "kept", "least_gap", "list_ns", "find_ns")


def measure(scene, setup, frames, device, dtype, started, copies=1, threads=1):
    """Times warm frames of a scene with a setup, and counts the work of a step. Arguments and results are JSON values.

    ``frames`` is the maximum number of frames to time; after 10 s, three are enough, and 0 ends with the first frame.
    ``started`` is ``time.time()`` when this process was requested.

    Returns:
        dict: Unknown values are None.

        - ``status``: "ok", "diverged" or "refused"; ``reason``: a sentence, "" if ok.
        - ``grade``, ``distance`` [m]: Those of the :class:`warpcloth.core.status.Status`, of copies the worst; from frames
          taken again, so that times and memory are those of steps alone.
        - ``vertices``, ``elements``: Numbers for all copies and terms. ``substeps``: Steps per frame. ``frames``: Timed frames.
        - ``ms``, ``spread``: Median and quartiles of the time of a frame with its points on the host [ms]; ``cloths_per_s``:
          copies over the median [1/s].
        - ``iterations``: Mean number of iterations of a step, over the timed frames; ``launches``: that of launches of a step.
        - ``ns``: Median time of a frame over elements × iterations × substeps [ns].
        - ``bytes``: Minimum memory traffic of a step; ``bytes_per_s``: that over the time of a step.
        - ``start_s``: Time from ``started`` to the end of the first frame [s]. ``bind_s``: Time to build the model and bind the
          solver, including compilation, without ``factorise_s``, that of constant matrices [s].
        - ``triangles``: Number of triangles of all mesh colliders.
        - ``ms_without``, ``contact_ns``: The time of a frame of the same cloth without contact [ms], and the difference over
          vertices, substeps and colliders, counting self-contact as one [ns].
        - ``pairs``, ``lists``, ``kept``, ``least_gap``: Of self-contact, the largest number of pairs in a list, lists per step,
          the fraction of moves that the filter kept, and the smallest gap in any frame [m], of all copies.
        - ``list_ns``, ``find_ns``: Of self-contact, the time per vertex to list pairs, and to find gaps and contacts, in the
          last state [ns].
        - ``memory``: Peak memory of the process on a CPU, and of Warp's memory pool on CUDA [bytes].
    """
    names = (
        "vertices",
        "elements",
        "substeps",
        "ms",
        "spread",
        "cloths_per_s",
        "iterations",
        "ns",
        "bytes",
        "bytes_per_s",
        "launches",
        "triangles",
        "ms_without",
        "contact_ns",
        *OF_SELF_CONTACT,
        "grade",
        "distance",
    )
    found = {"status": "ok", "reason": "", "frames": 0, **dict.fromkeys((*names, "start_s", "bind_s", "factorise_s", "memory"))}
    declared, device = SceneRef(**scene).load(), wp.get_device(device)
    began = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            solver = Setup(**setup).record()
            order = order_of_run(declared, solver)  # as in a run
            model = declared.build(device=device, dtype=dtype, copies=copies, order=order, threads=threads)
            stepper = solver.bind(model)
        except ValueError as error:
            return found | {"status": "refused", "reason": str(error)}
    wp.synchronize_device(device)
    bound = time.perf_counter() - began
    points = Mirror(stepper.state.x)
    _run_frame(stepper, points)
    found |= {
        "vertices": model.count,
        "elements": elements_of(model),
        "substeps": stepper.steps_per_frame,
        "start_s": time.time() - started,
        "bind_s": bound - stepper.factorise_seconds,
        "factorise_s": stepper.factorise_seconds,
        "triangles": sum(len(declared.colliders[c].triangles) for c in declared.meshes),
    }
    if frames:
        found |= _warm(stepper, model, points, frames, found["elements"])
    found["memory"] = _memory(device)
    if stepper.pairs is not None:
        found |= _self_contact(stepper)
    if frames and (declared.colliders or declared.self_contact):
        bare = replace(declared, colliders=(), contact=None, self_contact=None)
        with contextlib.suppress(ValueError):  # the solver may refuse the scene without contact
            without = solver.bind(bare.build(device=device, dtype=dtype, copies=copies, order=order, threads=threads))
            others = Mirror(without.state.x)
            _run_frame(without, others)
            ms = _warm(without, without.model, others, frames, 0)["ms"]
            each = model.count * stepper.steps_per_frame * (len(declared.colliders) + (declared.self_contact is not None))
            found |= {"ms_without": ms, "contact_ns": 1e6 * (found["ms"] - ms) / each}
    if not np.isfinite(stepper.state.x.numpy()).all() or Result.DIVERGED in stepper.results:
        return found | {"status": "diverged", "reason": f"diverged within {found['frames'] + _WARM_UP} frames"}
    return found | (_graded(model, stepper, solver, found["frames"] + _WARM_UP) if frames else {})


def _graded(model, stepper, solver, frames):
    """Takes the frames again from the start, and returns their grade and distance, or that they diverged."""
    stepper.reset()
    watch = Watch(model, stepper)
    for _ in watched_frames(stepper, watch, frames):
        pass
    status = watch.status(solver)
    found = {"grade": status.grade.value, "distance": finite(np.max(status.distance))}
    return found if status.complete else found | {"status": "diverged", "reason": status.message}


def _warm(stepper, model, points, frames, elements):
    for _ in range(_WARM_UP - 1):
        _run_frame(stepper, points)
    times, iterations = [], []
    while len(times) < frames and (len(times) < _FEWEST or sum(times) < _SECONDS):
        began = time.perf_counter()
        iterations.append(_run_frame(stepper, points))
        times.append(time.perf_counter() - began)
    substeps = stepper.steps_per_frame
    low, median, high = (1e3 * np.percentile(times, [25, 50, 75])).tolist()
    mean = float(np.mean(iterations)) / substeps
    moved = round(compulsory_bytes(model, mean))
    per_iteration = 1e9 * np.array(times) / np.maximum(np.array(iterations) * elements, 1)
    return {
        "frames": len(times),
        "ms": median,
        "spread": [low, high],
        "cloths_per_s": 1e3 * model.copies / median,
        "iterations": mean,
        "ns": float(np.median(per_iteration)) if elements else None,
        "bytes": moved,
        "bytes_per_s": moved * substeps / (1e-3 * median),
        "launches": launches_of(lambda: _run_frame(stepper, points)) / substeps,
    }


def _self_contact(stepper):
    pairs = stepper.pairs
    lists, steps = (int(array.numpy().max()) for array in (pairs.lists, pairs.steps))
    gap = float(pairs.least_gap.min())
    values = pairs.most, lists / steps, 1.0 - float(pairs.share.mean()), gap if np.isfinite(gap) else None
    vertices, x = stepper.model.count, stepper.state.x

    def find(x):
        pairs.launch_sides(x)
        pairs.contact.launch_rows(x)

    timed = pairs.proximity.launch, find
    times = [1e9 * _seconds(Segment(x.device, partial(each, x))) / vertices for each in timed]
    return dict(zip(OF_SELF_CONTACT, (*values, *times), strict=True))


def _seconds(segment):
    times = []
    for _ in range(5):
        wp.synchronize_device(segment.device)
        began = time.perf_counter()
        segment()
        wp.synchronize_device(segment.device)
        times.append(time.perf_counter() - began)
    return float(np.median(times))


def _run_frame(stepper, points):
    iterations = 0
    if stepper.uniform:
        stepper.frame()
        iterations = stepper.steps_per_frame * stepper.iterations
    else:
        for _ in range(stepper.steps_per_frame):
            stepper.step()
            iterations += stepper.iterations
    points.read()
    return iterations


def _memory(device):
    """Returns the peak memory [bytes], or None; only Linux gives that of this process without its parent."""
    if device.is_cuda:
        return int(wp.get_mempool_used_mem_high(device)) if device.is_mempool_enabled else None
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM")), None)
