"""Contact of cloth with itself in the steps of a solver: the forces of near pairs, and the filter at the end of each step."""

from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import warp as wp

from ..core.capture import Mirror
from ..core.scan import Scan
from ..core.status import Stopped
from ..core.sums import Sums
from ..kernels import gap_notes, self_contact, self_filter, self_pairs, self_planes, self_sweeps
from ..kernels.proximity import take_moved
from ..kernels.step import count_step
from ..kernels.terms.contact import FLOOR
from .proximity import Proximity
from .self_friction import SelfFriction, Slips, acting_sizes
from .tangles import Tangles

# The skin, over the longest edge of the rest shape. Pairs are listed that are nearer than the contact distance plus the skin.
# It is more than 0.29: an edge that goes through a triangle with sides of at most 1 is nearer than that to one of them. And it
# is less than 0.5, the height of a right-angled triangle on its longest side if that is 1, so that a flat grid has no pairs.
SKIN = 0.35
# Rounds of the filter: planes are set anew in at most NEAR_ROUNDS, as long as they cut more than SHARE of the vertices; a way
# that is longer than one list allows is walked in at most FAR_ROUNDS.
SHARE, NEAR_ROUNDS, FAR_ROUNDS = 0.01, 4, 32
# The longest way of a vertex in a round, relative to the common motion, over the skin. It may have gone as far since the list
# was made, and so may the other vertex: both together come nearer by at most the skin.
WAY = 0.25
# Vertices that cloth holds back in a collider are let out in at most OUT_ROUNDS rounds of SWEEPS sweeps. Cloth that makes way
# keeps a gap to other cloth of LEFT times the contact distance, or that of before if it was less.
OUT_ROUNDS, SWEEPS, LEFT = 128, 4, 0.1


class TooNear(NamedTuple):
    """The first frame in which cloth is nearer to itself than float32 can tell apart; frames are stored in float32.

    Attributes:
        copy: Index of its copy.
        frame: Index of the frame.
        vertex: Index of a vertex there, in the order of the model, within the copy.
    """

    copy: int
    frame: int
    vertex: int


class SelfSteps:
    """Forces between near parts of cloth, and the filter, in the steps of one solver.

    Where a step begins, :meth:`launch_begin` lists the pairs that are near and fixes the areas of their contact. Where it ends,
    :meth:`launch_end` keeps them apart.

    Args:
        model: The :class:`warpcloth.model.model.Model` of a scene with self-contact.
        state: The :class:`warpcloth.core.state.State` of the solver, to which it adds its own arrays.
        h: Step [s].
        steps_per_frame: Steps a frame.
        bounded: Whether contact is that of explicit steps, without the logarithm.
        colliders: The :class:`warpcloth.contact.collider_steps.ColliderSteps` of the solver, or None.

    Attributes:
        proximity: :class:`warpcloth.contact.proximity.Proximity`.
        x_before: Positions where the step began, (N,) [m].
        energies: Those of the pairs by their first vertex, (N,) [J].
        lists: How many lists of pairs were made, (B,) int32, the same for all copies.
        listed: Whether the last list has pairs, (1,) int32.
        moves_together: Whether moves are relative to their mean for the filter, as nothing is pinned.
        tangles: :class:`warpcloth.contact.tangles.Tangles` of a start at which cloth crosses or touches cloth, else None.
        friction: :class:`warpcloth.contact.self_friction.SelfFriction`, or None without friction.
        stale: Whether lists have got more room outside of steps, so that what was recorded must be recorded again.
    """

    def __init__(self, model, state, h, steps_per_frame, bounded, colliders):
        declared = model.scene.self_contact
        self.model, self.h, self.bounded, self.declared = model, h, bounded, declared
        self.skin = SKIN * float(model.scene.mesh.edge_lengths.max())
        self.proximity = Proximity(model, declared.distance, self.skin)
        device = model.device
        self.x_before, self._target, self._from, self._other, self._begun_at = (model.vectors() for _ in range(5))
        self._ways = wp.zeros(model.count, dtype=wp.vec2d, device=device)
        self._share, self._least_share = (wp.zeros(model.count, dtype=wp.float64, device=device) for _ in range(2))
        self._slope, self._iterates, self._touching = model.scalars(), False, None
        self._colliders, self._cut_before = colliders, None
        self.energies = wp.zeros(model.count, dtype=wp.float64, device=device)
        areas = np.empty(model.per_copy)
        areas[model.in_model(np.arange(model.per_copy))] = model.scene.mesh.vertex_areas
        areas = np.tile(areas, model.copies)
        self._areas = wp.array(areas, dtype=wp.float64, device=device)
        self._common = wp.zeros(model.copies, dtype=wp.vec3d, device=device)
        free = not len(model.scene.fixed) and model.mobility is None and not model.scene.colliders
        self._cuts = wp.zeros((model.copies, 2), dtype=wp.int32, device=device)
        self._rounds, self._walking = (model.scalars(wp.int32) for _ in range(2))
        self._proceed = wp.zeros(1, dtype=wp.int32, device=device)
        self.cut = state.add("vertices kept apart", wp.zeros(model.copies, dtype=wp.int64, device=device))
        self.steps = state.add("steps of self-contact", model.scalars(wp.int32))
        self._most = Mirror(state.add("most pairs", model.scalars(wp.int32)))
        self.lists = state.add("lists of pairs", model.scalars(wp.int32))
        self.listed = wp.zeros(1, dtype=wp.int32, device=device)
        self._notes, self._per_frame = gap_notes.GapNotes(), steps_per_frame
        self._notes.nearest = state.add("nearest", model.scalars(wp.float64))
        self._notes.too_near = state.add("first too near", model.scalars(wp.int64))
        self._count = model.kernel(count_step)
        made = (
            self_pairs.begin_pairs,
            self_pairs.set_areas,
            self_pairs.fill_corners,
            self_pairs.sort_corners,
            self_contact.add_forces,
            self_contact.sum_energies,
            self_contact.add_diagonal,
        )
        made += self_filter.limit_direction, self_filter.precondition, self_filter.take_descent, self_filter.add_positions
        made += (
            self_contact.add_products,
            self_planes.find_ways,
            self_planes.cut_by_planes,
            self_filter.keep_apart,
            self_filter.end_filter,
            self_planes.common_move,
            gap_notes.note_gaps,
            take_moved,
        )
        self._kernels = {factory: model.kernel(factory, model.dtype) for factory in made}
        self._find = model.kernel(self_contact.find_forces, model.dtype, bounded)
        self.moves_together = free
        self._vertices = Scan(model, model.count)
        self._few = int(SHARE * model.per_copy)
        self.tangles, self._counted = None, None
        declared = model.colliders
        self._lets_out = colliders is not None and (declared.meshes is not None or any(declared.moves))
        if self._lets_out:
            colliders.end_again()
            self._mobile = wp.zeros(model.count, dtype=model.dtype, device=device)
            self._within, self._turns = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))
            for factory in (self_filter.find_held, self_filter.push_pairs):
                self._kernels[factory] = model.kernel(factory, model.dtype)
        self.friction, self.stale = None, False
        self._hold()
        state.add("positions of the list", self.proximity.found)
        self._carried = self.proximity.found, self._most.array, self.lists, self._notes.nearest, self._notes.too_near
        if self.declared.friction:
            slips = state.add_part("friction", Slips(model, self.proximity.capacity))
            slips.grow = self._grow_outside
            self.friction = SelfFriction(model, slips, self.steps, self.declared.friction, bounded)
        self._check_start(state)
        self.start_again()

    def _check_start(self, state):
        """Refuses a start at which cloth crosses cloth, or is nearer than the filter lets it come; or finds its tangles.

        An edge that crosses a triangle is near an edge of it, and that pair is listed. Computed in float64, without exact
        predicates.

        Raises:
            ValueError: Naming the first pair.
        """
        near, split, gap, through, least = self._too_near(self.model.positions)
        if not len(near) and not through:
            return
        crossing = [np.array([each[k] for each in through], dtype=np.int64).reshape(-1, 2 + k) for k in (0, 1)]
        tangles = Tangles(self.model, state, *crossing, (near[:split], near[split:]), least)
        if self.declared.crossing_start == "run":
            self.tangles = tangles
            return
        rule = f'; {len(tangles)} pairs of triangles cross or are too near, crossing_start="run" takes these'
        self._refuse_pairs(near, split, gap, through, least, rule)

    def refuse_reset(self, mask, x):
        """Refuses a reset of copies in ``mask`` (B,) to positions x (B·n, 3) at which cloth crosses or nearly touches cloth.

        Returns:
            Whether lists have got more room, so that what was recorded must be recorded again.
        """
        model, before = self.model, len(self.pairs.stencils)
        x = np.where(np.repeat(mask, model.per_copy)[:, None], x, np.nan)  # which has no pairs
        tangles, self.tangles = self.tangles, None
        with self._looking():
            found = self._too_near(wp.array(x, dtype=model.vec3, device=model.device))
        self.tangles = tangles
        if len(found[0]) or found[3]:
            self._refuse_pairs(*found, "")
        return len(self.pairs.stencils) > before

    def _refuse_pairs(self, near, split, gap, through, least, rule):
        for stencil in near[:1]:
            parts = (stencil[:1], stencil[1:]) if split else (stencil[:2], stencil[2:])
            self._refuse_pair(parts, f"start {gap:.3g} m apart; self_contact needs more than {least:.3g} m{rule}")
        self._refuse_pair(through[0], f"cross at the start; self_contact needs a start without crossings{rule}")

    def _too_near(self, x):
        """Lists the pairs at x and finds those that are too near.

        Returns:
            Pairs nearer than the least distance, how many of them are of a vertex, the gap of the first [m], edges that go
            through triangles, and the least distance [m].
        """
        points = x.numpy().astype(np.float64)
        self.proximity.set_skin(max(self.skin, SKIN * self._longest_edge(points)))
        self.launch_begin(x)
        while self.overflowed:
            self.grow()
            self.launch_begin(x)
        self.proximity.set_skin(self.skin)
        of_vertices, of_edges = self.proximity.counts.numpy()
        stencils = self.proximity.stencils.numpy()[: of_vertices + of_edges]
        found, least = self.begun.gap.numpy()[: len(stencils)], FLOOR * self.declared.distance
        ulps = 6.0 * float(np.finfo(np.float32).eps) * np.abs(points).max(initial=0.0, where=np.isfinite(points))
        least += ulps
        near = stencils[found < least]
        split = int(np.count_nonzero(found[:of_vertices] < least))
        edges = stencils[of_vertices:]
        through = [
            each
            for own, other in ((edges[:, :2], edges[:, 2:]), (edges[:, 2:], edges[:, :2]))
            for each in crossings(points, own, self._triangles_of(other))
        ]
        gap = found[np.argmax(found < least)] if len(near) else np.inf
        return near, split, gap, through, least

    def _longest_edge(self, points):
        """The length [m] of the longest edge of all copies; edges may be longer than at rest where a run starts."""
        points = points.reshape(self.model.copies, -1, 3)[:, self.model.in_model(self.model.scene.mesh.edges)]
        lengths = np.linalg.norm(points[:, :, 1] - points[:, :, 0], axis=2)
        return lengths.max(initial=0.0, where=np.isfinite(lengths))

    def at_start(self):
        """U [J] at the start, and how many pairs touch there times ½Σ(r − d)² [m²], both (B,)."""
        x, energy = self.model.positions, self.model.scalars()
        with self._looking():
            self.launch_begin(x)
        self.launch_forces(x)
        self.add_energy(Sums(self.model), energy)
        copies = self.pairs.stencils.numpy()[: self.pairs.counts.numpy().sum(), 0] // self.model.per_copy
        given = self.pairs.distances, self.begun.gap, self.begun.stiffness
        distance, gap, stiffness = (array.numpy()[: len(copies)] for array in given)
        open_by = np.where(stiffness > 0.0, np.maximum(distance - gap, 0.0), 0.0)
        touching, squares = (np.bincount(copies, each, self.model.copies) for each in (open_by > 0.0, open_by**2))
        return energy.numpy(), 0.5 * touching * squares

    @contextmanager
    def _looking(self):
        """Leaves the state as it was, whatever is listed meanwhile."""
        kept = [wp.clone(array) for array in self._carried]
        try:
            yield
        finally:
            for array, before in zip(self._carried, kept, strict=True):
                wp.copy(array, before)

    def _triangles_of(self, edges):
        """The triangles of the model that each of some edges (E, 2) is in, (E, m, 3); the last again where they are fewer."""
        mesh, n = self.model.scene.mesh, self.model.per_copy
        triangles = np.asarray(self.model.in_model(mesh.triangles), dtype=np.int64)
        sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        keys = sides[:, 0] * n + sides[:, 1]
        order = np.argsort(keys, kind="stable")
        local = np.sort(edges % n, axis=1).astype(np.int64)
        wanted = local[:, 0] * n + local[:, 1]
        first, last = (np.searchsorted(keys[order], wanted, side) for side in ("left", "right"))
        most = np.arange((last - first).max(initial=1))
        at = np.minimum(first[:, None] + most, last[:, None] - 1)
        return triangles[order[at] // 3] + (edges[:, :1] // n * n)[:, :, None]

    def _refuse_pair(self, parts, why):
        model, named = self.model, []
        for part in parts:
            vertices = [int(v % model.per_copy if model.order is None else model.order[v % model.per_copy]) for v in part]
            named.append(f"{('vertex', 'edge', 'triangle')[len(part) - 1]} {'–'.join(map(str, vertices))}")
        copy = f" of copy {parts[0][0] // model.per_copy}" if model.copies > 1 else ""
        raise ValueError(f"{named[0]} and {named[1]}{copy} {why}")

    def _hold(self):
        """Arrays of as many pairs as the list has room for."""
        found, device = self.proximity, self.model.device
        capacity = len(found.stencils)

        def room(dtype):
            return wp.zeros(capacity, dtype=dtype, device=device)

        self.pairs = self_pairs.near_pairs(self.model.dtype)()
        for name in ("stencils", "counts", "rows", "distances"):
            setattr(self.pairs, name, getattr(found, name))
        for name, size in acting_sizes(self.model, capacity).items():
            setattr(self.pairs, name, wp.zeros(size, dtype=wp.int32, device=device))
        self.begun, self.forces = self_pairs.StepPairs(), self_contact.PairForces()
        self.begun.normal, self.begun.weights = room(wp.vec3d), room(wp.vec4d)
        self.begun.gap, self.begun.stiffness = room(wp.float64), room(wp.float64)
        self.forces.normal, self.forces.weights = room(wp.vec3d), room(wp.vec4d)
        self.forces.energy, self.forces.slope, self.forces.bend = (room(wp.float64) for _ in range(3))
        self._open = room(wp.int32) if self.declared.crossing_start == "run" else None
        self.multipliers = room(wp.float64)
        if self._touching is not None:
            self._swept = self_sweeps.SweptPairs()
            self._swept.touches, self._swept.normal, self._swept.weights = room(wp.int32), room(wp.vec3d), room(wp.vec4d)
            self._swept.gap, self._swept.multiplier = room(wp.float64), room(wp.float64)

    def grow(self):
        """Makes room for the pairs that did not fit; what was recorded must be recorded again.

        Raises:
            Stopped: There is no memory for them.
        """
        try:
            self.grow_to(self._wanted)
        except ValueError as error:
            raise Stopped(str(error)) from None

    def grow_to(self, pairs):
        """Makes room for half as many pairs more than these."""
        self.proximity.grow(pairs)
        self._hold()
        if self.friction is not None:
            self.friction.hold(self.proximity.capacity)

    def _grow_outside(self, pairs):
        self.grow_to(pairs)
        self.stale = True

    @property
    def overflowed(self):
        """Whether a list since this was last asked did not have room for all pairs; the host reads it."""
        most = int(self._most.read().max())
        if most > len(self.pairs.stencils):
            self._wanted = most
            return True
        return False

    @property
    def share(self):
        """The share of the moves of free vertices in all steps that were cut short, (B,)."""
        free = (self.model.inverse_mass.numpy().reshape(self.model.copies, -1) > 0.0).sum(axis=1)
        return self.cut.numpy() / np.maximum(self.steps.numpy().astype(np.float64) * free, 1.0)

    @property
    def most(self):
        """The largest number of pairs in any list of the steps so far, of all copies."""
        return int(self._most.read().max())

    @property
    def least_gap(self):
        """The least distance of a pair in any frame so far, as stored in float32, (B,) [m]; infinite where none was listed."""
        return _gaps(self._notes.nearest)

    @property
    def too_near(self):
        """A :class:`TooNear` of each copy in which a pair came nearer than 4 units in the last place of float32 coordinates."""
        found, n = [], self.model.per_copy
        for copy, value in enumerate(self._notes.too_near.numpy()):
            if value:
                found.append(TooNear(copy, *divmod(int(gap_notes.FIRST) - int(value), n)))
        return found

    def in_frame(self):
        """Of the last :meth:`launch_begin`, for each copy (B,): pairs listed, pairs in contact, and the least gap [m]."""
        model = self.model
        if self._counted is None:
            self._counted = model.kernel(gap_notes.count_pairs, model.dtype)
        counts, nearest = wp.zeros((model.copies, 2), dtype=wp.int32, device=model.device), model.scalars(wp.float64)
        given = [self.pairs, self.begun, self.x_before, model.per_copy]
        model.launch(self._counted, len(self.pairs.stencils), given, [counts, nearest])
        return *counts.numpy().T, _gaps(nearest)

    def start_again(self):
        """Forgets the steps that an integrator made to find its past, and the list, as a reset does."""
        for array in (self.cut, self.steps, *self._carried):
            array.zero_()
        if self.tangles is not None:
            self.tangles.start_again()

    def _launch(self, factory, dim, inputs, outputs):
        self.model.launch(self._kernels[factory], dim, inputs, outputs)

    def launch_begin(self, x):
        """Lists the pairs near x, (N,), where a step begins.

        Keeps an earlier list as long as the walk at the end of this step cannot miss a pair with it.
        """
        wp.copy(self.x_before, x)
        if self._cut_before is not None:
            wp.copy(self._cut_before, self._colliders.notes.cut)
        self.proximity.launch_kept(x, WAY, self.launch_list)
        self.launch_areas(x)
        given = [self.pairs, self.begun, x, self.steps, self._per_frame, self.model.per_copy]
        self._launch(gap_notes.note_gaps, len(self.pairs.stencils), given, [self._notes])
        if self.friction is not None:
            self.friction.launch_begin(self.pairs, self.begun, x)

    def launch_list(self, x):
        """Lists the pairs and notes their number: at x in the copies that have moved. A list at ``found`` does not count again.

        Follows :meth:`warpcloth.contact.proximity.Proximity.moved`.
        """
        self.proximity.launch_moved(x)
        given = [self.proximity.counts, int(x is not self.proximity.found)]
        self.model.launch(self_pairs.note_list, self.model.copies, given, [self._most.array, self.lists, self.listed])

    def launch_areas(self, x, copies=None):
        """Fixes the side and the area of each listed pair, and so which are acting, in all or some ``copies`` (B,) int32."""
        count = len(self.pairs.stencils)
        self._launch_sides(x, copies)
        if self.tangles is not None:
            self.tangles.launch_leave_out(self.pairs.stencils, self.pairs.counts, self.begun.gap)
        self.pairs.number.zero_()
        given = [self.pairs, self._areas, self._begun_at, self.declared.stiffness]
        self._launch(self_pairs.set_areas, count, given, [self.begun])
        self._vertices.launch(self.pairs.corner_counts, self.pairs.first)
        self._launch(self_pairs.fill_corners, count, [], [self.pairs])
        self._launch(self_pairs.sort_corners, self.model.count, [], [self.pairs])

    def _launch_sides(self, x, copies=None):
        """Fixes the side of each listed pair, and its gap: in ``copies`` at x, in the others where they were fixed before."""
        if copies is None:
            wp.copy(self._begun_at, x)
        else:
            self._launch(take_moved, self.model.count, [x, copies, self.model.per_copy], [self._begun_at])
        self._launch(self_pairs.begin_pairs, len(self.pairs.stencils), [self.pairs, self._begun_at], [self.begun])

    def _relist(self, x):
        self.launch_list(x)
        self._launch_sides(x, self.proximity.copies)

    def launch_forces(self, x, correction=None):
        """Finds the forces of the pairs at x, or x + correction, which the methods below add up."""
        self.model.launch(self._find, len(self.pairs.stencils), [self.pairs, self.begun, x, correction], [self.forces])
        if self.friction is not None:
            self.friction.launch_forces(x, correction)

    def add_gradient(self, out):
        """out (N,) += ∂U/∂x."""
        self._launch(self_contact.add_forces, self.model.count, [self.pairs, self.forces], [out])
        if self.friction is not None:
            self.friction.add_gradient(out)

    def add_energy(self, sums, out):
        """out (B,) += U."""
        self._launch(self_contact.sum_energies, self.model.count, [self.pairs, self.forces], [self.energies])
        if self.friction is not None:
            self.friction.add_energies(self.energies)
        sums.sum(self.energies, self.model.per_copy, out, accumulate=1)

    def add_diagonal(self, diagonal, values):
        """Adds to the diagonal blocks of a :class:`warpcloth.core.hessian.Hessian`."""
        given = [self.pairs, self.model.inverse_mass, diagonal, self.forces]
        self._launch(self_contact.add_diagonal, self.model.count, given, [values])
        if self.friction is not None:
            self.friction.add_diagonal(diagonal, values)

    def add_products(self, p, q, active):
        """q += A p of its blocks off the diagonal, for the copies that are ``active`` (B,)."""
        given = [self.pairs, self.model.inverse_mass, self.forces, p, active, self.model.per_copy]
        self._launch(self_contact.add_products, self.model.count, given, [q])
        if self.friction is not None:
            self.friction.add_products(p, q, active)
        self.model.lock(q)

    def rows(self):
        """Of the pairs that press at the last :meth:`launch_forces`: J, whose rows are wᵢn, and kAφ″; the host reads them.

        Friction has rows of its own, along the plane normal to n.

        Returns:
            J, scipy (pairs, 3N) without columns of what does not move, and D, scipy diagonal (pairs, pairs) [N/m]; ∂²U/∂x² is
            JᵀDJ.
        """
        from scipy.sparse import csr_matrix, diags

        model, bend = self.model, self.forces.bend.numpy()
        acting = np.sort(self.pairs.acting.numpy()[: self.pairs.number.numpy()[0]])
        press = acting[bend[acting] != 0.0]
        found = [array.numpy()[press] for array in (self.pairs.stencils, self.forces.weights, self.forces.normal)]
        found.append(bend[press])
        if self.friction is not None:
            found = [np.concatenate(each) for each in zip(found, self.friction.rows(), strict=True)]
        stencils, w, n, bend = found
        columns = 3 * stencils.astype(np.int64)[:, :, None] + np.arange(3)
        values = w[:, :, None] * n[:, None, :] * (model.coordinate_mobility() > 0.0)[columns]
        starts = 12 * np.arange(len(bend) + 1)
        J = csr_matrix((values.ravel(), columns.ravel(), starts), shape=(len(bend), 3 * model.count))
        return J, diags(bend)

    def sweeps(self, in_turn):
        """Says that sweeps will move pairs in turn, or all at once, as devices with many threads must."""
        model, key = self.model, (self.model.dtype, self.model.mobility is not None)
        if self.friction is not None:
            self.friction.sweeps(in_turn)
        if in_turn and model.device.is_cpu:
            self._sweep = model.kernel(self_sweeps.sweep_pairs, *key)
            return
        self._touching = wp.zeros(model.count, dtype=wp.float64, device=model.device)
        self._press, self._move = (
            model.kernel(factory, *key) for factory in (self_sweeps.press_pairs, self_sweeps.move_by_pairs)
        )
        for factory in (self_sweeps.touch_pairs, self_sweeps.count_touching, self_sweeps.keep_pairs):
            self._kernels[factory] = model.kernel(factory, model.dtype)
        self._hold()

    def launch_sweep(self, x, correction, h, adds, backward=False):
        """Moves the vertices of all pairs, see :func:`warpcloth.kernels.self_sweeps.sweep_pairs` and its neighbours.

        Args:
            x: x̃ (N,) [m].
            correction: d (N,) [m].
            h: Step [s].
            adds: Whether multipliers add up over sweeps; else pairs are hard.
            backward: Whether pairs move from the last to the first, where they move in turn.
        """
        if self.friction is not None and backward:
            self.friction.launch_sweep(x, correction, h, backward)
        self._launch_sweep(x, correction, h, adds, backward)
        if self.friction is not None and not backward:
            self.friction.launch_sweep(x, correction, h, backward)

    def launch_no_multipliers(self):
        """Launches λ = 0 of all pairs."""
        self.multipliers.zero_()
        if self.friction is not None:
            self.friction.multipliers.zero_()

    def _launch_sweep(self, x, correction, h, adds, backward):
        model, mobility, multipliers = self.model, self.model.local_mobility, self.multipliers if adds else None
        if self._touching is None:
            given = [self.pairs, mobility, self.begun, x, h, not adds, backward]
            model.launch(self._sweep, 1, given, [multipliers, self.forces, correction])
            return
        count, N, swept = len(self.pairs.stencils), model.count, self._swept
        self._launch(self_sweeps.touch_pairs, count, [self.pairs, self.begun, multipliers, x, correction], [swept])
        self._launch(self_sweeps.count_touching, N, [self.pairs, swept], [self._touching])
        given = [self.pairs, mobility, self.begun, self._touching, multipliers, h, not adds]
        model.launch(self._press, count, given, [swept])
        model.launch(self._move, N, [self.pairs, mobility, swept, multipliers, self.forces], [correction])
        if adds:
            self._launch(self_sweeps.keep_pairs, count, [self.pairs, swept], [multipliers, self.forces])

    def launch_end(self, x, v, move=None):
        """Walks from where the step began to x as far as pairs stay apart; v and ``move`` (N,) follow.

        After iterates that stay apart, the walk starts at the last of them. But this may be inside a collider, out of which the
        filter of colliders has moved x: then too the walk starts where the step began, since that way is outside.
        """
        model = self.model
        if self.friction is not None and self._iterates:  # whose areas may be those of a list that was made on the way
            self.friction.launch_contact(self.pairs, self.begun)
        if self._cut_before is not None:
            colliders = self._colliders
            given = [colliders.x_before, self._cut_before, colliders.notes.cut, model.per_copy]
            self._launch(self_filter.walk_from_start, model.count, given, [self.x_before])
        wp.copy(self._target, x)
        wp.copy(x, self.x_before)
        if self._iterates:
            self.launch_fresh(x, self._relist)
        self._walk(x)
        if self._lets_out:
            self._turns.zero_()
            self._walking.fill_(1)
            self._launch_held(x)
            wp.capture_while(self._within, self._launch_let_out, x=x)
            self._colliders.launch_inside(x, self._from)
        given = [model.inverse_mass, self._target, x, model.per_copy, self.h]
        self._launch(self_filter.end_filter, model.count, given, [v, move, self.cut])
        model.launch(self._count, model.copies, [], [self.steps])
        if self.friction is not None:
            self.friction.launch_end(x)
        if self.tangles is not None:
            self.tangles.launch_free(x)

    def launch_fresh(self, x, launch, active=None):
        """Calls ``launch`` with x if a vertex, of a copy that is ``active`` or of any, has moved so far since the last list
        that the next walk might miss a pair."""
        wp.capture_if(self.proximity.moved(x, WAY, active), launch, x=x)

    def _walk(self, x):
        """Moves x towards the target as far as pairs stay apart. On a long way lists are made anew."""
        self._rounds.zero_()
        self._cuts.zero_()
        self._walking.fill_(1)
        self._launch_walk(x)
        wp.capture_while(self._proceed, self._launch_round, x=x)

    def _launch_round(self, x):
        self.launch_fresh(x, self._relist, self._walking)
        if self._iterates:
            self._launch_areas_again(x, self._walking)
        self._launch_walk(x)

    def _launch_areas_again(self, x, copies):
        self.launch_areas(x, copies)
        if self.friction is not None:
            self.friction.launch_relisted(copies)

    def _launch_walk(self, x):
        model = self.model
        self._launch_planes(x, self._target, None)
        self._launch_apart(x, self._target)
        self._proceed.zero_()
        given = [self._few, NEAR_ROUNDS, FAR_ROUNDS]
        model.launch(self_filter.another_round, model.copies, given, [self._cuts, self._rounds, self._walking, self._proceed])

    def _launch_apart(self, x, target):
        model = self.model
        wp.copy(self._from, x)
        given = [self._share, self._least_share, self._from, target, self._common, self._walking]
        given += [model.per_copy, WAY * self.skin]
        self._launch(self_filter.keep_apart, model.count, given, [x, self._cuts])

    def _launch_held(self, x):
        """Finds the vertices that cloth holds back in a collider that has come over them, and where they would be outside."""
        model, out = self.model, self._other
        wp.copy(out, x)
        self._colliders.launch_out(out, self._from)
        self._within.zero_()
        given = [model.inverse_mass, x, out, self._turns, OUT_ROUNDS]
        self._launch(self_filter.find_held, model.count, given, [self._mobile, self._within])

    def _launch_let_out(self, x):
        """Walks on to where the vertices that are held back are outside, and other cloth makes way for them."""
        model, out = self.model, self._other
        self.launch_fresh(x, self.launch_list)
        self._launch_sides(x)
        for _ in range(SWEEPS):
            given = [self.pairs, self._mobile, self.begun, x, LEFT * self.declared.distance]
            self._launch(self_filter.push_pairs, 1, given, [out])
        self._launch_planes(x, out, None)
        self._launch_apart(x, out)
        model.launch(self._count, 1, [], [self._turns])
        self._launch_held(x)

    def _launch_planes(self, x, target, direction):
        """Finds the share of each wanted move that planes leave."""
        model, wanted = self.model, [x, target, direction]
        if self.moves_together:
            self._launch(self_planes.common_move, model.copies, [*wanted, model.per_copy], [self._common])
        given = [*wanted, self._common, self._begun_at, model.per_copy]
        self._launch(self_planes.find_ways, model.count, given, [self._ways, self._share, self._least_share])
        gap, open = self.begun.gap, None
        if self.tangles is not None:
            gap, open = None, self._open  # gaps are infinite where a pair is left out of contact
            self.tangles.launch_open(self.pairs.stencils, self.pairs.counts, open)
        given = [self.pairs, gap, open, *wanted, self._common, self._ways]
        given += [model.per_copy, FLOOR * self.declared.distance]
        self._launch(self_planes.cut_by_planes, len(self.pairs.stencils), given, [self._share, self._least_share])

    # Of methods whose iterates base + d stay apart too.

    def launch_first(self, base, d):
        """d such that base + d is as far on the way from where the step began to base as pairs stay apart."""
        wp.copy(self._target, base)
        self._walk(self.x_before)
        self._add(self.x_before, base, -1.0, d)

    def iterates(self):
        """Says that these methods are used."""
        self._iterates, model = True, self.model
        self._kernels[self_filter.shorten] = model.kernel(self_filter.shorten, model.dtype)
        self._longest, self._ones = model.scalars(), wp.ones(model.count, dtype=model.dtype, device=model.device)
        if self._colliders is not None and not self._lets_out:
            self._cut_before = wp.zeros_like(self._colliders.notes.cut)
            self._kernels[self_filter.walk_from_start] = model.kernel(self_filter.walk_from_start, model.dtype)

    def launch_relist(self, base, d, active, launch):
        """Lists the pairs at base + d of copies that are ``active`` (B,), and launches ``launch``, if vertices have moved far
        since the last list."""
        self._add(base, d, 1.0, self.x_before, active)

        def relist(x):
            self.launch_list(x)
            self._launch_areas_again(x, self.proximity.copies)
            launch()

        self.launch_fresh(self.x_before, relist, active)

    def launch_limit(self, sums, gradient, preconditioner, right, direction):
        """Cuts the direction from the positions of :meth:`launch_relist` short, so that pairs stay apart along all of it.

        A direction longer than lists allow is shortened as a whole: cut at each vertex alone it would stretch stiff cloth. Of a
        copy where energy does not fall along what is left it is P·right, with the preconditioner P, cut short likewise.
        """
        model, N = self.model, self.model.count
        self._launch(self_filter.precondition, N, [preconditioner, right], [self._other])
        for each in (direction, self._other):
            sums.largest(self._ones, each, self._longest)
            self._launch(self_filter.shorten, N, [self._longest, model.per_copy, WAY * self.skin], [each])
            self._launch_planes(self.x_before, None, each)
            given = [self._share, self._common, model.per_copy, WAY * self.skin]
            self._launch(self_filter.limit_direction, N, given, [each])
        sums.dot(gradient, direction, self._slope)
        self._launch(self_filter.take_descent, N, [self._slope, self._other, model.per_copy], [direction])

    def _add(self, a, b, sign, out, active=None):
        self._launch(self_filter.add_positions, self.model.count, [a, b, sign, active, self.model.per_copy], [out])


def _gaps(nearest):
    """Distances [m] by their inverses, an array on the device."""
    with np.errstate(divide="ignore"):
        return 1.0 / nearest.numpy()


def crossings(points, edges, triangles):
    """The edges that go through triangles.

    Args:
        points: (N, 3) [m].
        edges: (E, 2).
        triangles: (E, m, 3): of each edge those that it is compared with.

    Returns:
        List of (edge (2,), triangle (3,)).
    """
    edges = np.repeat(edges, triangles.shape[1], axis=0)
    triangles = triangles.reshape(-1, 3)
    apart = ~(edges[:, :, None] == triangles[:, None, :]).any(axis=(1, 2))
    edges, triangles = edges[apart], triangles[apart]
    (p, q), (a, b, c) = points[edges].swapaxes(0, 1), points[triangles].swapaxes(0, 1)

    def volume(a, b, c, d):
        return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)

    through = volume(a, b, c, p) * volume(a, b, c, q) < 0.0
    sides = np.sign([volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)])
    through &= (sides >= 0.0).all(axis=0) | (sides <= 0.0).all(axis=0)
    return list(zip(edges[through], triangles[through], strict=True))
