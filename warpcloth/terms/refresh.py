"""Rest states that change during a run: a term says when they are updated, and by which launch.

Damping, rigid clusters and sparse energies use it. A solver calls
:meth:`warpcloth.model.model.Model.refresh` where a step begins, and each evaluation of an energy, a force or a projection calls
it with the positions that it is about to use. Neither knows a term by name.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import warp as wp

# When: once a step, before the prediction; or before each evaluation, of which a step has many.
STEP, EVALUATION = "step", "evaluation"


class Moment(NamedTuple):
    """The state from which elements are refreshed.

    Attributes:
        x: Positions (N,) vectors [m].
        correction: d (N,) [m] of an evaluation at x + d, or None of one at x.
        integrator: ``"euler"``, ``"midpoint"`` or ``"bdf2"``, whose step begins.
        move: Array (N,) whose ``scale``-fold is, where a step begins, the last move of BDF2 or hₑ v of midpoint [m]; None for
            Euler.
        scale: 1 if ``move`` is in metres, or the time [s] by which velocities are multiplied.
        steps: Number of steps of keyframes that each copy has made, (B,) int32, or None where nothing follows keyframes.
        per_frame: Number of these steps in a frame.
        ahead: Number of these steps from where a step begins to where it takes forces.
    """

    x: wp.array
    correction: wp.array | None = None
    integrator: str = "euler"
    move: wp.array | None = None
    scale: float = 1.0
    steps: wp.array | None = None
    per_frame: int = 1
    ahead: int = 0


@dataclass(frozen=True, eq=False)
class Refresh:
    """The update of a term's elements during a run.

    It writes rest states. If it writes stencils, the term has arrays for the most elements that it can have, and the launch
    sets the stiffness of those not in use to 0. Stencils are read once when a solver is bound, for incidences on CUDA, the
    pattern of the Hessian, colours and constant matrices, which then do not follow.

    Attributes:
        when: :data:`STEP` or :data:`EVALUATION`.
        launch: Function of (model, elements, moment) whose launches write the arrays of ``elements``, the
            :class:`warpcloth.model.elements.DeviceElements`, at a :class:`Moment`. It is recorded once and replayed, so it
            must neither read on the host nor allocate.
        arrays: Arrays that it reads, with one entry per element, (B·E,); they are reordered with the elements.
    """

    when: str
    launch: Callable
    arrays: tuple = ()

    def with_arrays(self, change):
        """Returns this refresh with ``change`` applied to each array."""
        return replace(self, arrays=tuple(map(change, self.arrays)))
