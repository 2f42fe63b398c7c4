"""Rest shapes: where the energy of a scene and of its weight is least, without inertia."""

from typing import NamedTuple

import numpy as np
import warp as wp

from .checks import choice, number, whole
from .minimise import Minimiser
from .solvers.solver import refuse_hard
from .status import Result, Status
from .turns import in_turn

SETTLED = (Result.CONVERGED, Result.ROUNDED)
# Part of the size of the cloth; a descent that rounding ended after less than this has nowhere left to go.
NEAR = 1e-5


class Equilibrium(NamedTuple):
    """A rest shape.

    Attributes:
        points: (n, 3) [m].
        status: How it ended, see :class:`warpcloth.status.Result`, with the residual: the largest unbalanced acceleration of
            a vertex over gravity's (without any, over the largest at the start).
        iterations: Newton iterations in all, each round of proximal steps counting as one more.
    """

    points: np.ndarray
    status: Status
    iterations: int


@in_turn
def equilibrium(scene, tolerance=1e-8, load_steps=1, iterations=1000, device="cpu", dtype="float64", linear="factorised"):
    """The shape that minimises U(x) − Σ m g·x with the pins where they start, from the positions of the scene.

    Newton's method without inertia, with a line search, gravity applied in equal load steps. Where it cannot go on, because
    the Hessian is singular (a flat cloth without bending stiffness has nothing that holds it against its weight), the step
    is taken with inertia, s/2‖x − x_now‖²_M, and s is lowered from there: a proximal point method, which goes downhill all
    the way. Cloth that nothing holds has no rest shape and is reported as not converged. Where the Hessian has a negative
    eigenvalue in the end, the shape is in balance without being a minimum: it is nudged and settles again.

    Args:
        scene: The :class:`warpcloth.Scene`; velocities, moving pins and duration do not matter.
        tolerance: Of the residual, see :class:`Equilibrium`. Where rounding leaves more, the descent ends when nothing is left
            to gain and the status says so; with more than the weight unbalanced it does not pass for a rest shape.
        load_steps: Parts in which gravity comes on.
        iterations: The most Newton iterations in all.
        device: A Warp device.
        dtype: ``"float32"`` or ``"float64"``.
        linear: ``"factorised"``, which stiff and slender cloth needs, or ``"cg"``.

    Returns:
        :class:`Equilibrium`.

    Raises:
        ValueError: If an argument breaks a rule, or a stiffness is infinite.
    """
    number("tolerance", tolerance, above=0.0)
    whole("load_steps", load_steps, 1)
    whole("iterations", iterations, 1)
    choice("linear", linear, ("factorised", "cg"))
    model = scene.build(device=device, dtype=dtype)
    refuse_hard(model, "equilibrium", "give a finite stiffness")
    base = wp.clone(model.positions)
    minimiser = Minimiser(model, base, "adaptive", linear, s=0.0)
    descent = _Descent(minimiser, base, tolerance, iterations)
    for part in range(1, load_steps + 1):
        result = descent.run(part / load_steps, _frequency_scale(model))
    # In balance; but a straight chain that stands on its pin is too. Nudged, it leaves, and what is at rest comes back.
    if result in SETTLED and minimiser.curves_down(tolerance):
        base.assign(base.numpy() + _nudge(model))
        result = descent.run(1.0, _frequency_scale(model))
        if result in SETTLED and minimiser.curves_down(tolerance):
            result = Result.SADDLE
    residual = float(minimiser.residual.max())
    message = result.value if result is Result.CONVERGED else f"{result.value}, residual {residual:.2g}"
    if result is Result.ROUNDED and residual > 1.0:  # forces beyond the weight: nothing says that this is near the rest shape
        result, message = Result.STALLED, f"rounding hides the rest shape in {dtype}, residual {residual:.2g}"
    return Equilibrium(np.array(base.numpy()), Status(result, residual=residual, message=message), descent.used)


class _Descent:
    """Minimises from where the cloth is and moves it there, again and again, with so many iterations in all."""

    def __init__(self, minimiser, base, tolerance, iterations):
        self.minimiser, self.base, self.tolerance, self.iterations = minimiser, base, tolerance, iterations
        self.used, self.moved = 0, 0.0
        self.scale = None  # of the first descent: without gravity a later one begins at its own rounding
        self.size = np.linalg.norm(np.ptp(base.numpy(), axis=0))

    def run(self, load, s):
        """Settles without inertia, with proximal steps in between where that does not go on; the last result."""
        while True:
            result = self._settle(0.0, load, self.iterations)
            while result is Result.ROUNDED and self.moved > NEAR and self.used < self.iterations:
                result = self._settle(0.0, load, self.iterations)  # a long d rounds much; from here it is short
            if result in SETTLED or result is Result.DIVERGED or self.used >= self.iterations:
                return result
            for _ in range(8):
                self._settle(s, load, 20)
            s /= 16.0
            self.used += 1  # so that a round which finds no direction at all ends too

    def _settle(self, s, load, most):
        self.minimiser.set_objective(s, load)
        (result,) = self.minimiser.minimise(self.tolerance, min(most, max(self.iterations - self.used, 0)), self.scale)
        self.scale = self.minimiser.scale
        self.used += self.minimiser.iterations
        correction = self.minimiser.correction.numpy()
        self.moved = np.abs(correction).max(initial=0.0) / self.size
        self.base.assign(self.base.numpy() + correction)
        return result


def _nudge(model):
    """A move of the free vertices by about 1e-4 of the size of the cloth, the same at every call (n, 3) [m]."""
    size = np.linalg.norm(np.ptp(model.positions.numpy(), axis=0))
    noise = np.random.default_rng(0).normal(size=(model.count, 3))
    return 1e-4 * size * noise * (model.inverse_mass.numpy() > 0.0)[:, None]


def _frequency_scale(model):
    """100 g over the size of the cloth [1/s²], 10 times the frequency at which it would swing by its end, squared; or 1."""
    size = np.linalg.norm(np.ptp(model.positions.numpy(), axis=0))
    gravity = float(np.linalg.norm(model.gravity.numpy()))
    return 100.0 * gravity / size if gravity > 0.0 else 1.0
