"""The base classes of bound solvers."""

import numpy as np
import warp as wp

import warpcloth.contact as contact

from ..base.turns import in_turn, methods_in_turn
from ..core.capture import Segment
from ..core.no_filter import filter_of
from ..core.reset import Reset
from ..core.state import Count, State
from ..kernels import step as kernels
from ..model.damping import damped_terms
from ..numerics.integrators import INTEGRATORS
from ..terms.refresh import STEP


class Stepper:
    """A solver bound to a model: all arrays are allocated, and ``step`` advances the state by one step.

    With an integrator, the constructor of a subclass ends with ``integrator.start()``, which may step.

    Attributes:
        state: The :class:`warpcloth.core.state.State`.
        h: Step [s].
        declared: The model as it was bound.
        model: The model of the steps: with damping, with contact that has rest states of its own, and in the order of sweeps.
        elements: The elements of ``model`` copy by copy, in the order of the scene.
        integrator: It computes x̃, and the new state from the minimiser; None for solvers without x̃.
        he: Effective step hₑ of the integrator [s], else h.
        colliders: :class:`warpcloth.contact.collider_steps.ColliderSteps`, or None if the scene has none.
        pairs: :class:`warpcloth.contact.self_steps.SelfSteps`, or None if contact has no pairs.
        results: The worst :class:`warpcloth.core.status.Result` of each copy so far, a list of B.
        residual: The largest residual of each copy so far, (B,); 0 for methods that have none.
        predicted: x̃ of the last step (N,) [m]; None for solvers without x̃.
        correction: d = x − x̃ of the minimiser in the last step (N,) [m], before contact changed it.
        unfiltered: Positions at the end of the last step before contact changed them (N,) [m]; None without contact.
        iterations: Number of iterations or sweeps of the last step; 1 for methods that do not iterate.
        even: Whether all steps have the same length.
        factorise_seconds: Time of the factorisation of constant matrices [s].
    """

    factorise_seconds = 0.0
    iterations = 1
    hard_pairs = False  # whether pairs of self-contact keep the contact distance as a constraint
    even = True
    uniform = False  # whether all steps have the same number of iterations
    predicted = correction = unfiltered = None

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        methods_in_turn(cls, "step", "frame", "prepare_frame", "reset")

    def __init__(self, options, model, integrator=None):
        fps = model.scene.fps
        self.options, self.declared = options, model
        self.steps_per_frame = options.per_frame(fps)
        self.h = 1.0 / (fps * self.steps_per_frame)
        self.state = State(*(model.motion or (wp.clone(model.positions), wp.clone(model.velocities))), model.copies)
        self.count = self.state.add("steps of keyframes", model.scalars(wp.int32) if model.timed else None, Count())
        self._reset = self._kept = self.colliders = self.pairs = self.integrator = None
        method = None if integrator is None else INTEGRATORS[integrator]
        self.he = self.h if method is None else method.share * self.h
        if model.colliders is not None:
            part = 0.0 if method is None else 1.0 / method.parts
            self.colliders = contact.ColliderSteps(model, self.state, self.h, self.steps_per_frame, part)
            model = model.with_terms(self.colliders.terms)
        if model.has_pairs:
            self.pairs = contact.SelfSteps(model, self.state, self.h, self.steps_per_frame, method is None, self.colliders)
            model = model.with_dynamic(self.pairs.forces.terms)
        if method is not None:
            model = model.with_terms(damped_terms(model, self.he))
        self.elements, self.model = model.terms, self.arranged(model)
        if method is not None:
            self.integrator = method(self)
            self.predicted = model.vectors()
            if self.colliders is not None or self.pairs is not None:
                self.unfiltered = model.vectors()

    def arranged(self, model):
        return model

    @property
    def filter(self):
        return filter_of(self.pairs)

    @property
    def results(self):
        return self.state.results

    @results.setter
    def results(self, results):
        self.state.results = results

    @property
    def residual(self):
        return self.state.residual

    @residual.setter
    def residual(self, residual):
        self.state.residual = residual

    @property
    def cut(self):
        """The fraction of the moves of free vertices that contact cut short so far, (B,)."""
        found = np.zeros(self.model.copies)
        for each in (self.colliders, self.pairs):
            if each is not None:
                found += each.share
        return found

    @property
    def inside(self):
        """The list of :meth:`warpcloth.contact.collider_steps.ColliderSteps.inside` for the steps so far."""
        return [] if self.colliders is None else self.colliders.inside()

    @property
    def x_before(self):
        """Positions at the start of the step, (N,) [m], or None without colliders."""
        return None if self.colliders is None else self.colliders.x_before

    def follow_contact(self):
        """Makes steps refresh contact, and keep their initial positions and the changes of the filter in :attr:`colliders`.

        Call it before reading these, and take steps one by one. The motion does not change.
        """
        self.colliders.note_pushes()
        self.colliders.follow()

    def launch_pins(self, parts=1):
        """Launches the move of pins by h/``parts``; all calls must have the same ``parts``."""
        self.launch_pins_of(*self.state, parts)

    def launch_pins_of(self, x, v, parts=1):
        """Launches the move of pins in x and v (N,), and counts the step."""
        model, count = self.model, self.count
        if model.pins is not None:
            move = model.kernel(kernels.move_pins, model.dtype)
            given = [model.pins, model.keyframes, model.pin_axes, count, parts * self.steps_per_frame, model.per_copy]
            model.launch(move, (model.copies, len(model.pins)), [*given, self.h / parts], [x, v])
        if count is not None:
            model.launch(model.kernel(kernels.count_step), model.copies, [], [count])

    @property
    def loads_at_end(self):
        """Whether steps evaluate loads at their end."""
        return self.integrator is not None and self.integrator.parts == 1

    @property
    def shares(self):
        """The steppers that share the batch, with their ranges of copies: (stepper, first, end)."""
        return [(self, 0, self.model.copies)]

    @property
    def takers(self):
        """The steppers that took the last step, as :attr:`shares`."""
        return self.shares

    def constraint_forces(self, collider=None):
        """Returns a function (array) that launches array (N,) −= f [N], the forces of hard terms in the last step.

        Args:
            collider: Index of the collider whose contact forces to take, or None for all hard terms.

        Raises:
            ValueError: The method has no multipliers.
        """
        raise ValueError(
            f"{type(self.options).__name__} has no multipliers, so the forces of terms with infinite stiffness and the "
            "reactions of pins are not known; take XPBD or ConstrainedDynamics, or a finite stiffness"
        )

    def launch_prediction(self):
        """Launches the start of a step: x = x̃, with pins at the end of the step."""
        self.model.refresh(STEP, self.integrator.moment)
        if self.pairs is not None:
            self.pairs.launch_begin(self.state.x)
        self.integrator.launch_prediction()
        if self.model.keyframes is not None:
            self.filter.launch_hold(*self.state, self.hard_pairs)
        if self.colliders is not None:
            self.colliders.launch_clear(self.model.terms, self.state.x)

    def launch_first(self, correction):
        """Launches the first d = x − x̃ of a step: 0, or as near to it as pairs stay apart."""
        self.filter.launch_start(self.state.x, correction)
        self.filter.launch_trial(self.state.x, correction)

    def launch_finish(self, correction):
        """Launches x and v at the end of the step, from x̃ and d = x − x̃ of the minimiser (N,) [m]."""
        self.correction = correction
        wp.copy(self.predicted, self.state.x)
        self.integrator.launch_finish(correction)
        if self.unfiltered is not None:
            wp.copy(self.unfiltered, self.state.x)
        if self.colliders is not None:
            self.colliders.correction, self.colliders.he = correction, self.he
            self.colliders.launch_end(*self.state, self.integrator.move)
        self.filter.launch_end(*self.state, self.integrator.move, self.integrator.parts)

    def launch_end_of(self, x, v):
        """Launches the end of an explicit step in x and v (N,): pins, and the filters."""
        self.launch_pins_of(x, v)
        if self.colliders is not None:
            self.colliders.launch_end(x, v)
        self.filter.launch_end(x, v)

    def take(self, steps):
        """Calls ``steps``, again from the same state with more memory while the list of pairs overflows."""
        if self.pairs is None:
            steps()
            return
        if self._kept is None:
            self._kept = self.state.copy()
        self._kept.assign(self.state)
        if self.pairs.stale:
            self.record_again()
            self.pairs.stale = False
        steps()
        while self.pairs.overflowed:
            self.state.assign(self._kept)
            self.pairs.grow()
            self.record_again()
            steps()

    def record_again(self):
        """Captures the launches of steps again, after the arrays of pairs changed."""
        raise NotImplementedError  # every solver that takes self-contact has its own

    def step(self):
        """Takes one step of h."""
        raise NotImplementedError  # every solver has its own

    def prepare_frame(self):
        """Captures the graphs of `frame`, in the main thread."""

    @in_turn
    def frame(self):
        """Takes the steps of one frame."""
        for _ in self.steps_of_frame():
            pass

    def steps_of_frame(self):
        """Takes the steps of one frame, and yields after each."""
        for _ in range(self.steps_per_frame):
            self.step()
            yield

    @in_turn
    def reset(self, mask=None, positions=None, velocities=None):
        """Resets copies to their start; they then repeat their first steps bit for bit. Other copies do not change.

        Keyframes, ``results`` and ``residual`` of these copies start again as well. Calls after the first allocate nothing. If
        all arguments are on the device and the solver has no residual, the host does not wait, unless positions are given with
        colliders.

        Arguments are Warp arrays, in the precision of the model if on the device, or anything that NumPy converts.

        Args:
            mask: Copies to reset, (B,) booleans; None for all.
            positions: Initial positions (B, n, 3) [m], by default those of the model; any finite values for other copies. Rest
                states that follow from the initial positions do not change, and vertices with keyframes start at these.
            velocities: Initial velocities (B, n, 3) [m/s]; those of pinned vertices are ignored.

        Raises:
            ValueError: An argument is not allowed, a free vertex of one of these copies would start inside a collider, or
                positions or velocities are given with ``integrator="bdf2"``.
        """
        if self._reset is None:
            self._reset = Reset(self)
        self._reset(mask, positions, velocities)


# Largest number of launches in a graph: each replay costs 0.9 µs, and each captured launch 100 µs.
LAUNCHES = 64


class LaunchedStepper(Stepper):
    """A solver whose steps consist of launches only, so that a frame is a few graphs.

    The constructor of a subclass ends with `record`, and with an integrator with ``integrator.start()``.
    """

    uniform = True

    def __init__(self, options, model, integrator="euler"):
        super().__init__(options, model, integrator)

    def record(self, *parts):
        """Captures a step.

        Args:
            parts: Pairs (function that launches, number of calls).
        """
        self.parts = [(launch, times) for launch, times in parts if times]
        self._record_step()

    def _record_step(self):
        launches = self.model.launches
        self._step, self._frame, self._size = [], None, 0
        for launch, times in self.parts:
            before = launches[0]
            self._step.append((Segment(self.model.device, launch), times))
            self._size += (launches[0] - before) * times

    def follow_contact(self):
        super().follow_contact()
        self._record_step()

    def launch_steps(self, steps):
        for _ in range(steps):
            for launch, times in self.parts:
                for _ in range(times):
                    launch()

    def _record_frame(self):
        """Returns the segments of a frame with the number of replays of each."""
        steps = self.steps_per_frame
        chunk = min(steps, LAUNCHES // max(self._size, 1))
        if chunk < 2:
            return self._step * steps
        graphs, rest = divmod(steps, chunk)
        frame = [(self._segment_of(chunk), graphs)]
        return frame + ([(self._segment_of(rest), 1)] if rest else [])

    def _segment_of(self, steps):
        return Segment(self.model.device, lambda: self.launch_steps(steps))

    def _replay(self, segments):
        for segment, times in segments:
            for _ in range(times):
                segment()
        self.note()

    def record_again(self):
        self._record_step()

    def step(self):
        self.take(lambda: self._replay(self._step))

    def prepare_frame(self):
        if self._frame is None:
            self._frame = self._record_frame()

    def frame(self):
        self.take(self._replay_frame)

    def _replay_frame(self):
        self.prepare_frame()
        self._replay(self._frame)

    def note(self):
        """Notes how the steps since the last call ended."""
