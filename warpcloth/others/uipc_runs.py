"""The solver of libuipc as a record, and its steps."""

from dataclasses import dataclass
from tempfile import TemporaryDirectory

import numpy as np
import warp as wp

from ..base.checks import whole
from ..base.version import installed_version
from .runs import OtherSolver, Simulator
from .uipc_model import engine, uipc_scene


@dataclass(frozen=True)
class LibUipc:
    """The solver of libuipc: implicit Euler by Newton's method.

    Attributes:
        substeps: Steps per frame.
        iterations: Minimum of iterations per step.

    Raises:
        ValueError: A value is not allowed.
    """

    substeps: int
    iterations: int = 1

    def __post_init__(self):
        whole("substeps", self.substeps, 1)
        whole("iterations", self.iterations, 1)

    @property
    def version(self):
        """The simulator and its version."""
        return f"libuipc {installed_version('pyuipc')}"

    def bind(self, scene, device):
        """Returns the :class:`UipcSteps` of a scene on a device.

        Raises:
            ValueError: The device is a CPU.
        """
        if str(device) == "cpu":
            raise ValueError("device is 'cpu'; libuipc runs on CUDA only")
        return UipcSteps(scene, self, wp.get_device(device).ordinal)


class UipcSteps:
    """A scene in libuipc, on the CUDA device ``ordinal``."""

    def __init__(self, scene, solver, ordinal):
        uipc, self._substeps = engine(), solver.substeps
        self._scene = uipc_scene(scene, 1.0 / (scene.fps * solver.substeps), solver.iterations)
        self._folder = TemporaryDirectory(ignore_cleanup_errors=True)  # libuipc writes there
        self._engine = uipc.Engine("cuda", self._folder.name, uipc.Engine.default_config() | {"gpu": {"device": ordinal}})
        self._world = uipc.World(self._engine)
        self._world.init(self._scene)
        if not self._world.is_valid():
            found = [" ".join(each.message().split()) for each in self._world.sanity_checker().errors().values()]
            raise ValueError(f"libuipc refuses the start of the scene {scene.name!r}: {'; '.join(found)}")
        self._accessor = self._world.features().find(uipc.core.FiniteElementStateAccessorFeature)
        self._state, names = self._accessor.create_geometry(), (uipc.builtin.position, uipc.builtin.velocity)
        self._points, self._velocities = (uipc.view(self._state.vertices().create(each, np.zeros(3))) for each in names)

    def frame(self):
        """Takes the steps of a frame."""
        for _ in range(self._substeps):
            self._world.advance()
        self._world.sync()

    def points(self):
        """Returns positions (n, 3) float64 [m], NaN after a failure."""
        return self._read(self._points)

    def velocities(self):
        """Returns velocities (n, 3) float64 [m/s], NaN after a failure."""
        return self._read(self._velocities)

    def stop(self):
        """Sets velocities to 0."""
        self._read(self._points)
        self._velocities[:] = 0.0
        self._accessor.copy_from(self._state)

    def _read(self, values):
        self._accessor.copy_to(self._state)
        return np.array(values).reshape(-1, 3) if self._world.is_valid() else np.full((len(values), 3), np.nan)


_RUNS = tuple({"substeps": substeps, "iterations": iterations} for substeps in (1, 2, 4, 8, 16) for iterations in (1, 2, 4))
UIPC = Simulator("libuipc", "pyuipc", engine, "float64", {"libuipc": OtherSolver("IPC", LibUipc, _RUNS)})
