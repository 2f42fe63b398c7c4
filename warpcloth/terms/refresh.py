"""Updates of rest states during a run, by :meth:`warpcloth.model.model.Model.refresh`."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import warp as wp

# Once per step, before the prediction; or before each evaluation, of which a step has many.
STEP, EVALUATION = "step", "evaluation"


class Moment(NamedTuple):
    """The state from which elements are refreshed.

    Attributes:
        x: Positions (N,) [m].
        correction: d (N,) [m] of an evaluation at x + d, or None.
        move: Array (N,) with d = scale·move a displacement [m], for integrators that take rates from x − d too; or None.
        scale: 1, or a time [s] if ``move`` is a velocity.
        parts: n in the rate (s − s̃)/hₑ of integrators with a ``move``: s̃ is s(x) less the mean of n changes, the first s(x −
            d) − s(x), the others 0.
        both: Whether the second is s(x + d) − s(x).
        steps: Keyframe steps of each copy so far, (B,) int32; or None.
        per_frame: Keyframe steps per frame.
        ahead: Keyframe steps from the start of the step to its forces.
        v: Velocities (N,) [m/s] at the start of a step, or None.
        he: hₑ [s]; the step, where ``explicit``.
        explicit: Whether forces are at x.
    """

    x: wp.array
    correction: wp.array | None = None
    move: wp.array | None = None
    scale: float = 1.0
    parts: int = 1
    both: bool = False
    steps: wp.array | None = None
    per_frame: int = 1
    ahead: int = 0
    v: wp.array | None = None
    he: float = 0.0
    explicit: bool = False


@dataclass(frozen=True, eq=False)
class Refresh:
    """The update of a term's elements during a run.

    It writes rest states. It may write stencils in arrays of maximum length, with stiffness 0 of unused elements, but solvers
    read stencils only when they are bound.

    Attributes:
        when: :data:`STEP` or :data:`EVALUATION`: at the start of each step, or before every evaluation.
        launch: Function (model, elements, moment) that launches kernels which write the arrays of ``elements``; it is captured,
            so it must neither read on the host nor allocate.
        arrays: Arrays that it reads, (B·E,), in the order of elements.
    """

    when: str
    launch: Callable
    arrays: tuple = ()

    def with_arrays(self, change):
        """Returns this refresh with ``change`` applied to each array."""
        return replace(self, arrays=tuple(map(change, self.arrays)))
