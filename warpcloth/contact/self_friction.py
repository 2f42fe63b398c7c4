"""Friction of self-contact in the steps of a solver."""

import numpy as np
import warp as wp

from ..core.scan import Scan
from ..kernels.contact import friction_sweeps
from ..kernels.contact import self_friction as kernels
from ..kernels.contact.self_pairs import fill_corners, near_pairs, sort_corners
from .pair_sums import PairSums

# Rows of each array of a list, per pair of its capacity.
ROWS = {"stencils": 1, "corners": 4, "slips": 1}
LISTS = "stencils", "counts", "first", "corners"


def acting_sizes(model, room, corners=True):
    """Returns the sizes of the arrays of acting pairs in a :func:`warpcloth.kernels.contact.self_pairs.near_pairs`, by name."""
    sizes = {"acting": room, "number": 1}
    return sizes | {"corner_counts": model.count, "first": model.count + 1, "corners": 4 * room} if corners else sizes


class Slips:
    """Pairs of a step, and the stretch of the friction spring of each at its end, which the next step takes over.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        room: The number of pairs for which it allocates memory.

    Attributes:
        room: As given.
        pairs: A :func:`warpcloth.kernels.contact.self_pairs.near_pairs`, without distances.
        slips: (room,), see :func:`warpcloth.kernels.contact.self_friction.end_friction`.
        relisted: (B,) int32, 1 if pairs were listed again within the step.
        grow: A function that takes a number of pairs and allocates memory for them, by default for this object alone.
    """

    def __init__(self, model, room):
        self.model, self.grow, self._arrays = model, self.hold, {}
        for name, rows in (("counts", 2), ("first", model.count + 1), ("relisted", model.copies)):
            self._arrays[name] = wp.zeros(rows, dtype=wp.int32, device=model.device)
        self.hold(room)

    def hold(self, room):
        """Allocates memory for ``room`` pairs, and keeps the pairs that it has."""
        before, self.room = dict(self._arrays), room
        for (name, rows), dtype in zip(ROWS.items(), (wp.vec4i, wp.int32, wp.vec4d), strict=True):
            self._arrays[name] = wp.zeros(rows * room, dtype=dtype, device=self.model.device)
            if name in before:
                wp.copy(self._arrays[name], before[name], count=min(len(before[name]), rows * room))
        self.slips, self.relisted = self._arrays["slips"], self._arrays["relisted"]
        self.pairs = near_pairs(self.model.dtype)()
        for name in LISTS:
            setattr(self.pairs, name, self._arrays[name])

    def launch_lists(self, pairs, names):
        """Copies the arrays ``names`` of other pairs, which have the same capacity."""
        for name in names:
            wp.copy(getattr(self.pairs, name), getattr(pairs, name))

    # As a part of a state.

    def copy(self):
        """Returns an equal object with arrays of its own."""
        other = Slips(self.model, self.room)
        other.assign(self)
        return other

    def assign(self, other):
        """Copies the values of another object of the same model."""
        if other.room > self.room:
            self.grow(other.room)
        for name, array in other._arrays.items():
            wp.copy(self._arrays[name], array, count=len(array))

    def to_host(self):
        """Returns copies of the arrays, by name, without unused rows."""
        found = {name: array.numpy() for name, array in self._arrays.items()}
        count, corners = int(found["counts"].sum()), int(found["first"][-1])
        sizes = {"stencils": count, "slips": count, "corners": corners}
        return {name: np.array(values[: sizes.get(name, len(values))]) for name, values in found.items()}

    def from_host(self, values):
        """Sets everything to what :meth:`to_host` returned."""
        count = int(values["counts"].sum())
        if count > self.room:
            self.grow(count)
        for name, array in self._arrays.items():
            whole = array.numpy()
            whole[: len(values[name])] = values[name]
            array.assign(whole)


class SelfFriction(PairSums):
    """Friction between parts of cloth in contact, and the stretch of its springs, in the steps of one solver.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        slips: :class:`Slips`, a part of the state of the solver.
        steps: Steps since the start of each copy, (B,) int32.
        friction: μ.
        bounded: Whether contact has no logarithm, as in explicit steps.

    Attributes:
        pairs: The pairs of the step, a :func:`warpcloth.kernels.contact.self_pairs.near_pairs` without distances.
        rubbed: :class:`warpcloth.kernels.contact.self_friction.RubbedPairs`.
        start: Positions at the start of the step, (N,) [m].
    """

    def __init__(self, model, slips, steps, friction, bounded):
        super().__init__(model, kernels.FRICTION_OF_PAIRS, scatters=False)
        self._kept, self._steps, self._friction = slips, steps, friction
        self._bounded = bounded
        self.start, self._step, self._rubbing = model.vectors(), Slips(model, slips.room), None
        self._vertices = Scan(model, model.count)
        made = kernels.set_stretch, kernels.find_friction, kernels.end_friction, kernels.set_contact
        made += fill_corners, sort_corners
        self._kernels = {factory: model.kernel(factory, model.dtype) for factory in made}
        self._begin = model.kernel(kernels.begin_friction, model.dtype, bounded)
        self.hold(slips.room)

    def hold(self, room):
        """Allocates arrays for ``room`` pairs. The slips of the last step are kept."""
        self._kept.hold(room)
        self._step.hold(room)
        self.pairs = self._step.pairs
        for name in ("acting", "number", "corner_counts"):
            size = acting_sizes(self.model, room)[name]
            setattr(self.pairs, name, wp.zeros(size, dtype=wp.int32, device=self.model.device))

        def zeros(dtype):
            return wp.zeros(room, dtype=dtype, device=self.model.device)

        self.rubbed, self.found = kernels.RubbedPairs(), kernels.RubForces()
        self.rubbed.normal, self.rubbed.weights, self.rubbed.stretch = zeros(wp.vec3d), zeros(wp.vec4d), zeros(wp.vec3d)
        self.rubbed.stiffness, self.rubbed.limit, self.rubbed.contact = (zeros(wp.float64) for _ in range(3))
        self.found.normal, self.found.weights = self.rubbed.normal, self.rubbed.weights
        self.found.acting = self.rubbed.limit
        self.found.energy, self.found.along, self.found.across = (zeros(wp.float64) for _ in range(3))
        self.found.pull, self.found.direction = zeros(wp.vec3d), zeros(wp.vec3d)
        self.multipliers = zeros(wp.vec3d)
        if self._rubbing is not None:
            self._changes = zeros(wp.vec3d)

    def _launch(self, factory, dim, inputs, outputs):
        self.model.launch(self._kernels[factory], dim, inputs, outputs)

    def launch_begin(self, pairs, begun, x):
        """At the start of a step, at x: takes the listed pairs, their n, w and kA, and the slips of the last step."""
        model, kept = self.model, self._kept
        wp.copy(self.start, x)
        self._step.launch_lists(pairs, ("stencils", "counts"))
        self.pairs.number.zero_()
        self._step.relisted.zero_()
        given = [self.pairs, pairs, begun, kept.pairs, kept.slips, self._steps, kept.relisted, model.per_copy, self._friction]
        model.launch(self._begin, kept.room, given, [self.rubbed])
        self._vertices.launch(self.pairs.corner_counts, self.pairs.first)
        self._launch(fill_corners, kept.room, [], [self.pairs])
        self._launch(sort_corners, model.count, [], [self.pairs])
        given = [self.pairs, x, kept.pairs, kept.slips, self._steps, model.per_copy]
        self._launch(kernels.set_stretch, kept.room, given, [self.rubbed])
        if self._rubbing is not None:
            self._launch(friction_sweeps.count_rubbing, model.count, [self.pairs, self.rubbed], [self._rubbing])

    def launch_release(self):
        """Launches the removal of all slips, for a step without pairs."""
        self._kept.pairs.first.zero_()

    def launch_relisted(self, copies):
        """Notes in which ``copies``, (B,) int32, pairs or areas have changed within the step."""
        self.model.launch(kernels.note_relisted, self.model.copies, [copies], [self._step.relisted])

    def launch_contact(self, pairs, begun):
        """Takes kA from another list of pairs, which may have been made within the step."""
        wp.copy(self._kept.relisted, self._step.relisted)
        self._launch(kernels.set_contact, self._kept.room, [self.pairs, pairs, begun], [self.rubbed])

    def launch_forces(self, x, correction):
        """Finds the forces of each pair at x, or at x + correction. The methods below add them up."""
        given = [self.pairs, self.rubbed, self.start, x, correction]
        self._launch(kernels.find_friction, self._kept.room, given, [self.found])

    def launch_acting(self, x, out):
        """Sets out (N,) to ∂U/∂x where the step evaluated its forces: at its start if it is explicit, else at its end x."""
        self.launch_forces(self.start if self._bounded else x, None)
        out.zero_()
        self.add_gradient(out)

    def launch_end(self, x):
        """Stores the pairs of the step and the stretch of their springs at x, for the next step."""
        self._kept.slips.zero_()
        given = [self.pairs, self.rubbed, self.start, x]
        self._launch(kernels.end_friction, self._kept.room, given, [self._kept.slips])
        self._kept.launch_lists(self.pairs, LISTS)

    def rows(self):
        """Returns stencils, w, directions and second derivatives of the rows of all pairs with friction, two rows a pair."""
        count = min(int(self.pairs.counts.numpy().sum()), self._kept.room)
        rubs = np.flatnonzero(self.rubbed.limit.numpy()[:count])
        found = self.pairs.stencils, self.rubbed.weights, self.rubbed.normal, self.found.direction
        stencils, w, n, u = (array.numpy()[rubs] for array in found)
        still = ~u.any(axis=1)  # without stretch, any direction in the plane will do
        axis = np.eye(3)[np.abs(n).argmin(axis=1)]
        u = np.where(still[:, None], np.cross(n, axis), u)
        u /= np.linalg.norm(u, axis=1)[:, None]
        along, across = (array.numpy()[rubs] for array in (self.found.along, self.found.across))
        return (
            np.concatenate([stencils, stencils]),
            np.concatenate([w, w]),
            np.concatenate([u, np.cross(n, u)]),
            np.concatenate([along, across]),
        )

    def sweeps(self, in_turn):
        """Prepares sweeps for :meth:`launch_sweep`, as :meth:`warpcloth.contact.self_forces.SelfForces.sweeps` does."""
        model, key = self.model, (self.model.dtype, self.model.mobility is not None)
        if in_turn and model.device.is_cpu:
            self._sweep = model.kernel(friction_sweeps.sweep_friction, *key)
            return
        self._rubbing = wp.zeros(model.count, dtype=wp.float64, device=model.device)
        self._rub, self._move = (
            model.kernel(factory, *key) for factory in (friction_sweeps.rub_pairs, friction_sweeps.move_by_friction)
        )
        self._kernels[friction_sweeps.count_rubbing] = model.kernel(friction_sweeps.count_rubbing, model.dtype)
        self.hold(self._kept.room)

    def launch_sweep(self, x, correction, h, backward):
        model, mobility = self.model, self.model.local_mobility
        if self._rubbing is None:
            given = [self.pairs, mobility, self.rubbed, self.start, x, h, backward]
            model.launch(self._sweep, 1, given, [self.multipliers, correction])
            return
        given = [self.pairs, mobility, self.rubbed, self.start, x, correction, self._rubbing, h]
        model.launch(self._rub, self._kept.room, given, [self.multipliers, self._changes])
        model.launch(self._move, model.count, [self.pairs, mobility, self.rubbed, self._changes], [correction])
