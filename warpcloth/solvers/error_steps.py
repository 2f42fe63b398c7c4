"""Steps whose length follows from an estimate of their error."""

from dataclasses import replace
from functools import partial

import numpy as np
import warp as wp

from ..core.capture import Mirror, Segment
from ..core.reset import Reset
from ..core.status import Result
from ..core.sums import Sums
from ..kernels import step_doubling as kernels
from ..numerics.integrators import INTEGRATORS
from .solver import Stepper

# A frame has 2^k steps of h. k is from LONGEST to SHORTEST, and FIRST at the start.
LONGEST, FIRST, SHORTEST = 1, 4, 10
# Steppers that are kept, each with a step of its own, and so with its own constant matrix.
KEPT = 4
# Steps become twice as long if their error is then expected to be below this fraction of its tolerance.
SURE = 0.8


class Length:
    """The length of the steps of an :class:`ErrorStepper`.

    Attributes:
        k: A frame has 2^k steps of the next length; ``shortest`` is the largest so far.
        at: Position in the frame, in units of the shortest step.
        taken, rejected: Number of steps taken, and of pairs of steps whose error was too large.
        tried: Number of all steps, with those that estimate errors.
    """

    names = "k", "at", "shortest", "taken", "rejected", "tried"

    def __init__(self, k):
        self.k, self.shortest = k, k
        self.at = self.taken = self.rejected = self.tried = 0

    def copy(self):
        other = Length(self.k)
        other.assign(self)
        return other

    def assign(self, other):
        vars(self).update(vars(other))

    def to_host(self):
        return {name: np.array(getattr(self, name)) for name in self.names}

    def from_host(self, values):
        vars(self).update({name: int(values[name]) for name in self.names})


class ErrorStepper(Stepper):
    """Takes two steps of h at a time, with h = frame/2^k as long as their error allows; all copies take the same steps.

    The error is estimated by step doubling (Hairer, Nørsett and Wanner 1993, *Solving ordinary differential equations I*,
    II.4), for a method of order p by

        e = max ‖x(two steps) − x(one step)‖/(2^p − 1)    over the vertices of all copies [m]

    The two are taken if e ≤ ``error``, else h is halved. Two steps of twice the length come next if 2^(p+1) e ≤ 0.8 ``error``,
    where they fit into the frame. Each length has a stepper of its own, at most four of which are kept; the state is copied to
    it before a step.

    Args:
        bind: Function (record) → the stepper of a record with ``substeps`` on the model.

    Attributes:
        model, declared: The model as it was bound; the stepper of each length has its own.
        length: :class:`Length`.
        reported: The stepper that is always kept, whose contact has the present state after each step and frame.
        iterations: Iterations of all steps of the last frame, over the number of those taken.
        steps_per_frame: Number of steps of the last frame.
        h, he: The shortest step so far, and the effective step of the shortest possible one [s].
    """

    uniform = True  # `iterations` is a mean
    even = False

    def __init__(self, options, bind, model):
        self.options, self.model, self.declared, self._reset = options, model, model, None
        self._bind, self._kept, self._segments, self.factorise_seconds = bind, {}, {}, 0.0
        self.reported = first = self._stepper(FIRST)
        self.integrator, self.count = getattr(first, "integrator", None), getattr(first, "count", None)
        self.order = INTEGRATORS[options.integrator].order
        self.state = first.state.copy()
        self.length = self.state.add_part("length", Length(FIRST))
        self.he = first.he * 2.0 ** (FIRST - SHORTEST)
        self.steps_per_frame, self.iterations = first.steps_per_frame, 0
        self._reports = bool(model.scene.colliders) or model.scene.self_contact is not None or model.timed
        self._planned, self._k, self._error = 0, FIRST, None
        self._whole, self._half, self._apart = (model.vectors() for _ in range(3))
        self._ones, self._sums, self._largest = model.constant(1.0, model.count), Sums(model), Mirror(model.scalars())
        self._subtract = model.kernel(kernels.subtract_positions, model.dtype)
        self._compare = Segment(model.device, self._launch_compare)

    def _stepper(self, k):
        """Returns the stepper with 2^k steps a frame; drops the least recently used one."""
        found = self._kept.pop(k, None)
        if found is None:
            if len(self._kept) == KEPT:
                del self._kept[next(other for other, each in self._kept.items() if each is not self.reported)]
            found = self._bind(replace(self.options, error=None, substeps=2**k))
            self.factorise_seconds += found.factorise_seconds
        self._kept[k] = found
        return found

    # The state of this stepper and that of one with steps of one length.

    def _between(self, stepper, take):
        unit = 2**SHORTEST // stepper.steps_per_frame

        def launch():
            for mine, its in self._states(stepper):
                for name, array in its.arrays.items():
                    self._launch_between(mine.counts.get(name), mine.arrays[name], array, unit, take)

        return Segment(self.model.device, launch)

    def _launch_between(self, count, mine, its, unit, take):
        a, b = (its, mine) if take else (mine, its)
        times, parts = (unit, 1) if take else (1, unit)
        launch = partial(self.model.launch, dim=mine.size)
        if count is None:
            wp.copy(b, a)
        elif count.sums:
            launch(kernels.add_to_sums if take else kernels.divide_sums, inputs=[a, unit], outputs=[b])
        elif count.rest:
            given = [a.flatten(), times, parts, count.rest, int(take)]
            launch(kernels.scale_notes, inputs=given, outputs=[b.flatten()])
        else:
            launch(kernels.scale_steps, inputs=[a, times, parts], outputs=[b])

    def _states(self, stepper):
        """Returns pairs of states, of this and another stepper: of threads, then the whole."""
        mine, its = self.state, stepper.state
        return [*zip(mine.shares, its.shares, strict=True), (mine, its)]

    def _copy(self, stepper, take=False):
        """Copies the state to a stepper, or back from it with ``take``."""
        key = stepper, take
        if key not in self._segments:
            self._segments = {of: each for of, each in self._segments.items() if of[0] in self._kept.values()}
            self._segments[key] = self._between(stepper, take)
        self._segments[key]()
        for mine, its in self._states(stepper):
            a, b = (its, mine) if take else (mine, its)
            b.results, b.residual = list(a.results), a.residual.copy()
            for name in its.parts:
                b.parts[name].assign(a.parts[name])

    def _report(self):
        if self._reports:
            self._copy(self.reported)

    # Steps.

    def _find(self):
        """Takes the next two steps with a length that their error allows; returns their stepper."""
        if not self.length.at:
            self._taken = self._iterations = 0
        length, alive = self.length, [result is not Result.DIVERGED for result in self.state.results]
        k = length.k
        wp.copy(self._whole, self._try(k - 1).state.x)
        while True:
            stepper = self._try(k)
            wp.copy(self._half, stepper.state.x)
            self._step(stepper)
            wp.copy(self._apart, stepper.state.x)
            self._compare()
            allowed = self.options.error * (2.0**self.order - 1.0)
            self._error = np.where(alive, self._largest.read() / allowed, 0.0)
            if k == SHORTEST or self._error.max() <= 1.0:  # not if it is NaN
                self._k = k
                return stepper
            k, length.rejected = k + 1, length.rejected + 1
            wp.copy(self._whole, self._half)

    def _try(self, k):
        stepper = self._stepper(k)
        self._copy(stepper)
        self._step(stepper)
        return stepper

    def _step(self, stepper):
        stepper.step()
        self.length.tried += 1
        self._iterations += stepper.iterations

    def _launch_compare(self):
        self.model.launch(self._subtract, self.model.count, [self._apart, self._whole], [self._apart])
        self._sums.largest(self._ones, self._apart, self._largest.array)

    def _end(self):
        length, k, missed = self.length, self._k, ~(self._error <= 1.0)
        state = self.state
        for copies in state.shares or [state]:
            of_share, missed = missed[: len(copies.results)], missed[len(copies.results) :]
            copies.results = [
                result.worse(Result.INACCURATE) if each else result
                for result, each in zip(copies.results, of_share, strict=True)
            ]
        length.taken, length.shortest, self._taken = length.taken + 2, max(length.shortest, k), self._taken + 2
        length.at = (length.at + 2 ** (SHORTEST - k + 1)) % 2**SHORTEST
        aligned = length.at % 2 ** (SHORTEST - k + 2) == 0
        if not length.at:
            self.steps_per_frame, self.iterations = self._taken, self._iterations / self._taken
        length.k = k - 1 if k > LONGEST and aligned and self._error.max() * 2.0 ** (self.order + 1) <= SURE else k

    def step(self):
        """Takes one step of h. Once h is found, the step is taken again, so that contact and loads are those of this step."""
        if not self._planned:
            self._find()
            self._planned = 2
        stepper = self._stepper(self._k)
        self._copy(stepper)
        stepper.step()
        self._copy(stepper, take=True)
        self._planned -= 1
        if not self._planned:
            self._end()
        self._report()

    def frame(self):
        while self._planned:
            self.step()
            if not (self._planned or self.length.at):
                return
        while True:
            self._copy(self._find(), take=True)
            self._end()
            if not self.length.at:
                break
        self._report()

    def steps_of_frame(self):
        while True:
            self.step()
            yield
            if not (self._planned or self.length.at):
                return

    def reset(self, mask=None, positions=None, velocities=None):
        """See :meth:`Stepper.reset`. Steps start with their first length again if all copies do.

        Raises:
            ValueError: It is within a frame, or as there.
        """
        if self._planned or self.length.at:
            raise ValueError("reset is within a frame; with error it must come at the end of one")
        if self._reset is None:
            self._reset = Reset(self)
            self._resets = [self._reset]
            if self.state.shares:
                shares = zip(self.reported.shares, self.state.shares, strict=True)
                self._resets = [Reset(self, stepper.model, state) for (stepper, _first, _end), state in shares]
        mask, positions, velocities = self._reset.on_device(mask, positions, velocities)
        n, first = self.model.per_copy, 0
        for reset in self._resets:
            end = first + reset.model.copies
            of_share = [None if given is None else given[first * n : end * n] for given in (positions, velocities)]
            reset(mask[first:end], *of_share)
            first = end
        if mask.numpy().all():
            self.length.assign(Length(FIRST))
        self._report()

    def record_again(self):
        self.reported.record_again()

    # What others read.

    @property
    def h(self):
        return 1.0 / (self.model.scene.fps * 2**self.length.shortest)

    @property
    def kept(self):
        return len(self._kept)

    @property
    def loads_at_end(self):
        return self.reported.loads_at_end

    @property
    def shares(self):
        return self.reported.shares

    @property
    def takers(self):
        return self._stepper(self._k).shares

    @property
    def colliders(self):
        return getattr(self.reported, "colliders", None)  # a batch that threads share has none of its own

    @property
    def pairs(self):
        return self.reported.pairs

    @property
    def cut(self):
        self._report()
        return self.reported.cut

    @property
    def inside(self):
        """See :attr:`Stepper.inside`."""
        self._report()
        of = self.reported.steps_per_frame
        return [(copy, c, step * self.steps_per_frame // of, *rest) for copy, c, step, *rest in self.reported.inside]

    def constraint_forces(self, collider=None):
        raise ValueError(
            "error is given, with which neither the forces of terms with infinite stiffness nor the reactions of their pins "
            "are known; take dt or substeps, or a finite stiffness"
        )
