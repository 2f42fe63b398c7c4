"""The solvers of Newton, the physics engine, as records, and their steps."""

from dataclasses import dataclass
from functools import partial
from itertools import product

import warp as wp

from ..base.checks import choice, whole
from ..solvers.facts import grid
from .newton_model import METHODS, engine, newton_model, newton_solver
from .runs import OtherSolver, Simulator


@dataclass(frozen=True)
class NewtonPhysics:
    """A solver of Newton, the physics engine, with its settings.

    Attributes:
        method: One of :data:`warpcloth.others.newton_model.METHODS`.
        substeps: Steps per frame.
        iterations: Iterations per step; 1 for semi-implicit steps.

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

    @property
    def version(self):
        """The simulator and its version."""
        return f"Newton {engine().__version__}"

    def bind(self, scene, device):
        """Returns the :class:`NewtonSteps` of a scene on a device."""
        return NewtonSteps(scene, self, device)


class NewtonSteps:
    """A scene, a solver of Newton and its states, for the scope of its device.

    The steps of a frame are a recorded graph, on the CPU too; the constructor compiles by taking a step.

    Attributes:
        model: The ``newton.Model``.
        states: The last state, and one to write.
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

    def stop(self):
        """Sets velocities to 0."""
        self.states[0].particle_qd.zero_()


# The grids are those of substeps and iterations within which the fronts on hanging lie.
NEWTON = Simulator(
    "Newton engine",  # not to be taken for the method of Newton
    "newton",
    engine,
    "float32",
    {
        "newton-semi-implicit": OtherSolver(
            "semi-implicit", partial(NewtonPhysics, "semi-implicit"), tuple({"fewest": f} for f in (1.0, 1.5, 2.0, 4.0)), False
        ),
        "newton-xpbd": OtherSolver("XPBD", partial(NewtonPhysics, "xpbd"), grid(product((10, 20, 40, 80, 160), (1, 2, 4)))),
        "newton-vbd": OtherSolver("VBD", partial(NewtonPhysics, "vbd"), grid(product((2, 4, 8, 16, 32), (2, 5, 10)))),
        "newton-style3d": OtherSolver(
            "Style3D", partial(NewtonPhysics, "style3d"), grid(product((1, 2, 4, 8, 16), (1, 3, 10)))
        ),
    },
)
