"""The recorded history of a run: energies, work, and forces at pins and colliders in each frame."""

from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np
import warp as wp

import warpcloth.contact as contact

from ..base.checks import shown
from ..base.limits import MAX_FRAMES
from ..base.texts import numbered
from ..core.capture import Segment
from ..core.energy import Energy
from ..core.sums import Sums
from ..fast.plan import plan
from ..kernels import work as kernels
from ..kernels.terms.air import AIR
from ..model.damping import dissipations
from ..scene.scene import Scene
from ..terms.refresh import STEP, Moment
from .air_work import AirWork

RECORDS = ("energies", "reactions", "pairs")
# Numbers that record="pairs" has for each frame.
PAIRS = ("pairs in contact", "pairs listed", "new lists", "moves kept", "least gap")


def checked_record(record: Any, scene: Scene | None = None) -> tuple[str, ...]:
    """Returns the words of a record, each once, in the order of :data:`RECORDS`.

    Raises:
        ValueError: A word is unknown, or is "pairs" without a run or without self-contact.
    """
    words = (record,) if isinstance(record, str) else record if isinstance(record, Iterable) else (record,)
    words = tuple(words)
    for word in words:
        if word not in RECORDS:
            raise ValueError(f"record is {shown(word)}; it must be some of {', '.join(map(repr, RECORDS))}")
        if word == "pairs" and (scene is None or not scene.has_pairs):
            raise ValueError("record is 'pairs', which only runs of scenes with self_contact or mesh colliders have")
    return tuple(word for word in RECORDS if word in words)


def energy_names(scene: Scene) -> list[str]:
    """Returns the names of the energies and works that a run of a scene records."""
    of_terms, of_meshes = _names_of_contact(scene)
    return [*of_terms, *of_meshes.values(), *_other_names(scene)]


def _names_of_contact(scene):
    """Returns the labels of terms, contact and friction, numbered if equal: a list for terms, a dictionary for pairs with the
    mesh c, by (c, False) for contact and (c, True) for friction.
    """
    labels = [term.label for term in (*scene.terms, *scene.contact_terms)]
    of_meshes = {}
    for c in scene.meshes:
        of_meshes[c, False] = f"contact with {scene.colliders[c].label}"
        if c in scene.rubbing:
            of_meshes[c, True] = f"friction on {scene.colliders[c].label}"
    names = numbered([*labels, *of_meshes.values()], _other_names(scene))
    return names[: len(labels)], dict(zip(of_meshes, names[len(labels) :], strict=True))


def _other_names(scene):
    moved, filtered = any(collider.moves for collider in scene.colliders), len(scene.meshes) < len(scene.colliders)
    others = ["self-contact"] * (scene.self_contact is not None) + ["kinetic", "gravity"]
    others += ["work of pins"] * scene.pins.moves + ["work of loads"] * bool(scene.loads)
    others += ["work of air"] * bool(scene.air_terms)
    others += ["work of colliders"] * moved + ["work of the filter"] * filtered
    of_cloth = scene.self_contact is not None and scene.self_contact.friction > 0.0
    return others + ["heat of friction"] * (of_cloth or bool(scene.rubbing))


def collider_names(scene: Scene) -> list[str]:
    """Returns the names of the colliders of a scene: their labels, numbered if equal."""
    return numbered(collider.label for collider in scene.colliders)


class Evaluation:
    """Energies of a model and the forces at its pins and colliders, at any positions.

    Args:
        h: Step for damping [s], or None without motion.
        stepper: The stepper with the colliders and multipliers; None for colliders at their start and no hard terms.
        forces: Whether to compute forces.
        pairs: The :class:`warpcloth.contact.self_steps.SelfSteps`, if there is no stepper.

    Attributes:
        stored: Last U of all friction springs, (B,) [J].
        hidden: Whether some forces follow from multipliers.
        gradient: Last ∂U/∂x, (N,) [N].
        pulls: Its :class:`warpcloth.contact.present.ColliderPulls`, or None without colliders.

    Raises:
        ValueError: A term is hard and the solver has no multipliers.
    """

    def __init__(self, model, h=None, stepper=None, forces=True, pairs=None):
        self.model, self._h, self._pull, self.pulls = model, h, None, None
        self._pairs = pairs if stepper is None else stepper.pairs
        shares = [] if stepper is None or model.colliders is None else stepper.shares
        self._present = contact.PresentContact(model, [(share.colliders, first, end) for share, first, end in shares])
        terms = [(present, own) for present, own in zip(self._present.terms, model.terms, strict=True) if own.term is not AIR]
        self._terms = tuple(present for present, _own in terms)
        self._blown = tuple(own for own in model.terms if own.term is AIR)
        self.hidden = forces and stepper is not None and any(elements.hard for elements in model.terms)
        self._pins, self._held = model.in_model(model.scene.pins.vertices), model.scene.pins.held
        self._mass = model.mass.numpy().astype(np.float64).reshape(model.copies, -1)
        self._gravity = model.gravity.numpy().astype(np.float64)[:, None]
        self._start, self._energies, self.stored = self._host(model.positions), None, np.zeros(model.copies)
        self.names = energy_names(model.scene)
        of_terms, self._mesh_names = _names_of_contact(model.scene)
        self._term_names = list(zip(of_terms, (bool(own.term.law) for _present, own in terms), strict=True))
        if not forces:
            return
        self.gradient = model.vectors()
        if self.hidden:
            self._pull = stepper.constraint_forces()
        if model.colliders is not None:
            self.pulls = contact.ColliderPulls(model, self._terms, stepper and stepper.constraint_forces, self._pairs)
        soft = tuple(elements for elements in self._terms if not elements.hard and elements.collider is None)
        self._elastic = plan(model).gradient(terms=soft) if soft else None
        self._of_air = plan(model).gradient(terms=self._blown) if self._blown else None
        self._time = {"ahead": last_frame(model.scene)} if stepper is None else _time_of(stepper)
        self._still = model.vectors() if self._blown and h is None else None
        self._damped = dissipations(model, h) if h else []
        if self._damped:
            self._dissipative = plan(model).gradient(corrected=True, terms=self._damped)
            self._before, self._move = model.vectors(), model.vectors()
            self._back = model.kernel(kernels.step_back, model.dtype)
        self._add = model.kernel(kernels.add_scaled, model.dtype) if self.pulls else None

    def launch(self, x, v=None):
        """Launches ∂U/∂x at x, damping at v and forces of hard terms into ``gradient`` (N,) [N]."""
        model = self.model
        self.gradient.zero_()
        if self._pairs is not None:
            self._pairs.launch_present(x)
        if self.pulls:
            self._present.launch(x, v)
            self.pulls.launch(x)
            for c in self.pulls.solid if not self.pulls.hard else ():  # hard contact is among the hard terms
                model.launch(self._add, model.count, [self.pulls.found[c].all, 1.0], [self.gradient])
        if self._elastic:
            self._elastic.add(x, self.gradient)
        if self._of_air is not None:
            v_air, seconds = (v, self._h) if self._still is None else (self._still, 1.0)
            moment = Moment(x, v=v_air, he=seconds, explicit=True, **self._time)
            model.refresh(STEP, moment, self._blown)
            self._of_air.add(x, self.gradient)
        if self._damped:
            model.launch(self._back, model.count, [x, v, self._h], [self._before, self._move])
            model.refresh(STEP, Moment(self._before), self._damped)
            self._dissipative.add(self._before, self.gradient, self._move)
        if self._pairs is not None:
            self._pairs.forces.launch(x)
            self._pairs.forces.add_gradient(self.gradient)
        if self._pull:
            self._pull(self.gradient)

    def reactions(self):
        """Returns the forces of pins on the cloth along held axes, (B, p, 3) [N], after :meth:`launch`."""
        found = self._host(self.gradient)[:, self._pins] - self._mass[:, self._pins, None] * self._gravity
        if self.model.loads is not None:
            found -= self._host(self.model.loads.force)[:, self._pins]
        return np.where(self._held, found, 0.0)

    def energies(self, x, v=None):
        """Returns energies of terms, motion and gravity, and the work of constant loads, by name, (B,) [J].

        Gravity and loads count from the start.
        """
        model, found, self.stored = self.model, {}, np.zeros(self.model.copies)
        if self._energies is None:
            sums = Sums(model)
            self._energies = [None if each.hard else Energy(model, sums, terms=(each,)) for each in self._terms]
        self._present.launch(x, v)
        for (name, rubs), energy in zip(self._term_names, self._energies, strict=True):
            total = model.scalars()
            if energy is not None:  # hard terms store no energy
                energy.add(x, total)
            found[name] = total.numpy()
            if rubs:
                self.stored = self.stored + found[name]
        if self._pairs is not None:
            self._pairs.launch_present(x)
            found |= self._energies_of_pairs(x)
        moved = self._host(x) - self._start
        if v is not None:
            with np.errstate(over="ignore"):  # a copy may diverge
                found["kinetic"] = 0.5 * (self._mass * (self._host(v) ** 2).sum(axis=2)).sum(axis=1)
        found["gravity"] = -(self._mass * (moved * self._gravity).sum(axis=2)).sum(axis=1)
        if model.loads is not None and model.loads.constant is not None:
            found["work of loads"] = (model.loads.constant * moved).sum(axis=(1, 2))
        return found

    def _energies_of_pairs(self, x):
        """Returns the energies of the listed pairs at x by name, and adds to ``stored``."""
        model, pairs, found = self.model, self._pairs, {}
        of_cloth = [-1] if model.scene.self_contact is not None else []
        for c in (*of_cloth, *model.scene.meshes):
            total, stored, sums = model.scalars(), model.scalars(), Sums(model)
            pairs.forces.launch(x)
            if model.scene.meshes:
                pairs.keep(c)
            pairs.forces.add_energy(sums, total)
            pairs.forces.add_energy(sums, stored, stored=True)
            total, stored = total.numpy(), stored.numpy()
            self.stored = self.stored + stored
            if c < 0:
                found["self-contact"] = total
                continue
            found[self._mesh_names[c, False]] = total - stored
            if (c, True) in self._mesh_names:
                found[self._mesh_names[c, True]] = stored
        return found

    def kinetic_of_pins(self, v):
        """Returns ½Σ m v² of the pins along the axes that they hold, (B,) [J]."""
        v = np.where(self._held, self._host(v)[:, self._pins], 0.0)
        return 0.5 * (self._mass[:, self._pins] * (v**2).sum(axis=2)).sum(axis=1)

    def mask(self):
        """Returns vectors (N,): 1 along axes that pins hold, else 0."""
        found = np.zeros((*self._mass.shape, 3))
        found[:, self._pins] = self._held
        return self.model.array(found.reshape(-1, 3), self.model.vec3)

    def _host(self, array):
        return array.numpy().astype(np.float64).reshape(*self._mass.shape, 3)


def last_frame(scene: Scene) -> int:
    """Returns the frame of the wind at rest: its last keyframe, or the last frame if it is a function."""
    return MAX_FRAMES if scene.air is not None and scene.air.keyframes is not None else scene.frames


def _time_of(stepper):
    air = stepper.model.scene.air
    if air is None or not air.changes:
        return {}
    if len(stepper.shares) > 1:
        raise ValueError("record has forces, and wind changes in a batch that threads share; take threads=1")
    per_frame = stepper.steps_per_frame if stepper.integrator is None else stepper.integrator.moment.per_frame
    return {"steps": stepper.count, "per_frame": per_frame}


def _kept(name):
    def get(history):
        return np.array(history._rows[name])

    def keep(history, rows):
        history._rows[name] = list(rows)

    return property(get, keep)


class History:
    """Wraps a stepper and records energies and reactions after each frame.

    Steps are launched one by one if work is summed: of moving pins and colliders, of loads, of friction and of the filter. The
    bits of the frames stay the same.

    Args:
        record: Words of :data:`RECORDS`.

    Attributes:
        energies: Energies of each kept frame, (F, B, K) [J].
        reactions: Reactions of each kept frame, (F, B, p, 3) [N].
        forces: Total force and friction force on each collider in each kept frame, (F, B, C, 2, 3) [N].
        pairs: :data:`PAIRS` of each kept frame, (F, B, 5).
        cuts: Fraction of the moves that contact cut short in each kept frame, (F, B).
        find: Function that is called after each frame for ``found``, or None.
        totals: Work of pins (without their kinetic energy), loads, colliders, friction, filter and air up to the last kept
            frame, (6, B) [J].

    Raises:
        ValueError: A term is hard and the solver has no multipliers, or steps differ in length and work of contact or air is
            asked for.
    """

    energies, reactions, pairs, forces, cuts = map(_kept, (*RECORDS, "forces", "cuts"))

    def __init__(self, stepper, model, record):
        self._stepper, self.model, self._record, scene = stepper, model, record, model.scene
        changing = model.loads is not None and model.loads.constant is None
        rubbed, solid = bool(scene.rubbing), [collider for collider in scene.colliders if not collider.is_mesh]
        touched, asked = any(collider.friction or collider.moves for collider in solid), "energies" in record
        self._moving, self._driven, self._rubbed, self._touched = (
            asked and each for each in (scene.pins.moves, changing, rubbed, touched)
        )
        self._filtered, self._blown = asked and bool(solid), asked and bool(scene.air_terms)
        if asked and not stepper.even and (scene.colliders or scene.air_terms or scene.self_contact is not None):
            raise ValueError(
                "record is 'energies' of a scene with contact or air, whose work is summed over steps of one length; give dt "
                "or substeps in place of error"
            )
        forces = "reactions" in record or self._moving or self._touched
        self._evaluation = Evaluation(model, stepper.h, stepper, forces)
        self._found, self._frame, self.find, self.found = deque(), 0, None, None
        of_contact = ["forces"] * ("reactions" in record and bool(scene.colliders))
        of_contact += ["cuts"] * (bool(scene.colliders) or scene.self_contact is not None)
        self._rows = {name: [] for name in (*record, *of_contact)}
        self.carried = (*self._rows, "totals")  # from frame to frame
        self.names = self._evaluation.names
        self._total, self._each_step = np.zeros((6, model.copies)), None
        self._seen = self._counted()
        x, v = stepper.state
        rubs = asked and stepper.pairs is not None and stepper.pairs.friction is not None
        self._rubbed, self._of_pairs = self._rubbed or rubs, None
        pushes = rubs or (asked and any(scene.colliders[c].moves for c in scene.meshes))
        if self._moving or self._driven or self._filtered or self._blown or pushes:
            self._kinetic = self._evaluation.kinetic_of_pins(v)
            self._each_step = self._recorded_step(x, v)
            self._of_pairs = contact.PairWork(stepper, self._works[3]) if pushes else None
            self._room = None if stepper.pairs is None else stepper.pairs.capacities
        self._note()

    def _recorded_step(self, x, v):
        model, evaluation = self.model, self._evaluation
        self._before = before = kernels.past(model.dtype)()
        before.x, before.gradient, before.force = (model.vectors() for _ in range(3))
        self._works = [wp.zeros(model.count, dtype=wp.float64, device=model.device) for _ in range(5)]
        held, gradient = (evaluation.mask(), evaluation.gradient) if self._moving else (None, None)
        force, kernel = None if model.loads is None else model.loads.force, model.kernel(kernels.add_work, model.dtype)
        share = 0.5 if self._stepper.loads_at_end else 0.0
        self._touches = []
        for stepper, first, end in self._stepper.shares if self._filtered else ():
            vertices = slice(first * model.per_copy, end * model.per_copy)
            sums = [work[vertices] for work in self._works[2:]]
            stepper.follow_contact()
            cuts, touches, terms = contact.FilterWork(stepper, sums[-1]), None, stepper.model.terms
            if self._touched or not any(elements.hard and elements.collider is not None for elements in terms):
                touches = contact.ColliderWork(stepper.colliders, terms, cuts, *sums, stepper.constraint_forces)
            self._touches.append((cuts, touches, vertices))
        self._of_air = [AirWork(stepper) for stepper, _first, _end in (self._stepper.shares if self._blown else ())]

        def launch():
            for air in self._of_air:
                air.launch()
            for cuts, touches, _vertices in self._touches:
                cuts.launch()
                if touches:
                    touches.launch()
            if self._moving or self._driven:
                if self._moving:
                    evaluation.launch(x, v)
                given = [model.mass, model.gravity, held, x, gradient, force, model.per_copy, share]
                model.launch(kernel, model.count, given, [before, *self._works[:2]])

        return Segment(model.device, launch)

    def _begin(self):
        """Starts the sums from the present state, in each frame anew."""
        (x, v), loads, before = self._stepper.state, self.model.loads, self._before
        wp.copy(before.x, x)
        if loads is not None:
            loads.launch(self.model, Moment(x, ahead=self._frame))
            wp.copy(before.force, loads.force)
        if self._moving or self._touched:
            self._evaluation.launch(x, v)
            wp.copy(before.gradient, self._evaluation.gradient)
        for air in self._of_air:
            air.begin()
        for cuts, touches, vertices in self._touches:
            cuts.begin()
            if self._touched:
                touches.begin(self._evaluation.pulls.found, vertices)

    def __getattr__(self, name):
        return getattr(self._stepper, name)

    def frame(self):
        """Takes one frame of the stepper, and sums its work."""
        if self._each_step is None:
            self._stepper.frame()
            self._find()
        else:
            self._begin()
            for number, _ in enumerate(self._stepper.steps_of_frame(), start=1):
                if self._of_pairs is not None:
                    self._of_pairs.launch()
                if self._stepper.even and number == self._stepper.steps_per_frame:
                    self._find()
                self._make_room()
                self._each_step()
            for total, work in zip(self._total, self._works, strict=False):
                total += work.numpy().reshape(self.model.copies, -1).sum(axis=1)
                work.zero_()
            if not self._stepper.even:  # of a scene without contact
                self._find()
            if self._of_pairs is not None:
                self._total[2:4] += self._of_pairs.sums()
            if self._of_air:
                self._total[5] += np.concatenate([air.sums() for air in self._of_air])
            if self._touches:
                self._total[4] += np.concatenate([cuts.elastic() for cuts, _touches, _vertices in self._touches])
        self._frame += 1
        self._note()

    def _find(self):
        if self.find is not None:
            self.found = self.find()

    def _make_room(self):
        pairs = self._stepper.pairs
        if pairs is None:
            return
        pairs.launch_present(self._stepper.state.x)
        while pairs.overflowed:
            pairs.grow()
            self._stepper.record_again()
            pairs.launch_present(self._stepper.state.x)
        if self._each_step is not None and self._room != pairs.capacities:  # which steps enlarge too
            self._each_step, self._room = Segment(self.model.device, self._each_step.record), pairs.capacities

    def _note(self):
        self._make_room()
        evaluation, loads, (x, v), found = self._evaluation, self.model.loads, self._stepper.state, {}
        if "energies" in self._record:
            energies = evaluation.energies(x, v)
            if self._moving:
                energies["work of pins"] = self._total[0] + evaluation.kinetic_of_pins(v) - self._kinetic
            if self._driven:
                energies["work of loads"] = self._total[1].copy()
            energies["work of colliders"], energies["work of the filter"] = self._total[2].copy(), self._total[4].copy()
            energies["work of air"] = self._total[5].copy()
            if self._rubbed:
                energies["heat of friction"] = self._total[3] - evaluation.stored
            found["energies"] = np.stack([energies[name] for name in self.names], axis=-1)
        if "reactions" in self._record:
            if loads is not None:
                loads.launch(self.model, Moment(x, ahead=self._frame))
            evaluation.launch(x, v)
            found["reactions"] = evaluation.reactions()
            if evaluation.pulls:
                found["forces"] = evaluation.pulls.sums(self.model.copies)
            if evaluation.hidden and not self._frame:  # there are no multipliers before the first step
                for name in ("reactions", *["forces"] * bool(evaluation.pulls and evaluation.pulls.hard)):
                    found[name][:] = np.nan
        before, self._seen = self._seen, self._counted()
        if "cuts" in self._rows:
            found["cuts"] = self._seen[0] - before[0]
        if "pairs" in self._record:
            listed, touching, gap = self._stepper.pairs.in_frame()
            lists, kept = self._seen[1] - before[1], 1.0 - (self._seen[2] - before[2])
            found["pairs"] = np.stack([touching, listed, lists, kept, gap], axis=-1).astype(np.float64)
        self._found.append((found, self._total.copy()))

    def _counted(self):
        """Returns counts of contact so far, (B,) each: cuts times frames, lists of pairs, and cuts of their filter."""
        pairs, none = self._stepper.pairs, np.zeros(self.model.copies)
        of_pairs = (none, none) if pairs is None else (pairs.lists.numpy().copy(), pairs.share * self._frame)
        return self._stepper.cut * self._frame, *of_pairs

    def keep(self, alive):
        """Keeps and returns the values of the last frame by name, NaN for copies that are not ``alive`` (B,)."""
        found, self.totals = self._found.popleft()
        for name, values in found.items():
            values[~alive] = np.nan
            self._rows[name].append(values)
        return found

    def go_on(self):
        """Continues from the frame kept last, to which the stepper must be set."""
        self._found.clear()
        self._total, self._frame = np.array(self.totals), max(map(len, self._rows.values())) - 1
        self._seen = self._counted()

    def by_name(self):
        """Returns fields of the animation by name, with rows (F, …), or (F, B, …) with several copies."""
        one, found = self.model.copies == 1, {}
        rows = {name: getattr(self, name)[:, 0] if one else getattr(self, name) for name in self._rows}
        if "energies" in rows:
            found["energies"] = dict(zip(self.names, np.moveaxis(rows["energies"], -1, 0), strict=True))
        if "reactions" in rows:
            found["reactions"] = rows["reactions"]
        if "pairs" in rows:
            found["pairs"] = dict(zip(PAIRS, np.moveaxis(rows["pairs"], -1, 0), strict=True))
        if "forces" in rows:
            names = collider_names(self.model.scene)
            of_all, of_friction = np.moveaxis(rows["forces"], (-3, -2), (1, 0))
            found["collider_forces"] = dict(zip(names, of_all, strict=True))
            found["friction_forces"] = {names[c]: of_friction[c] for c in self.model.scene.rubbing}
        if "cuts" in rows:
            found["cuts"] = rows["cuts"]
        return found
