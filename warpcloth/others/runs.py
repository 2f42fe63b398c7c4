"""Runs of scenes by other simulators, as animations of warpcloth, and what a simulator declares."""

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
        title: Its name in tables and charts.
        package: The package whose version is in tables.
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
        title: Its name in tables and charts, after that of the simulator.
        record: Function that returns its record for options by name. A record is a frozen dataclass with ``substeps`` and
            ``iterations``, of which more are more accurate, ``version``, the simulator and its version in words, and
            ``bind(scene, device)``. That raises ValueError if the solver does not take the scene. It returns an object with the
            methods ``frame()``, ``points()`` and ``velocities()``, both (n, 3), which are called in the scope of the device.
        runs: Options of settings that trade speed for accuracy, as in :class:`warpcloth.solvers.facts.Facts`; ``fewest`` is a
            multiple of the fewest stable substeps of ``Explicit``.
        iterates: Whether it has iterations.
    """

    title: str
    record: Callable
    runs: tuple
    iterates: bool = True


@in_turn
def run_other(scene, record, device="cpu", frames=None, progress=None):
    """Runs a scene with a solver of another simulator.

    Compilation comes before frame 0.

    Args:
        scene: The :class:`warpcloth.Scene`.
        record: The record of the solver, see :class:`OtherSolver`.
        device: A Warp device.
        frames: Number of frames after the first; by default that of the scene.
        progress: Function called with (frame, frames) after each frame, from frame 0; or None.

    Returns:
        :class:`warpcloth.Animation`, with the start as the simulator has it. It has diverged, and ends before that frame, if a
        coordinate is not finite or an edge of the mesh is longer than 11 times its rest length.

    Raises:
        ImportError: The simulator is not installed.
        ValueError: An argument is not allowed, or the solver does not take or run the scene.
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
    """Returns the largest |l/L − 1| of the edges of a mesh at points (n, 3), or NaN or infinity if these are not finite."""
    edges, lengths = mesh.edges[mesh.edge_lengths > 0.0], mesh.edge_lengths[mesh.edge_lengths > 0.0]
    with np.errstate(over="ignore", invalid="ignore"):
        now = np.linalg.norm((points[edges[:, 1]] - points[edges[:, 0]]).astype(np.float64), axis=1)
        return float(np.max(np.abs(now / lengths - 1.0), initial=0.0 * points.sum()))
