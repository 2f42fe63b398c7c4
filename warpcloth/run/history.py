"""The history of a run: energies, work and the reactions at pins, frame by frame, where they are asked for."""

from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np
import warp as wp

from ..base.checks import shown
from ..base.turns import in_turn
from ..core.capture import Segment
from ..core.energy import Energy
from ..core.sums import Sums
from ..fast.plan import plan
from ..kernels import work as kernels
from ..model.damping import dissipations
from ..scene.scene import Scene
from ..terms.refresh import STEP, Moment

RECORDS = ("energies", "reactions")


def checked_record(record: Any, scene: Scene) -> tuple[str, ...]:
    """Returns what to record, each word once, in the order of :data:`RECORDS`.

    Raises:
        ValueError: If a word is another, or the scene has colliders, whose work and reactions are not recorded.
    """
    words = (record,) if isinstance(record, str) else record if isinstance(record, Iterable) else (record,)
    words = tuple(words)
    for word in words:
        if word not in RECORDS:
            raise ValueError(f"record is {shown(word)}; it must be some of {', '.join(map(repr, RECORDS))}")
    if words and scene.colliders:
        raise ValueError(f"record is {shown(record)}; the work of colliders is not recorded yet, leave them or record out")
    return tuple(word for word in RECORDS if word in words)


def energy_names(scene):
    """Names of the energies and works that a run of a scene records; of terms their labels, numbered where one is taken."""
    others = ["kinetic", "gravity", *["work of pins"] * scene.pins.moves, *["work of loads"] * bool(scene.loads)]
    found = []
    for term in scene.terms:
        name, number = term.label, 1
        while name in found or name in others:
            number += 1
            name = f"{term.label} {number}"
        found.append(name)
    return found + others


class Evaluation:
    """Energies of a model and the forces of its pins, at any positions.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        h: Step over which damping is taken [s], or None without motion.
        pull: Function that adds the gradient of the forces of hard terms to an array (N,) [N], or None.
        forces: Whether it finds forces.
    """

    def __init__(self, model, h=None, pull=None, forces=True):
        self.model, self._h, self._pull = model, h, pull
        self._pins, self._held = model.in_model(model.scene.pins.vertices), model.scene.pins.held
        self._mass = model.mass.numpy().astype(np.float64).reshape(model.copies, -1)
        self._gravity = model.gravity.numpy().astype(np.float64)[:, None]
        self._start, self._energies = self._host(model.positions), None
        self.names = energy_names(model.scene)
        if not forces:
            return
        self.gradient = model.vectors()
        soft = tuple(elements for elements in model.terms if not elements.hard)
        self._elastic = plan(model).gradient(terms=soft) if soft else None
        self._damped = dissipations(model, h) if h else []
        if self._damped:
            self._dissipative = plan(model).gradient(corrected=True, terms=self._damped)
            self._before, self._move = model.vectors(), model.vectors()
            self._back = model.kernel(kernels.step_back, model.dtype)

    def launch(self, x, v=None):
        """Launches ∂U/∂x at x into ``gradient`` (N,) [N], with the damping at velocities v and the pull of hard terms."""
        model = self.model
        self.gradient.zero_()
        if self._elastic:
            self._elastic.add(x, self.gradient)
        if self._damped:
            model.launch(self._back, model.count, [x, v, self._h], [self._before, self._move])
            model.refresh(STEP, Moment(self._before), self._damped)
            self._dissipative.add(self._before, self.gradient, self._move)
        if self._pull:
            self._pull(self.gradient)

    def reactions(self):
        """The forces of the pins on the cloth along held axes, of the last :meth:`launch` and loads, (B, p, 3) [N]."""
        found = self._host(self.gradient)[:, self._pins] - self._mass[:, self._pins, None] * self._gravity
        if self.model.loads is not None:
            found -= self._host(self.model.loads.force)[:, self._pins]
        return np.where(self._held, found, 0.0)

    def energies(self, x, v=None):
        """U of each term, of motion, of gravity since the start, and work of constant loads since then, by name (B,) [J]."""
        model, found = self.model, {}
        if self._energies is None:
            sums = Sums(model)
            self._energies = [None if each.hard else Energy(model, sums, terms=(each,)) for each in model.terms]
        for label, energy in zip(self.names, self._energies, strict=False):  # those of terms are first
            total = model.scalars()
            if energy is not None:  # a hard term stores none
                energy.add(x, total)
            found[label] = np.array(total.numpy())
        moved = self._host(x) - self._start
        if v is not None:
            with np.errstate(over="ignore"):  # of a copy that diverges
                found["kinetic"] = 0.5 * (self._mass * (self._host(v) ** 2).sum(axis=2)).sum(axis=1)
        found["gravity"] = -(self._mass * (moved * self._gravity).sum(axis=2)).sum(axis=1)
        if model.loads is not None and model.loads.constant is not None:
            found["work of loads"] = (model.loads.constant * moved).sum(axis=(1, 2))
        return found

    def kinetic_of_pins(self, v):
        """½Σ m v² of the pins along the axes that they hold, (B,) [J]."""
        v = np.where(self._held, self._host(v)[:, self._pins], 0.0)
        return 0.5 * (self._mass[:, self._pins] * (v**2).sum(axis=2)).sum(axis=1)

    def mask(self):
        """1 along the axes that pins hold, 0 elsewhere, (N,) vectors."""
        found = np.zeros((*self._mass.shape, 3))
        found[:, self._pins] = self._held
        return self.model.array(found.reshape(-1, 3), self.model.vec3)

    def _host(self, array):
        return array.numpy().astype(np.float64).reshape(*self._mass.shape, 3)


class History:
    """Wraps a stepper and records energies and reactions after each frame, without changing its state.

    Work that depends on the path, that of moving pins and of loads that change or follow the cloth, is summed in every step,
    and steps are then launched one by one; frames stay equal to the bit. What holds or drives the cloth besides pins and loads,
    such as colliders, adds its reactions and its work in :meth:`_note`.

    Args:
        stepper: The :class:`warpcloth.solvers.solver.Stepper`.
        model: The model that it was bound to.
        record: What to find, of :data:`RECORDS`.

    Attributes:
        names: Names of the energies.
        energies: Of each frame that was kept, (F, B, K) [J].
        reactions: Of each frame that was kept, (F, B, p, 3) [N].
        totals: Work of pins, without their kinetic energy, and of loads in the last frame that was kept, (2, B) [J].

    Raises:
        ValueError: If a term is hard and the solver has no multipliers.
    """

    carried = ("energies", "reactions", "totals")  # from frame to frame

    @in_turn
    def __init__(self, stepper, model, record):
        self._stepper, self.model, self._record = stepper, model, record
        changing = model.loads is not None and model.loads.constant is None
        self._moving, self._driven = ("energies" in record and each for each in (model.scene.pins.moves, changing))
        forces = "reactions" in record or self._moving
        self._hidden = forces and any(elements.hard for elements in model.terms)
        self._evaluation = Evaluation(model, stepper.h, stepper.constraint_forces() if self._hidden else None, forces)
        self._found, self._rows, self._frame = deque(), {name: [] for name in RECORDS}, 0
        self.names = self._evaluation.names
        self._total, self._each_step = np.zeros((2, model.copies)), None
        x, v = stepper.state
        if self._moving or self._driven:
            self._kinetic = self._evaluation.kinetic_of_pins(v)
            self._each_step = self._recorded_step(x, v)
        self._note()

    def _recorded_step(self, x, v):
        """Allocates what is summed in every step, and records its launches."""
        model, evaluation = self.model, self._evaluation
        self._before = before = kernels.past(model.dtype)()
        before.x, before.gradient, before.force = (model.vectors() for _ in range(3))
        self._works = [wp.zeros(model.count, dtype=wp.float64, device=model.device) for _ in range(2)]
        held, gradient = (evaluation.mask(), evaluation.gradient) if self._moving else (None, None)
        force, kernel = None if model.loads is None else model.loads.force, model.kernel(kernels.add_work, model.dtype)
        share = 0.5 if self._stepper.loads_at_end else 0.0

        def launch():
            if self._moving:
                evaluation.launch(x, v)
            given = [model.mass, model.gravity, held, x, gradient, force, model.per_copy, share]
            model.launch(kernel, model.count, given, [before, *self._works])

        return Segment(model.device, launch)

    def _begin(self):
        """Begins to sum from the present state, in each frame anew, as a run does that goes on from there."""
        (x, v), loads, before = self._stepper.state, self.model.loads, self._before
        wp.copy(before.x, x)
        if loads is not None:
            loads.launch(self.model, Moment(x, ahead=self._frame))
            wp.copy(before.force, loads.force)
        if self._moving:
            self._evaluation.launch(x, v)
            wp.copy(before.gradient, self._evaluation.gradient)

    def __getattr__(self, name):
        return getattr(self._stepper, name)

    def frame(self):
        """One frame of the stepper, with its work."""
        if self._each_step is None:
            self._stepper.frame()
        else:
            self._begin()
            for _ in range(self._stepper.steps_per_frame):
                self._stepper.step()
                self._each_step()
            for total, work in zip(self._total, self._works, strict=True):
                total += work.numpy().reshape(self.model.copies, -1).sum(axis=1)
                work.zero_()
        self._frame += 1
        self._note()

    def _note(self):
        """Finds what is recorded of the present state."""
        evaluation, loads, (x, v), found = self._evaluation, self.model.loads, self._stepper.state, {}
        if "energies" in self._record:
            energies = evaluation.energies(x, v)
            if self._moving:
                energies["work of pins"] = self._total[0] + evaluation.kinetic_of_pins(v) - self._kinetic
            if self._driven:
                energies["work of loads"] = self._total[1].copy()
            found["energies"] = np.stack([energies[name] for name in self.names], axis=-1)
        if "reactions" in self._record:
            if loads is not None:
                loads.launch(self.model, Moment(x, ahead=self._frame))
            evaluation.launch(x, v)
            found["reactions"] = evaluation.reactions()
            if self._hidden and not self._frame:  # multipliers are those of a step
                found["reactions"][:] = np.nan
        self._found.append((found, self._total.copy()))

    def keep(self, alive):
        """Keeps what was found in the next frame, NaN in copies that are no longer ``alive`` (B,), and returns it by name."""
        found, self.totals = self._found.popleft()
        for name, values in found.items():
            values[~alive] = np.nan
            self._rows[name].append(values)
        return found

    def go_on(self):
        """Goes on from the frame kept last, to which the stepper was set."""
        self._found.clear()
        self._total, self._frame = np.array(self.totals), max(map(len, self._rows.values())) - 1

    def by_name(self):
        """Returns energies by name, (F,) or (F, B) [J], and reactions, (F, p, 3) or (F, B, p, 3) [N], or None."""
        one = self.model.copies == 1
        energies = np.moveaxis(self.energies, -1, 0) if "energies" in self._record else None
        reactions = self.reactions if "reactions" in self._record else None
        if energies is not None:
            energies = {name: row[:, 0] if one else row for name, row in zip(self.names, energies, strict=True)}
        return energies, reactions[:, 0] if one and reactions is not None else reactions

    @property
    def energies(self):
        return np.array(self._rows["energies"])

    @energies.setter
    def energies(self, rows):
        self._rows["energies"] = list(rows)

    @property
    def reactions(self):
        return np.array(self._rows["reactions"])

    @reactions.setter
    def reactions(self, rows):
        self._rows["reactions"] = list(rows)
