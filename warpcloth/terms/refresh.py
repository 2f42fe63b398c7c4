"""Rest states and stencils that change during a run: a term says when, and what is launched then.

Damping, rigid clusters and every term of stencils that come and go are set anew by this one mechanism. A solver calls
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
        move: Of a step's beginning what its integrator knows of the motion until then (N,), times ``scale``; None for Euler.
        scale: 1, or for velocities their time [s].
    """

    x: wp.array
    correction: wp.array | None = None
    integrator: str = "euler"
    move: wp.array | None = None
    scale: float = 1.0


@dataclass(frozen=True, eq=False)
class Refresh:
    """The part of a term's elements that is set anew during a run.

    A term of stencils that come and go has arrays for its capacity, and its launch fills the stencils and the rest states that
    are in use; the stiffness of all others it sets to 0, by a count that stays on the device.

    Attributes:
        when: :data:`STEP` or :data:`EVALUATION`.
        launch: Function of (model, elements, moment) that launches what writes ``elements``, the
            :class:`warpcloth.model.elements.DeviceElements`, at a :class:`Moment`. It is recorded once and replayed: it
            may neither read on the host nor allocate.
        arrays: What it reads of each element, (B·E,); reordered with the elements.
    """

    when: str
    launch: Callable
    arrays: tuple = ()

    def with_arrays(self, change):
        """This refresh with each array as the function ``change`` makes it."""
        return replace(self, arrays=tuple(map(change, self.arrays)))
