"""Rest shapes: where the energy of a scene and of its weight is least, without inertia."""

from typing import NamedTuple

import numpy as np
import warp as wp

from .checks import choice, number, whole
from .minimise import Minimiser
from .solvers.solver import refuse_hard
from .status import Result, Status

SETTLED = (Result.CONVERGED, Result.ROUNDED)


class Equilibrium(NamedTuple):
    """A rest shape.

    Attributes:
        points: (n, 3) [m].
        status: How it ended, see :class:`warpcloth.status.Result`, with the residual ‖∇U − m g‖/(‖m g‖ + ‖∇U − m g where the
            last descent began‖).
        iterations: Newton iterations in all.
    """

    points: np.ndarray
    status: Status
    iterations: int


def equilibrium(scene, tolerance=1e-8, load_steps=1, iterations=1000, device="cpu", dtype="float64", linear="factorised"):
    """The shape that minimises U(x) − Σ m g·x with the pins where they start, from the positions of the scene.

    Newton's method without inertia, with a line search, gravity applied in equal load steps. Where it cannot go on, because
    the Hessian is singular (a flat cloth without bending stiffness has nothing that holds it against its weight), the step
    is taken with inertia, s/2‖x − x_now‖²_M, and s is lowered from there: a proximal point method, which goes downhill all
    the way. Cloth that nothing holds has no rest shape and is reported as not converged. Where the Hessian has a negative
    eigenvalue in the end, the shape is in balance without being a minimum: it is nudged and settles again.

    Args:
        scene: The :class:`warpcloth.Scene`; velocities, moving pins and duration do not matter.
        tolerance: Of the residual, see :class:`Equilibrium`; one no larger than rounding makes it counts as converged.
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
    used = 0

    def settle(s, load, most):
        """Minimises from where the cloth is, and moves it there; how that ended."""
        nonlocal used
        minimiser.set_objective(s, load)
        (result,) = minimiser.minimise(tolerance, most)
        used += max(minimiser.iterations, 1)
        base.assign(base.numpy() + minimiser.correction.numpy())
        return result

    for part in range(1, load_steps + 1):
        result = _descend(settle, part / load_steps, _frequency_scale(model), lambda: iterations - used)
    if result in SETTLED:
        # In balance; but a straight chain that stands on its pin is too. Nudged, it leaves, and what is at rest comes back.
        minimiser.set_objective(0.0, 1.0)
        if minimiser.curves_down():
            base.assign(base.numpy() + _nudge(model))
            result = _descend(settle, 1.0, _frequency_scale(model), lambda: iterations - used)
            if result in SETTLED and minimiser.curves_down():
                result = Result.SADDLE
    residual = float(minimiser.residual.max())
    message = result.value if result is Result.CONVERGED else f"{result.value}, residual {residual:.2g}"
    return Equilibrium(np.array(base.numpy()), Status(result, residual=residual, message=message), used)


def _descend(settle, load, s, left):
    """Settles without inertia, with proximal steps in between where that does not go on; the last result."""
    while True:
        result = settle(0.0, load, left())
        if result is Result.ROUNDED:  # of a long way d; from here d is short and rounds less
            result = settle(0.0, load, left())
        if result in SETTLED or result is Result.DIVERGED or left() <= 0:
            return result
        for _ in range(8):
            settle(s, load, min(20, max(left(), 1)))
        s /= 16.0


def _nudge(model):
    """A move of the free vertices by about 1e-4 of the size of the cloth, the same at every call (n, 3) [m]."""
    size = np.linalg.norm(np.ptp(model.positions.numpy(), axis=0))
    noise = np.random.default_rng(0).normal(size=(model.count, 3))
    return 1e-4 * size * noise * (model.inverse_mass.numpy() > 0.0)[:, None]


def _frequency_scale(model):
    """g over the size of the cloth [1/s²], the square of the slowest frequency that a cloth hung by its end has; or 1."""
    size = np.linalg.norm(np.ptp(model.positions.numpy(), axis=0))
    gravity = float(np.linalg.norm(model.gravity.numpy()))
    return 100.0 * gravity / size if gravity > 0.0 else 1.0
