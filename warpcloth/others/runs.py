"""Runs of scenes by other simulators, as animations."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import warp as wp

from ..base.checks import whole
from ..base.turns import in_turn
from ..core.status import Grade, Result, Status
from ..run.simulate import Animation

# Strain of an edge at which a run counts as diverged.
_TORN = 10.0


class Simulator(NamedTuple):
    """A simulator, for charts.

    Attributes:
        title: Its name.
        package: The package of its version.
        check: Function that raises ImportError if it is not installed.
        dtype: The precision that it has.
        solvers: :class:`OtherSolver`\\s by their names in charts.
    """

    title: str
    package: str
    check: Callable
    dtype: str
    solvers: dict


class OtherSolver(NamedTuple):
    """A solver of another simulator, for charts.

    Attributes:
        title: Its name, after that of the simulator.
        record: Function (options) → record: a frozen dataclass with ``substeps`` and ``iterations``, of which more are more
            accurate, ``version`` in words, and ``bind(scene, device)``. That refuses scenes by ValueError, and returns an
            object with ``frame()``, ``points()`` and ``velocities()`` (n, 3), for the scope of the device.
        runs: Settings that trade speed for accuracy, as in :class:`warpcloth.solvers.facts.Facts`; ``fewest`` is a multiple of
            the minimum of substeps of ``Explicit``.
        iterates: Whether it has iterations.
    """

    title: str
    record: Callable
    runs: tuple
    iterates: bool = True


@in_turn
def run_other(scene, record, device="cpu", frames=None, progress=None):
    """Runs a scene with the record of an :class:`OtherSolver`; it compiles before frame 0.

    ``frames`` is by default that of the scene, ``progress`` a function called with (frame, frames) from frame 0, or None.

    Returns:
        :class:`warpcloth.Animation` from the simulator's start. It has diverged, and ends before that frame, if a coordinate is
        not finite or an edge is longer than 11 times its rest length.

    Raises:
        ImportError: The simulator is not installed.
        ValueError: An argument is not allowed, or the solver refuses the scene.
    """
    frames = scene.frames if frames is None else frames
    whole("frames", frames, 1)
    began = time.perf_counter()
    with wp.ScopedDevice(device):
        try:
            run = record.bind(scene, device)
        except RuntimeError as error:  # such as a call that cannot be part of a graph
            raise ValueError(f"{record.version} does not run {scene.name}: {error}") from error
        timings = {"compile": time.perf_counter() - began, "factorise": 0.0, "frames": []}
        points, velocities = [run.points()], [run.velocities()]
        worst, status = 0.0, Status(Result.COMPLETED, frames, message=f"completed by {record.version}")
        if progress is not None:
            progress(0, frames)
        for frame in range(1, frames + 1):
            start = time.perf_counter()
            run.frame()
            x = run.points()
            timings["frames"].append(time.perf_counter() - start)
            strain = worst_strain(scene.mesh, x)
            if not strain < _TORN:
                why = "a coordinate is not finite" if not np.isfinite(x).all() else f"an edge has the strain {strain:.3g}"
                message = f"diverged in frame {frame}: {why}"
                status = Status(Result.DIVERGED, frame - 1, message=message, grade=Grade.NOT_USABLE)
                break
            worst = max(worst, strain)
            points.append(x)
            velocities.append(run.velocities())
            if progress is not None:
                progress(frame, frames)
    times = np.arange(len(points)) / scene.fps
    return Animation(np.array(points), np.array(velocities), times, status, timings, worst, scene=scene)


def worst_strain(mesh, points):
    """Returns the largest |l/L − 1| of edges at points (n, 3), or NaN or infinity."""
    edges, lengths = mesh.edges[mesh.edge_lengths > 0.0], mesh.edge_lengths[mesh.edge_lengths > 0.0]
    with np.errstate(over="ignore", invalid="ignore"):
        now = np.linalg.norm((points[edges[:, 1]] - points[edges[:, 0]]).astype(np.float64), axis=1)
        return float(np.max(np.abs(now / lengths - 1.0), initial=0.0 * points.sum()))
