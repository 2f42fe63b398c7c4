"""Runs of scenes by the solvers of Newton, the physics engine, as animations of warpcloth."""

import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import warp as wp

from ..base.checks import choice, whole
from ..base.turns import in_turn
from ..core.status import Result, Status
from ..run.simulate import Animation
from .newton_model import METHODS, engine, newton_model, newton_solver

# Strain of an edge at which a run counts as diverged.
_TORN = 10.0


@dataclass(frozen=True)
class NewtonPhysics:
    """A solver of Newton, the physics engine, with its settings.

    Attributes:
        method: One of :data:`warpcloth.others.newton_model.METHODS`.
        substeps: Steps per frame.
        iterations: Iterations per step; semi-implicit steps have none, and need 1 here.

    Raises:
        ValueError: A value is not allowed.
    """

    method: str
    substeps: int
    iterations: int = 1

    def __post_init__(self):
        choice("method", self.method, METHODS)
        whole("substeps", self.substeps, 1)
        whole("iterations", self.iterations, 1)
        if self.method == "semi-implicit" and self.iterations != 1:
            raise ValueError(f"iterations is {self.iterations}; semi-implicit steps have none, so it must be 1")


class Other(NamedTuple):
    """A solver of another simulator, for charts.

    Attributes:
        method: One of :data:`warpcloth.others.newton_model.METHODS`.
        runs: Options of settings that trade speed for accuracy, as in :class:`warpcloth.solvers.facts.Facts`; ``fewest`` is a
            multiple of the fewest stable substeps of ``Explicit``.
        style: Colour and marker.
    """

    method: str
    runs: tuple
    style: tuple


def _grid(substeps, iterations):
    return tuple({"substeps": s, "iterations": i} for i in iterations for s in substeps)


# By their names in charts. The grids are those of substeps and iterations within which the fronts on hanging lie.
OTHERS = {
    "newton-semi-implicit": Other("semi-implicit", tuple({"fewest": f} for f in (1.0, 1.5, 2.0, 4.0)), ("olive", "s")),
    "newton-xpbd": Other("xpbd", _grid((10, 20, 40, 80, 160), (1, 2, 4)), ("navy", "X")),
    "newton-vbd": Other("vbd", _grid((2, 4, 8, 16, 32), (2, 5, 10)), ("darkgreen", "o")),
    "newton-style3d": Other("style3d", _grid((1, 2, 4, 8, 16), (1, 3, 10)), ("indigo", "D")),
}
# By the simulator, as --with names it.
SIMULATORS = {"newton": tuple(OTHERS)}


@in_turn
def run_newton(scene, solver, device="cpu", frames=None, progress=None):
    """Runs a scene with a solver of Newton, in float32, the only precision it has.

    The steps of a frame are recorded as a graph and replayed, on the CPU too. Colliders are searched in each step. Compilation
    and one step for it come before frame 0.

    Args:
        scene: The :class:`warpcloth.Scene`.
        solver: The :class:`NewtonPhysics`.
        device: A Warp device.
        frames: Number of frames after the first; by default that of the scene.
        progress: Function called with (frame, frames) after each frame, from frame 0; or None.

    Returns:
        :class:`warpcloth.Animation`, with the start as float32. It has diverged, and ends before that frame, if a coordinate is
        not finite or an edge of the mesh is longer than 11 times its rest length.

    Raises:
        ImportError: Newton is not installed.
        ValueError: An argument is not allowed, or the solver does not take the scene.
    """
    newton = engine()
    frames = scene.frames if frames is None else frames
    whole("frames", frames, 1)
    began = time.perf_counter()
    with wp.ScopedDevice(device):
        run = NewtonSteps(scene, solver, device)
        timings = {"compile": time.perf_counter() - began, "factorise": 0.0, "frames": []}
        points, velocities = [run.points()], [run.velocities()]
        worst, status = 0.0, Status(Result.COMPLETED, frames, message=f"completed by Newton {newton.__version__}")
        if progress is not None:
            progress(0, frames)
        for frame in range(1, frames + 1):
            start = time.perf_counter()
            run.frame()
            x = run.points()
            timings["frames"].append(time.perf_counter() - start)
            strain = _worst_strain(scene.mesh, x)
            if not strain < _TORN:
                why = "a coordinate is not finite" if not np.isfinite(x).all() else f"an edge has the strain {strain:.3g}"
                status = Status(Result.DIVERGED, frame - 1, message=f"diverged in frame {frame}: {why}")
                break
            worst = max(worst, strain)
            points.append(x)
            velocities.append(run.velocities())
            if progress is not None:
                progress(frame, frames)
    times = np.arange(len(points)) / scene.fps
    return Animation(np.array(points), np.array(velocities), times, status, timings, worst, scene=scene)


class NewtonSteps:
    """A scene, a solver of Newton and its states; use it in the scope of its device.

    The steps of a frame are one graph. Compilation comes with the constructor, which takes a step for it.

    Attributes:
        model: The ``newton.Model``.
        states: The state after the last step, and one to write.
    """

    def __init__(self, scene, solver, device):
        self.model = newton_model(scene, solver.method, device)
        self.substeps, self._step = solver.substeps, 1.0 / (scene.fps * solver.substeps)
        self._pipeline = engine().CollisionPipeline(self.model) if scene.colliders else None
        self._begin(scene, solver)
        self._advance(1)  # compiles
        self._begin(scene, solver)
        with wp.ScopedCapture(device) as capture:
            self._advance(self.substeps)
            if self.substeps % 2:  # so that the graph ends where it began
                ended, other = self.states
                wp.copy(other.particle_q, ended.particle_q)
                wp.copy(other.particle_qd, ended.particle_qd)
                self.states.reverse()
        self._graph = capture.graph

    def _begin(self, scene, solver):
        self._solver = newton_solver(self.model, scene, solver.method, solver.iterations)
        self._contacts = None if self._pipeline is None else self._pipeline.contacts()
        self._control, self.states = self.model.control(), [self.model.state(), self.model.state()]

    def _advance(self, steps):
        for _ in range(steps):
            now, then = self.states
            now.clear_forces()
            if self._pipeline is not None:
                self._pipeline.collide(now, self._contacts)
            self._solver.step(now, then, self._control, self._contacts, self._step)
            self.states.reverse()

    def frame(self):
        """Takes the steps of a frame."""
        wp.capture_launch(self._graph)

    def points(self):
        """Returns positions (n, 3) float32 [m]."""
        return self.states[0].particle_q.numpy().copy()

    def velocities(self):
        """Returns velocities (n, 3) float32 [m/s]."""
        return self.states[0].particle_qd.numpy().copy()


def _worst_strain(mesh, points):
    """Returns the largest |l/L − 1| of the edges of a mesh at points (n, 3), or NaN or infinity if these are not finite."""
    edges, lengths = mesh.edges[mesh.edge_lengths > 0.0], mesh.edge_lengths[mesh.edge_lengths > 0.0]
    with np.errstate(over="ignore", invalid="ignore"):
        now = np.linalg.norm((points[edges[:, 1]] - points[edges[:, 0]]).astype(np.float64), axis=1)
        return float(np.max(np.abs(now / lengths - 1.0), initial=0.0 * points.sum()))
