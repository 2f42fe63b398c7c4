"""Updates of rest states during a run: a term says when, and by which launch.

Damping, rigid clusters, sparse energies and colliders use it. A solver calls :meth:`warpcloth.model.model.Model.refresh` at the
start of each step. Every evaluation of an energy, a force or a projection calls it with the positions that it will use.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import warp as wp

# Once per step, before the prediction; or before each evaluation, of which a step has many.
STEP, EVALUATION = "step", "evaluation"


class Moment(NamedTuple):
    """The state from which elements are refreshed.

    Attributes:
        x: Positions (N,) vectors [m].
        correction: d (N,) [m] for an evaluation at x + d; None for one at x.
        move: Array (N,) such that d = scale·move is a displacement [m], for integrators that take rates from x − d too; None
            for those that take them from x alone.
        scale: 1 if ``move`` is in metres, or a time [s] if it is a velocity.
        parts: n of the s̃ from which an integrator with a ``move`` takes the rate (s − s̃)/hₑ of any s: s̃ is s(x) less the mean
            of n changes of s, the first of which is s(x − d) − s(x), and the others 0.
        both: Whether the second is s(x + d) − s(x).
        steps: Number of keyframe steps that each copy has made, (B,) int32; None if nothing follows keyframes.
        per_frame: Keyframe steps per frame.
        ahead: Keyframe steps from the start of the step to the time at which it takes forces.
        v: Velocities (N,) [m/s] at the start of a step; None where nothing has a velocity yet.
        he: hₑ [s], over which velocities are taken; the step, where ``explicit``.
        explicit: Whether forces are those at x.
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

    It writes rest states. It may also write stencils: then the arrays are as long as the largest number of elements, and the
    launch sets the stiffness of unused ones to 0. But a solver reads stencils once, when it is bound, for incidences on CUDA,
    the pattern of the Hessian, colours and constant matrices, which do not follow later changes.

    Attributes:
        when: :data:`STEP` or :data:`EVALUATION`.
        launch: Function (model, elements, moment) that launches kernels which write the arrays of ``elements``, the
            :class:`warpcloth.model.elements.DeviceElements`, at a :class:`Moment`. It is captured once and replayed, so it
            must neither read on the host nor allocate.
        arrays: Arrays that it reads, (B·E,), which are reordered with the elements.
    """

    when: str
    launch: Callable
    arrays: tuple = ()

    def with_arrays(self, change):
        """Returns this refresh with ``change`` applied to each array."""
        return replace(self, arrays=tuple(map(change, self.arrays)))
