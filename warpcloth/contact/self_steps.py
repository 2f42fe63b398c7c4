"""Self-contact in the steps of a solver."""

from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import warp as wp

from ..core.capture import Mirror
from ..core.dynamic import Dynamic
from ..core.filled import filled
from ..core.state import Count
from ..core.status import Stopped
from ..core.sums import Sums
from ..kernels.contact import gap_notes, self_pairs
from ..kernels.contact.mesh_forces import keep_forces, work_of_meshes
from ..kernels.contact.pair_potential import Laws
from ..kernels.contact.piece_motion import add_positions
from ..kernels.contact.self_filter import HeldPins, copies_with_pairs
from ..kernels.pairs import Pairs
from ..kernels.terms.contact import FLOOR
from ..mesh.mesh import areas_of
from .collider_steps import cut_share
from .pair_contact import PairContact
from .proximity import Proximity
from .self_filter import SelfFilter
from .self_friction import SelfFriction, Slips
from .self_start import check_reset, check_start
from .surface import ContactSurface

# The skin, over the longest edge of the rest shape. All pairs nearer than the contact distance plus the skin are listed. At the
# start of a run it must exceed 0.29: an edge that passes through a triangle with sides of at most 1 is nearer than this to one
# of them.
SKIN = 0.35
FLAT = 0.9  # lists have no neighbours in cloth that is flat until it is shorter than this, over its rest length
THICK = 0.5  # the smallest skin, over the contact distance; see ``kept`` of :class:`.proximity.Proximity`


def skin_of(mesh, distance, largest):
    """Returns the skin [m] for a contact distance of cloth with itself, and the largest one with anything [m].

    Elements at the height H of a triangle from one another are listed if they are nearer than min(r, H/2) and the skin.
    """
    skin = SKIN * mesh.edge_lengths.max()
    if len(mesh.triangles):
        corners = mesh.points[mesh.triangles]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        height = np.median(2.0 * areas_of(mesh.points, mesh.triangles) / sides)
        skin = min(skin, FLAT * height - min(distance, 0.5 * height))
    return float(max(skin, THICK * largest))


class FirstGap(NamedTuple):
    """The first frame with a small gap in a copy, and a vertex of the pair."""

    copy: int
    frame: int
    vertex: int


class PinHeld(NamedTuple):
    """The first pin that the filter stopped, and its frame; ``farthest`` is the largest distance from its target [m]."""

    copy: int
    frame: int
    vertex: int
    farthest: float


class SelfSteps:
    """Pairs of near parts of cloth in the steps of one solver, with their forces and the filter.

    :meth:`launch_begin` lists near pairs at the start of a step. Contacts are found wherever forces are computed. At the end,
    the filter keeps pairs apart.

    Args:
        state: The state of the solver, to which arrays are added.
        h: Time step [s].
        bounded: Whether contact has no logarithm, as in explicit steps.

    Attributes:
        distance, max_distance: The smaller and the larger contact distance of cloth with itself and with meshes [m].
        least: The least gap of the filter [m].
        placed: Positions of meshes at the start of the step, where it evaluates forces, and at its end, (B·m,) [m].
        forces: The :class:`.Dynamic` of ``contact`` and ``friction``, which may be None.
        pairs, begun: The listed pairs, and their gaps at ``begun_at`` (V,).
        x_before: Positions at the start of the step, or of an iterate, with the obstacles behind them, (V,) [m].
        near: The result of :meth:`.SelfFilter.launch_look`, a mirror of (1,) int32.
        lists, most_listed: The number of lists so far, and the largest number of pairs in one, (B,) int32.
        listed, with_pairs: 1 if the last list has pairs, (1,) int32; and for each copy at the start of the step, (B,).
        far: 1 if unlisted pairs may meet on the way of the last :meth:`launch_far`, (1,) int32.
        stale: Whether lists have grown outside of steps, so that graphs must be recorded again.
    """

    def __init__(self, model, state, h, steps_per_frame, bounded, colliders):
        scene, device = model.scene, model.device
        declared = [scene.self_contact, scene.contact if model.colliders is not None and model.colliders.meshes else None]
        self.model, self.h, self._colliders = model, h, colliders
        self.surface = surface = ContactSurface(model, scene.self_contact is not None)
        distances, stiffnesses = (
            [(each and getattr(each, name)) or 0.0 for each in declared] for name in ("distance", "stiffness")
        )
        self.distance, self.max_distance = min(filter(None, distances)), max(distances)
        self.least, self.per_frame = FLOOR * self.distance, steps_per_frame
        self._laws = filled(Laws, distance=wp.vec2d(*distances), stiffness=wp.vec2d(*stiffnesses), width=surface.width)
        self.skin = skin_of(scene.mesh, distances[0], self.max_distance)
        self.proximity = Proximity(surface, distances[0], self.skin, distances[1])
        self.x_before, self.begun_at = surface.vectors(), surface.vectors()
        self.cut = state.add("vertices kept apart", model.scalars(wp.int64), Count(sums=True))
        self.steps = state.add("steps of self-contact", model.scalars(wp.int32), Count())
        self.most_listed = state.add("most pairs", model.scalars(wp.int32))
        self._most = Mirror(self.most_listed)
        self.lists = state.add("lists of pairs", model.scalars(wp.int32))
        self.listed, self.far = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))
        self.with_pairs = model.scalars(wp.int32)
        notes = {
            "nearest": state.add("nearest", model.scalars(wp.float64)),
            "too_near": state.add("first too near", model.scalars(wp.int64)),
            "pressed": state.add("first pressed", wp.zeros((model.copies, 2), dtype=wp.int64, device=device)),
            "unresolved": state.add("first unresolved", model.scalars(wp.int64)),
        }
        self._notes = filled(gap_notes.GapNotes, **notes)
        self.held = filled(HeldPins, steps=self.steps, per_copy=model.per_copy)
        self.held.first = state.add("first pin held back", model.scalars(wp.int64), Count(rest=model.per_copy))
        self.first_forced = state.add("first mesh that went through cloth", model.scalars(wp.int64))
        self.held.farthest = state.add("farthest pin held back", model.scalars(wp.float64))
        self._launch = model.launcher(((self_pairs.begin_pairs, gap_notes.note_gaps, add_positions), model.dtype))
        self.placed, self._ahead = [None, None, None], 0 if colliders is None else int(np.ceil(2.0 * colliders.part))
        self.contact = PairContact(surface, bounded, self._laws, self.listed)
        if surface.obstacles:
            self._prepare_obstacles()
        self.filter = SelfFilter(self, colliders)
        self.friction, self.stale = None, False
        self._make_room(state.x)
        self._hold()
        state.add("positions of the list", self.proximity.found)
        self.near = Mirror(wp.zeros(1, dtype=wp.int32, device=device))
        self._carried = self.proximity.found, self.most_listed, self.lists, *notes.values()
        friction = surface.friction()
        if friction is not None:
            slips = state.add_part("friction", Slips(model, self.contact.capacity))
            slips.grow = self._grow_outside
            ahead = 1.0 if colliders is None else colliders.part
            self.friction = SelfFriction(surface, slips, self._keys, self.steps, *friction, bounded, ahead)
        if not bounded:
            self.filter.iterates()
            self.contact.follow(self.filter.launch_meshes, self.filter.launch_follow, self.x_before)
        self.forces = Dynamic(model, [self.contact, *([self.friction] if self.friction else [])])
        check_start(self, state)
        self.start_again()

    def refuse_reset(self, mask, x):
        """Makes :func:`.self_start.check_reset`; returns whether graphs must be recorded again."""
        before = self.capacities
        check_reset(self, mask, x)
        return self.capacities != before

    def at_start(self):
        """Returns U [J] at the start, and the number of pairs that touch times ½Σ(r − d)² [m²], both (B,)."""
        x, energy = self.model.positions, self.model.scalars()
        with self.looking():
            self.launch_begin(x)
        self.forces.launch(x)
        self.forces.add_energy(Sums(self.model), energy)
        touching = self.contact.pairs
        number = touching.number.numpy()[0]
        copies = touching.stencils.numpy()[:number, 0] // self.model.per_copy
        distance, gap = (array.numpy()[:number] for array in (self.contact.data.distance, self.contact.data.gap))
        open_by = np.maximum(distance - gap, 0.0)
        touching, squares = (np.bincount(copies, each, self.model.copies) for each in (open_by > 0.0, open_by**2))
        return energy.numpy(), 0.5 * touching * squares

    @contextmanager
    def looking(self):
        kept = [wp.clone(array) for array in self._carried]
        try:
            yield
        finally:
            for array, before in zip(self._carried, kept, strict=True):
                wp.copy(array, before)

    def _make_room(self, x):
        wp.copy(self.x_before, x, count=self.model.count)
        self.proximity.launch(self.x_before)
        if self.proximity.overflowed:
            self.proximity.grow()
        self.proximity.set_skin(self.skin)  # so that the first step makes a list

    def _hold(self):
        found, device = self.proximity, self.model.device
        capacity = len(found.stencils)

        def room(dtype):
            return wp.zeros(capacity, dtype=dtype, device=device)

        lists = {name: getattr(found, name) for name in ("stencils", "counts", "rows", "distances")}
        threads = 1 if device.is_cpu else capacity
        self.pairs = filled(Pairs, layout=self.surface.layout, threads=threads, **lists)
        self.begun = filled(self_pairs.StepPairs, normal=room(wp.vec3d), weights=room(wp.vec4d), gap=room(wp.float64))
        self.contact.hold(self.pairs, self.begun.normal)

    @property
    def _keys(self):
        return 2 * len(self.pairs.stencils)

    @property
    def capacities(self):
        return len(self.pairs.stencils), self.contact.capacity

    def grow(self):
        """Makes room for pairs and contacts that did not fit. Graphs must then be recorded again.

        Raises:
            Stopped: There is not enough memory.
        """
        try:
            self.grow_to(*self._wanted)
        except ValueError as error:
            raise Stopped(str(error)) from None

    def grow_to(self, pairs, contacts=0):
        if pairs > len(self.pairs.stencils):
            self.proximity.grow(pairs)
        if contacts > self.contact.capacity:
            self.contact.slots = int(1.5 * contacts)
        self._hold()
        if self.friction is not None:
            self.friction.hold(self.contact.capacity, self._keys)

    def _grow_outside(self, contacts):
        self.grow_to(0, contacts)
        self.stale = True

    @property
    def overflowed(self):
        """Whether more pairs or contacts were found than fit; waits for the device."""
        most = self.most, int(self.contact.most.read()[0])
        if any(found > room for found, room in zip(most, self.capacities, strict=True)):
            self._wanted = most  # the state, with the first number, may be put back before the lists grow
            return True
        return False

    @property
    def share(self):
        return cut_share(self.model, self.cut, self.steps)

    @property
    def most(self):
        return int(self._most.read().max())

    @property
    def least_gap(self):
        """The smallest distance of a pair in any frame, (B,) [m]; infinite without pairs."""
        return _gaps(self._notes.nearest)

    @property
    def too_near(self):
        """A :class:`FirstGap` for each copy with a gap below 4 units in the last place of float32."""
        return self._first(self._notes.too_near.numpy())

    @property
    def pressed(self):
        """:class:`FirstGap` of cloth nearer to cloth, and to meshes, than half the distance where contact begins.

        Explicit steps note none of meshes.
        """
        notes = self._notes.pressed.numpy()
        return self._first(notes[:, 0]), self._first(notes[:, 1])

    @property
    def unresolved(self):
        """A :class:`FirstGap` for each copy in which rounding stops a pair where its contact begins."""
        return self._first(self._notes.unresolved.numpy())

    def _first(self, notes):
        n, found = self.model.per_copy, enumerate(notes)
        return [FirstGap(copy, *divmod(int(gap_notes.FIRST) - int(value), n)) for copy, value in found if value]

    @property
    def pins_held(self):
        """A :class:`PinHeld` for each copy in which cloth has held back a pin."""
        found, n, farthest = [], self.model.per_copy, self.held.farthest.numpy()
        for copy, value in enumerate(self.held.first.numpy()):
            if value:
                step, vertex = divmod(int(gap_notes.FIRST) - int(value), n)
                found.append(PinHeld(copy, step // self.per_frame + 1, vertex, float(farthest[copy])))
        return found

    def in_frame(self):
        """Returns the pairs listed, the pairs in contact and the least gap [m] at the start of the last step, each (B,)."""
        counts = wp.zeros((self.model.copies, 2), dtype=wp.int32, device=self.model.device)
        notes = filled(gap_notes.GapNotes, nearest=self.model.scalars(), counts=counts)
        self._launch_notes(self.begun_at, 1, notes)
        return *counts.numpy().T, _gaps(notes.nearest)

    def start_again(self):
        for array in (self.cut, self.steps, self.held.first, self.held.farthest, self.first_forced, *self._carried):
            array.zero_()

    def launch_begin(self, x):
        """Lists the pairs near x (N,) at the start of a step, unless the last list serves."""
        wp.copy(self.x_before, x, count=self.model.count)
        if self.surface.moves:
            if not self._colliders.moved_by_terms:
                self._colliders.launch_start(x)
            self._launch_obstacles()
        elif self.surface.obstacles and not self._colliders.moved_by_terms:
            wp.copy(self._colliders.x_before, x)
        x = self.x_before
        self.filter.launch_begin()
        self.proximity.launch_kept(x, self.launch_list)
        wp.capture_if(self.listed, self._launch_begin, self._launch_none, x=x)

    def _launch_none(self, x):
        wp.copy(self.begun_at, x)
        for each in self.forces.terms:
            each.launch_none()

    def _launch_begin(self, x):
        self.with_pairs.zero_()
        self.model.launch(copies_with_pairs, len(self.pairs.stencils), [self.pairs], [self.with_pairs])
        self.launch_sides(x)
        self._launch_notes(x, self.per_frame, self._notes)
        if self.friction is not None:
            self.contact.launch_rows(x)
            self.friction.launch_begin(self.contact.pairs, self.contact.data, x)

    def launch_far(self, end, p):
        """Sets ``far`` to 0 if unlisted pairs stay apart on the way from ``x_before`` by p (N,) to ``end`` (V,)."""
        self.far.zero_()
        self.proximity.launch_moved_since(end, 0.5, None, self.far)
        wp.capture_if(self.far, self.proximity.launch_apart, x=self.x_before, p=p, far=self.far)

    # Obstacles.

    def _prepare_obstacles(self):
        surface, model = self.surface, self.model
        self.placed = [wp.zeros(surface.count - model.count, dtype=model.vec3, device=model.device) for _ in range(3)]
        self._kept_poses = [wp.zeros_like(self._colliders.poses.before) for _ in range(3)]
        self._colliders.launch_move()
        self._launch_obstacles()

    def _launch_obstacles(self):
        self.surface.launch_positions(self._colliders, self._ahead, self.placed)
        wp.copy(self.surface.behind(self.x_before), self.placed[0])
        self.contact.launch_obstacles(self.placed[1])

    def keep(self, collider):
        """Leaves only forces and energies of contact with the mesh of this index, or −1 for cloth."""
        surface = self.surface
        if not surface.obstacles:
            return
        for each in self.forces.terms:
            given = [each.pairs, each.data.parts, surface.of_obstacles.collider, collider]
            self.model.launch(keep_forces, each.capacity, given, [each.forces])

    def launch_present(self, x):
        """Lists pairs and contacts at x (N,), with meshes at the end of the last step; poses do not change."""
        if not self.surface.moves:
            self.launch_begin(x)
            self.contact.launch_rows(x)
            return
        poses = self._colliders.poses
        kept = list(zip(self._kept_poses, (poses.before, poses.at, poses.after), strict=True))
        for spare, array in kept:
            wp.copy(spare, array)
        self._colliders.launch_move()
        self.launch_begin(x)
        self.contact.launch_obstacles(self.placed[0])
        self.contact.launch_rows(x)
        if self.friction is not None:
            self.friction.data.travel.zero_()
        for spare, array in kept:
            wp.copy(array, spare)

    def launch_work(self, out, terms):
        """Launches out (B, C) += the work of meshes on the cloth in the last step [J]."""
        for each in terms if self.surface.obstacles else ():
            given = [each.pairs, each.data.parts, self.surface.of_obstacles.collider, each.data.travel, each.forces]
            self.model.launch(work_of_meshes, 1, given, [out])

    @property
    def forced(self):
        """Copies in which a mesh went through cloth: (copy, first frame, mesh, or None if several move)."""
        moving = [c for c, each in enumerate(self.model.scene.colliders) if each.is_mesh and each.moves]
        mesh = moving[0] if len(moving) == 1 else None
        return [(c, int(gap_notes.FIRST) - int(note), mesh) for c, note in enumerate(self.first_forced.numpy()) if note]

    def _launch_notes(self, x, per_frame, notes):
        given = [self.pairs, self.begun, x, self.steps, self._laws, per_frame, self.contact.least]
        self._launch(gap_notes.note_gaps, len(self.pairs.stencils), given, [notes])

    def launch_begin_at_start(self, x, longest):
        """Lists all pairs near x (N,) at the start of a run, with edges up to ``longest`` [m], and makes room."""
        self.proximity.set_skin(max(self.skin, SKIN * longest))
        if self.surface.moves:
            self._colliders.launch_move()
        self.launch_begin(x)
        self.contact.launch_rows(x)
        while self.overflowed:
            self.grow()
            self.launch_begin(x)
            self.contact.launch_rows(x)
        self.proximity.set_skin(self.skin)

    def launch_list(self, x):
        """Lists the pairs again at x, in copies that have moved; counts a list if one has."""
        self.proximity.launch_moved(x)
        given = [self.proximity.counts, self.proximity.flag]
        self.model.launch(self_pairs.note_list, self.model.copies, given, [self.most_listed, self.lists, self.listed])

    def launch_sides(self, x, copies=None):
        """Computes the side and the gap of each listed pair: in ``copies`` at x, in others where the last call did."""
        if copies is None:
            wp.copy(self.begun_at, x)
        else:
            given = [x, None, 1.0, copies, self.surface.layout]
            self._launch(add_positions, self.surface.count, given, [self.begun_at])
        self._launch(self_pairs.begin_pairs, self.pairs.threads, [self.pairs, self.begun_at], [self.begun])

    def relist(self, x):
        self.launch_list(x)
        self.launch_sides(x, self.proximity.copies)


def _gaps(nearest):
    with np.errstate(divide="ignore"):
        return 1.0 / nearest.numpy()
