"""Ends runs that have diverged, and grades all others."""

from contextlib import closing

import numpy as np

from ..base.turns import in_turn
from ..core.status import Grade, Result, Status, Stopped, digits, sentence
from ..numerics.iterate import ResidualScale
from .balance import GAIN, STRETCHED, Balance
from .contact_verdicts import Pressed
from .frames_ahead import Frame, frames_of
from .grades import Grades


def watched_frames(stepper, watch, frames, ahead=0, first=0, keeps=None):
    """Yields the number of each frame up to ``frames``, and the frame, while a copy is good; diverged copies are NaN.

    This is the loop of every run. The watch also notes how the last frame ended. ``first`` is the stepper's frame, ``keeps`` a
    function (number) → whether a frame includes the state, or None.
    """
    if first == frames:
        return
    of_number, number = None if keeps is None else lambda before: keeps(first + 1 + before), first
    with closing(frames_of(stepper, frames - first, ahead, of_number, watch.found_at_ends())) as found:
        try:
            for number, frame in enumerate(found, start=first + 1):
                if not watch.passes(number, frame):
                    return
                yield number, frame
        except Stopped as stopped:
            watch.stops(number + 1, stopped)


def of_copies(values):
    """Returns values per copy (B,), or a float of one copy."""
    return np.array(values) if len(values) > 1 else float(values[0])


class Watch:
    """Detects diverged copies, from frames alone and for every solver.

    A copy has diverged if a value is not finite, a step says so, its energy exceeds what the sources can have added, or an edge
    is longer than that energy explains. Frames are in the order of the scene.

    Args:
        stretched: Strain of an edge above which its energy is checked.
        grades: Whether to find the errors of steps, for the grade.

    Attributes:
        good: The last good frame of each copy (B,).
        alive: Whether a copy is still good (B,).
        growth: Largest kinetic and potential energy in a good frame over that of the sources, (B,).
        last: The last checked frame; before the first, the state of the stepper.
        stopped: Whether the run could not go on.
        seconds: Computation time of each frame [s].
        worst_strain: Largest |l/L − 1| of an edge of the mesh in a good frame of each copy, (B,).
        least_gap: The smallest distance of cloth to cloth in the frames before the last checked one, (B,) [m].
    """

    @in_turn
    def __init__(self, model, stepper, stretched=STRETCHED, grades=True):
        scene = model.scene
        self._stretched = stretched
        self.model, self.rest = model, scene.mesh.edge_lengths[scene.mesh.edge_lengths > 0.0]
        self.ends = scene.mesh.edges[scene.mesh.edge_lengths > 0.0].T.astype(np.intp)
        self.worst_strain, self.messages, self.seconds = np.zeros(model.copies), {}, []
        self.good, self.alive = np.zeros(model.copies, dtype=int), np.ones(model.copies, dtype=bool)
        self.growth, self.balance, self.history = np.zeros(model.copies), Balance(model, stepper), None
        self.last, self.stopped = Frame(None, None, stepper.results, stepper.residual, 0.0), False
        self.grades, self._stepper = Grades(stepper, self.balance) if grades else None, stepper
        self.pressed = Pressed(model) if grades and scene.colliders else None
        self.least_gap = np.full(model.copies, np.inf)

    def passes(self, number, frame):
        """Checks a frame, in order from 1, sets diverged copies to NaN, and returns whether a copy is still good."""
        self.last, points, velocities = frame, frame.points, frame.velocities
        self.seconds.append(frame.seconds)
        B, n = self.model.copies, self.model.per_copy
        error, gap = (None, self.least_gap) if frame.found is None else frame.found
        self.least_gap = np.where(self.alive, gap, self.least_gap)
        finite = (np.isfinite(points) & np.isfinite(velocities)).reshape(B, 3 * n)
        gains, strain = self.balance.gains(number, points, velocities), self._strain(points.reshape(B, n, 3))
        stepped = np.array([result is not Result.DIVERGED for result in frame.results])
        good = finite.all(axis=1) & stepped & (gains <= GAIN)
        long = np.flatnonzero(self.alive & good & (strain > self._stretched))
        long = [copy for copy in long if not self.balance.suffices(copy, points, self._stretched * self.rest.min())]
        good[long] = False
        for copy in np.flatnonzero(self.alive & ~good):
            self.alive[copy] = False
            where = f"diverged in frame {number}" + (f", copy {copy}" if B > 1 else "")
            wrong = np.flatnonzero(~finite[copy])
            if len(wrong):
                self.messages[copy] = f"{where}: vertex {wrong[0] // 3} is not finite"
            elif not stepped[copy]:
                self.messages[copy] = f"{where}: the forces of a step are not finite"
            elif copy in long:
                self.messages[copy] = (
                    f"{where}: an edge has a strain of {digits(100.0 * strain[copy])} %, more than the energy of the run can "
                    "cause"
                )
            else:
                self.messages[copy] = f"{where}: {self.balance.sentence(copy)}"
        self.good[self.alive] = number
        if error is not None:
            self.grades.note(number, frame, error, self.alive)
        if self.pressed is not None:
            self.pressed.note(number, points.reshape(B, n, 3), self.alive)
        self.growth = np.where(self.alive, np.fmax(self.growth, gains), self.growth)
        self.worst_strain = np.where(self.alive, np.fmax(self.worst_strain, strain), self.worst_strain)
        for array in (points, velocities):
            array.reshape(B, n, 3)[~self.alive] = np.nan
        return bool(self.alive.any())

    def found_at_ends(self):
        """Returns the ``find`` of :func:`warpcloth.run.frames_ahead.frames_of`, or None."""
        if self.grades is None:
            return None
        stepper = self._stepper

        def find():
            return self.grades.errors.find(), np.inf if stepper.pairs is None else stepper.pairs.least_gap

        if self.history is None:
            return find
        self.history.find = find  # which needs the pairs of the last step, before records list them anew
        return lambda: self.history.found

    def stops(self, number, why):
        """Notes that frame ``number`` cannot be computed, and why."""
        self.stopped = True
        for copy in np.flatnonzero(self.alive):
            of_copy = f", copy {copy}" if len(self.alive) > 1 else ""
            self.messages[copy] = f"stopped before the end of frame {number}{of_copy}: {why}"

    def _carried(self):
        yield self, ("worst_strain", "good", "alive", "growth", "seconds")
        yield self.balance, self.balance.carried
        for source in self.balance.sources:
            yield source, source.carried
        for part in (self.grades, self.grades and self.grades.flutter, self.pressed, self.history):
            if part is not None:
                yield part, part.carried

    def to_host(self):
        """Returns everything that depends on earlier frames, as arrays by name."""
        parts = enumerate(self._carried())
        return {f"{k} {name}": np.array(getattr(part, name)) for k, (part, names) in parts for name in names}

    def from_host(self, values, state):
        """Sets the values of :meth:`to_host`, for a run that continues from a state."""
        for k, (part, names) in enumerate(self._carried()):
            for name in names:
                found = values[f"{k} {name}"]
                setattr(part, name, found.tolist() if name == "seconds" else found[()])
        self.last = Frame(None, None, state.results, state.residual, 0.0)
        if self.grades is not None:
            self.grades.go_on()

    def _strain(self, points):
        squares = np.zeros((int(self.alive.sum()), len(self.rest)))
        with np.errstate(over="ignore", invalid="ignore"):
            for column in np.moveaxis(points[self.alive], -1, 0):  # by columns, 15 times as fast as by rows of three
                column = column.astype(np.float64)
                squares += (column.take(self.ends[1], axis=1) - column.take(self.ends[0], axis=1)) ** 2
            found = np.full(self.model.copies, np.nan)
            found[self.alive] = np.abs(np.sqrt(squares) / self.rest - 1.0).max(axis=1, initial=0.0)
        return found

    @in_turn
    def status(self, solver, faults=(), warnings=()):
        """Returns the :class:`Status` of a run, from its last frame, further faults (copy, frame, sentence) and warnings."""
        results, residual = self.last.results, self.last.residual
        ended = [Result.STOPPED if self.stopped and alive else Result.DIVERGED for alive in self.alive]
        results = [ended[copy] if copy in self.messages else result for copy, result in enumerate(results)]
        result = max(results, key=list(Result).index)
        kind, measure, unit = solver.residual_on(self.model), None, None
        copy = int(np.argmax(residual))  # the first that is NaN, if any
        if kind is not None:
            measure, unit = kind.measure, ResidualScale(self.model).units[copy]
        faults = [*faults, *self.grades.faults(solver, result)]
        grades = tuple(self.grades.grade(copy, result, faults) for copy, result in enumerate(results))
        grade = max(grades, key=list(Grade).index)
        distance = np.where(self.grades.errors.knows & (self.good > 0), self.grades.distance, np.nan)
        if self.messages:
            others = {copy: f"{Grade.NOT_USABLE.value}: {why}" for copy, _frame, why in faults[::-1]}
            message = "; ".join(text for _copy, text in sorted((others | self.messages).items()))
        else:
            which, tolerance = copy if len(residual) > 1 else None, getattr(solver, "tolerance", None)
            why = min(faults, key=lambda fault: fault[1])[2] if faults else ""
            message = sentence(result, grade, np.fmax.reduce(distance), residual[copy], measure, unit, tolerance, which, why)
            message = "; ".join((message, *warnings)) if grade is not Grade.NOT_USABLE else message
        good, distance = int(self.good.max()), of_copies(distance)
        return Status(result, good, of_copies(residual), message, self.good, measure, unit, grade, distance, grades)
