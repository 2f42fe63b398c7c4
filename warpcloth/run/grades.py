"""Grades a run: whether it converged, completed near its solution, or is not usable, from the errors of its steps."""

import numpy as np

from ..core.status import Grade, Result, digits, millimetres
from .flutter import flutter_of
from .step_errors import StepErrors

# A step has converged if no vertex is farther from its solution than NEAR times the edge and the contact distance. It is not
# usable if one is farther than FAR times the edge, so that the two ends of an edge may have changed places.
NEAR, FAR = 1e-3, 0.5
# Results with which a step may have converged: those of methods that found its solution, or have no tolerance.
_MAY_CONVERGE = Result.COMPLETED, Result.CONVERGED, Result.ROUNDED
# Why a copy is not usable, with the figure of the first frame in which that is so. A vertex in contact that is farther along
# its normal than the contact distance has no contact in the solution. What is not balanced in one frame alone may be an impact.
_WHY = (
    "in {frame} vertices are up to {length} from the solution of the step, more than half of an edge ({edge})",
    "in {frame} a vertex in contact is {times:.4g} contact distances along its normal from the solution of the step (limit 1)",
    "in {frames} at least half of a force of contact is not balanced, enough to end the contact in a step",
    "in {frame} cloth has {figure} J of motion, height and stored energy, {ratio}",
)


class Grades:
    """The grades of the copies of a run.

    Attributes:
        distance: The largest distance of a vertex from the solution of a step in a good frame, (B,) [m].
        first: For each reason why a copy is not usable, its first frame from 1, or 0, (4, B).
        figure: The figure of that frame, (4, B).
    """

    # What the grade depends on from frame to frame, besides what the errors carry.
    carried = ("first", "figure", "most", "distance", "gap", "solved", "ratio")

    def __init__(self, stepper, balance):
        model = self._model = stepper.model
        scene, self._balance = model.scene, balance
        lengths, contacts = scene.mesh.edge_lengths, (scene.contact, scene.self_contact)
        self._edge = float(np.median(lengths[lengths > 0.0])) if (lengths > 0.0).any() else np.inf
        self._resolved = min([self._edge, *(each.distance for each in contacts if each is not None)])
        self.errors = StepErrors(stepper, NEAR * self._resolved, FAR * self._edge)
        self.first, self.figure = np.zeros((len(_WHY), model.copies), dtype=int), np.zeros((len(_WHY), model.copies))
        self.flutter = flutter_of(stepper, balance.mass)
        self.distance, self.gap, self.most = (np.zeros(model.copies) for _ in range(3))
        self.solved, self.ratio = np.zeros(model.copies), np.zeros(model.copies)

    def note(self, number, frame, error, alive):
        """Notes the energy and the error of a frame, of the copies ``alive`` (B,)."""
        balance = self._balance
        if self.flutter is not None:
            self.flutter.note(number, frame.points, frame.velocities, alive)
        self.solved, self.ratio = error.solved, error.ratio
        self.distance, self.gap = np.where(alive, error.distance, self.distance), np.where(alive, error.gap, self.gap)
        converged = np.array([result in (Result.CONVERGED, Result.ROUNDED) for result in frame.results])
        surplus = balance.surplus(number, error, frame.velocities, converged)
        far = ~((self.distance <= FAR * self._edge) & np.isfinite(self.distance))
        wrong = far, self.gap > 1.0, error.unresolved, surplus > 1.0
        news = alive & (self.first == 0) & np.array(wrong)
        self.first = np.where(news, number, self.first)
        self.figure = np.where(news, np.array([self.distance, self.gap, error.unresolved, balance.whole]), self.figure)
        self.most = np.where(news[-1], balance.allowed, self.most)

    def go_on(self):
        """Continues from the values of a checkpoint, which were set here."""
        for name in ("distance", "solved", "ratio", "gap"):
            setattr(self.errors, name, getattr(self, name).copy())

    def faults(self, solver, result):
        """Returns the reasons why copies are not usable, a list of (copy, frame, sentence)."""
        rounded = self._model.numpy_dtype == np.float32 and result in (Result.ROUNDED, Result.STALLED)
        remedies = ['dtype="float64"'] * rounded + ["shorter steps"] + ["more iterations"] * hasattr(solver, "iterations")
        remedy, found = f"take {', '.join(remedies)} or another solver", []
        for (kind, copy), frame in np.ndenumerate(self.first):
            if frame:
                figure, of_copy = self.figure[kind, copy], f" of copy {copy}" if len(self.most) > 1 else ""
                given = {"frame": f"frame {frame}{of_copy}", "frames": f"frames {frame - 1} and {frame}{of_copy}"}
                given |= {"length": millimetres(figure), "edge": millimetres(self._edge), "times": figure}
                given["ratio"] = _compared(figure, self.most[copy])
                why = _WHY[kind].format(figure=digits(figure), **given)
                found.append((copy, int(frame), f"{why}; {remedy}"))
        return found + ([] if self.flutter is None else self.flutter.faults())

    def grade(self, copy, result, faults):
        """Returns the :class:`warpcloth.core.status.Grade` of a copy from its worst result and the :meth:`faults`."""
        if result in (Result.DIVERGED, Result.STOPPED) or any(fault[0] == copy for fault in faults):
            return Grade.NOT_USABLE
        results = _MAY_CONVERGE if self.errors.knows else _MAY_CONVERGE[1:]
        near = result in results and self.distance[copy] <= NEAR * self._resolved
        return Grade.CONVERGED if near else Grade.COMPLETED


def _compared(energy, most):
    if most <= 0.0:
        return "where it can have none"
    if energy < 2.0 * most:
        return f"{digits(100.0 * (energy / most - 1.0))} % more than it can have"
    return f"{digits(energy / most)} times what it can have"
