"""Rest shapes: where the energy of a scene and of its weight is least, without inertia."""

from typing import NamedTuple

import numpy as np
import warp as wp

from .checks import choice, number, whole
from .minimise import Minimiser
from .solvers.solver import Result, Status, refuse_hard


class Equilibrium(NamedTuple):
    """A rest shape.

    Attributes:
        points: (n, 3) [m].
        status: Converged, or iterations used up, with the residual ‖∇U − m g‖/(‖m g‖ + ‖∇U − m g at the start of the load‖).
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
    the way. Terms that hold only by inertia have no rest shape and are reported as not converged.

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
        """Minimises from where the cloth is, and moves it there; whether it converged."""
        nonlocal used
        minimiser.set_objective(s, load)
        converged = minimiser.minimise(tolerance, most).all()
        used += minimiser.iterations
        base.assign(base.numpy() + minimiser.correction.numpy())
        return bool(converged)

    for part in range(1, load_steps + 1):
        load = part / load_steps
        s = _frequency_scale(model)
        while not (converged := settle(0.0, load, iterations - used)) and used < iterations:
            for _ in range(8):
                settle(s, load, min(20, iterations - used))
            s /= 16.0
    residual = float(minimiser.residual.max())
    result = Result.CONVERGED if converged else Result.ITERATIONS_USED_UP
    return Equilibrium(base.numpy(), Status(result, residual=residual, message=result.value), used)


def _frequency_scale(model):
    """g over the size of the cloth [1/s²], the square of the slowest frequency that a cloth hung by its end has; or 1."""
    size = np.linalg.norm(np.ptp(model.positions.numpy(), axis=0))
    gravity = float(np.linalg.norm(model.gravity.numpy()))
    return 100.0 * gravity / size if gravity > 0.0 else 1.0
