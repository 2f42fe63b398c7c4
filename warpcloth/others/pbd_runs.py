"""The solvers of pyPBD as records, and their steps."""

from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from ..base.checks import choice, whole
from ..base.version import installed_version
from ..solvers.facts import grid
from .pbd_model import METHODS, engine, frame_of, pbd_model
from .runs import OtherSolver, Simulator


@dataclass(frozen=True)
class PositionBasedDynamics:
    """A solver of pyPBD, with its settings.

    Attributes:
        method: One of :data:`warpcloth.others.pbd_model.METHODS`.
        substeps: Steps per frame.
        iterations: Iterations per step.

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

    @property
    def version(self):
        """The simulator and its version."""
        return f"pyPBD {installed_version('pyPBD')}"

    def bind(self, scene, device):
        """Returns the :class:`PbdSteps` of a scene.

        Raises:
            ValueError: The device is not a CPU.
        """
        if str(device) != "cpu":
            raise ValueError(f"device is {str(device)!r}; pyPBD has the CPU only")
        return PbdSteps(scene, self)


class PbdSteps:
    """A scene and a solver of pyPBD, which has one clock per process.

    Attributes:
        model: The ``pypbd.SimulationModel``.
    """

    def __init__(self, scene, solver):
        self._pypbd, self._solver = engine(), solver
        self._rotation, self._scale = frame_of(scene.gravity)
        self._frame = 1.0 / scene.fps
        if self._pypbd.Simulation.getCurrent().getTimeStep() is None:
            self._pypbd.Simulation.getCurrent().initDefault()
        self.model = pbd_model(scene, solver.method, self._frame / solver.substeps, solver.iterations)
        self._particles = self.model.getParticles()

    def frame(self):
        """Takes the steps of a frame."""
        steps, settings = self._pypbd.Simulation.getCurrent().getTimeStep(), self._pypbd.TimeStepController
        steps.setValueUInt(settings.NUM_SUB_STEPS, self._solver.substeps)
        steps.setValueUInt(settings.MAX_ITERATIONS, self._solver.iterations)
        self._pypbd.TimeManager.getCurrent().setTimeStepSize(self._frame * self._scale)
        steps.step(self.model)

    def points(self):
        """Returns positions (n, 3) float64 [m]."""
        return np.array(self._particles.getVertices()) @ self._rotation

    def velocities(self):
        """Returns velocities (n, 3) float64 [m/s]."""
        found = [self._particles.getVelocity(i) for i in range(self._particles.size())]
        return np.array(found).reshape(-1, 3) @ self._rotation * self._scale

    def stop(self):
        """Sets velocities to 0."""
        for i in range(self._particles.size()):
            self._particles.setVelocity(i, np.zeros(3))


# The grids are those of substeps and iterations within which the fronts on hanging lie.
PBD = Simulator(
    "pyPBD",
    "pyPBD",
    engine,
    "float64",
    {
        f"pypbd-{method}": OtherSolver(
            method.upper(), partial(PositionBasedDynamics, method), grid(product((10, 20, 40, 80, 160), (1, 2, 4)))
        )
        for method in METHODS
    },
)
