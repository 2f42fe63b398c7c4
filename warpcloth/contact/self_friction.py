"""Friction of self-contact in the steps of a solver."""

import numpy as np
import warp as wp

from ..core.dynamic_elements import DynamicElements
from ..core.filled import filled
from ..kernels.contact import self_friction as kernels
from ..kernels.pairs import Pairs


class Slips:
    """Contacts of a step, and the stretch of the friction spring of each at its end, for the next step.

    Attributes:
        room: The number of contacts that fit.
        pairs: :class:`warpcloth.kernels.pairs.Pairs` with ``first``, ``stencils`` and ``corners``.
        slips: (room,), see :func:`warpcloth.kernels.contact.self_friction.end_friction`.
        grow: A function that allocates memory for a number of contacts.
    """

    def __init__(self, model, room):
        self.model, self.grow, self._arrays = model, self.hold, {}
        self.hold(room)

    def hold(self, room):
        """Allocates memory for ``room`` contacts, and keeps those that it has."""
        before, self.room = self.to_host() if self._arrays else {}, room
        lists = {"first": (self.model.count + 1, wp.int32), "stencils": (room, wp.vec4i), "corners": (4 * room, wp.int32)}
        lists = {name: wp.zeros(size, dtype=kind, device=self.model.device) for name, (size, kind) in lists.items()}
        self.slips = wp.zeros(room, dtype=kernels.SLIP, device=self.model.device)
        self.pairs, self._arrays = filled(Pairs, **lists), lists | {"slips": self.slips}
        self._write(before)

    # As a part of a state.

    def copy(self):
        other = Slips(self.model, self.room)
        other.assign(self)
        return other

    def assign(self, other):
        if other.room == self.room:
            for name, array in other._arrays.items():
                wp.copy(self._arrays[name], array)
        else:
            self.from_host(other.to_host())

    def to_host(self):
        """Returns copies of the arrays, by name, without empty slots, contacts in the order of ``corners``."""
        found = {name: array.numpy() for name, array in self._arrays.items()}
        slots, corners = np.divmod(found["corners"][: found["first"][-1]], 4)
        used, at, slots = np.unique(slots, return_index=True, return_inverse=True)
        used, ranks = used[np.argsort(at)], np.argsort(np.argsort(at))
        found |= {name: found[name][used] for name in ("stencils", "slips")}
        return found | {"first": np.array(found["first"]), "corners": (4 * ranks[slots] + corners).astype(np.int32)}

    def from_host(self, values):
        if len(values["slips"]) > self.room:
            self.grow(len(values["slips"]))
        self._write(values)

    def _write(self, values):
        for name, rows in values.items():
            whole = self._arrays[name].numpy()
            whole[: len(rows)] = rows
            self._arrays[name].assign(whole)


class SelfFriction(DynamicElements):
    """Friction between parts of cloth in contact.

    Args:
        keys: Number of keys that contacts may have.
        steps: Steps since the start of each copy, (B,) int32.
        friction: μ of cloth with cloth, then that of each obstacle of a copy, (1 + m,).
        bounded: Whether contact has no logarithm, as in explicit steps.
        ahead: The fraction of the step after which it evaluates forces.

    Attributes:
        start: Positions at the start of the step, (V,) [m].
    """

    stored = True

    def __init__(self, surface, slips, keys, steps, law, friction, bounded, ahead):
        self.surface = surface
        model = surface.model
        super().__init__(model, kernels.friction_of_pairs(law), wp.zeros(1, dtype=wp.int32, device=model.device))
        self._kept, self._steps, self._ahead = slips, steps, ahead
        first, vertices = (wp.array(each, dtype=wp.int32, device=model.device) for each in surface.rings())
        self._rings, self._moves = filled(kernels.Rings, first=first, vertices=vertices), None
        if surface.moves:
            self._moves = surface.moves_of_step
        self._friction = wp.array(friction, dtype=wp.float64, device=model.device)
        self.start = surface.vectors()
        self._launch = model.launcher(
            ((kernels.end_friction,), model.dtype),
            ((kernels.set_anchors, kernels.find_friction), model.dtype, law),
            ((kernels.begin_friction,), model.dtype, law, bounded),
        )
        self.hold(slips.room, keys)

    def hold(self, room, keys):
        """Allocates arrays for ``room`` pairs, whose keys are below ``keys``. Slips are kept."""
        self._kept.hold(room)
        kinds = {"parts": wp.vec4i, "weights": wp.vec4d, "sides": wp.int32, "normal": wp.vec3d, "anchor": wp.vec3d}
        kinds |= {"stiffness": wp.float64, "limit": wp.float64} | ({"travel": wp.vec3d} if self.surface.obstacles else {})
        arrays = {name: wp.zeros(room, dtype=kind, device=self.model.device) for name, kind in kinds.items()}
        data = filled(kernels.RubbedPairs, ahead=self._ahead, **arrays)
        self.hold_pairs(self.new_pairs(room, keys, self.surface.layout), data)

    def launch_begin(self, touching, contacts, x):
        """Takes the contacts at the start of a step, at x (V,), and the slips of the last step."""
        kept = self._kept
        self.present.fill_(1)
        wp.copy(self.start, x)
        super().launch_none()
        given = [touching, contacts, x, self._moves, self._rings, self._friction]
        self._launch(kernels.begin_friction, self.pairs.threads, given, [self.pairs, self.data])
        self.launch_corners()
        given = [self.pairs, x, kept.pairs, kept.slips, self._steps]
        self._launch(kernels.set_anchors, self.pairs.threads, given, [self.data])

    def launch_none(self):
        super().launch_none()
        self.present.zero_()
        self._kept.pairs.first.zero_()

    def launch_forces(self, x, correction):
        self._launch(kernels.find_friction, self.pairs.threads, [self.pairs, self.data, x, correction], [self.forces])

    def launch_acting(self, x, out):
        """Sets out (N,) to ∂U/∂x at the x (N,) of the last forces."""
        self.launch(x)
        out.zero_()
        self.add_gradient(out)

    def launch_end(self, x):
        """Stores the pairs of the step and the stretch of their springs at x."""
        kept = self._kept
        given = [self.pairs, self.data, self.start, self._moves, x, self._rings]
        self._launch(kernels.end_friction, self.pairs.threads, given, [kept.pairs, kept.slips])
        wp.copy(kept.pairs.first, self.pairs.first)
