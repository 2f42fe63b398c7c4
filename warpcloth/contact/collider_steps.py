"""The colliders of a scene in the steps of a solver."""

from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import numpy as np
import warp as wp

from ..core.filled import filled
from ..core.state import Count
from ..kernels.contact import colliders as kernels
from ..kernels.contact.anchors import anchor_vertices
from ..kernels.contact.clear_elements import find_clear
from ..kernels.contact.collider_filter import FIRST, FilterNotes, filter_step, hold_locked
from ..kernels.step import count_step
from ..kernels.terms.contact import FLOOR
from ..terms.refresh import STEP, Refresh
from .clearance import Clearance

# The filter puts a vertex that would end in a collider at this gap, relative to the contact distance. At a much smaller gap the
# logarithm would push hard, and in float32 noisily.
LANDING = 0.1
CLOTH = "other cloth"  # that held a vertex back in a collider


def cut_share(model, cut, steps):
    """Returns the fraction of the moves of free vertices that were cut, (B,)."""
    free = (model.inverse_mass.numpy().reshape(model.copies, -1) > 0.0).sum(axis=1)
    return cut.numpy() / np.maximum(steps.numpy().astype(np.float64) * free, 1.0)


def launch_pose(kernel, colliders, h, x, v, model, elements):
    given = [elements.stencil, colliders, *model.free_gravity, x, v, elements.collider, h]
    model.launch(kernel, elements.count, given, [elements.rest])


def launch_anchors(kernel, colliders, anchors, x, model, elements):
    given = [elements.stencil, colliders, x, elements.collider, model.colliders.distance]
    model.launch(kernel, elements.count, given, [anchors, elements.rest])


class ColliderSteps:
    """The motion of colliders in one solver's steps, and the friction and filter of those that are not meshes.

    Args:
        state: The state of the solver, to which arrays are added.
        h: Time step [s].
        part: The fraction of the step after which forces are evaluated; 0 for explicit steps, whose contact is ``bounded``: it
            has no logarithm.

    Attributes:
        terms: The elements of the model; those of contact have rest states of their own, whose refresh moves the colliders.
        x_before: Positions at the start of the step, (N,) [m].
        poses, shapes, filter, notes: Structs of :mod:`warpcloth.kernels.contact.colliders` and ``collider_filter``.
        anchors: Rows of ``anchor_rows`` (C, N) by the index of the collider, for friction.
        least: The smallest distance from a collider at which a vertex may end a step [m].
        near: See :class:`.Clearance`; None if all steps refresh contact.
        steps: The number of steps so far, (B,) int32.
        correction: x − x̃ of steps with contact (N,) [m], None if explicit. ``he`` is their effective step [s].
        pushed, kicked: Changes by the filter in positions [m] and velocities [m/s] since both were last 0, (N,) float64.
    """

    def __init__(self, model, state, h, steps_per_frame, part):
        self.model, self.h, self.part, device = model, h, part, model.device
        self.steps_per_frame = steps_per_frame
        declared = model.colliders
        pose_type, self._anchor_type = kernels.pose_types(model.dtype)
        values = {name: getattr(declared, name) for name in ("kind", "core", "radius")}
        self.shapes = filled(kernels.shapes(model.dtype), friction=model.array(declared.friction, model.dtype), **values)
        self._dim = model.copies, len(declared.radius)
        poses = {name: wp.zeros(self._dim, dtype=pose_type, device=device) for name in ("before", "at", "after")}
        self.poses = filled(kernels.step_poses(model.dtype), **poses)
        self.x_before = model.vectors()
        self.steps = state.add("steps of colliders", model.scalars(wp.int32), Count())
        cut = state.add("vertices cut short", model.scalars(wp.int64), Count(sums=True))
        inside, of_note = wp.zeros(self._dim, dtype=wp.int64, device=device), Count(rest=model.per_copy * (self._dim[1] + 1))
        inside = state.add("first inside colliders", inside, of_note)
        self.notes = filled(FilterNotes, steps=self.steps, cut=cut, inside=inside)
        self.correction, self.he = None, h
        self.anchors, rows = {}, len(declared.radius) * bool(declared.friction.any())
        self.anchor_rows = wp.zeros((rows, model.count), dtype=self._anchor_type, device=device)
        self._spare, self._reads, self._again = None, False, False
        self.least = FLOOR * declared.distance
        numbers = {"per_copy": model.per_copy, "least": self.least, "landing": LANDING * declared.distance}
        self.filter = filled(kernels.filters(model.dtype), shape=self.shapes, poses=self.poses, **numbers)
        # Midpoint evaluates forces at the middle of a step, other integrators at its end.
        self._given = [declared.keyframes, declared.firsts, self.steps, steps_per_frame, int(np.ceil(2.0 * part))]
        self.bounded = part == 0.0
        self._move, self._count = model.kernel(kernels.move_colliders, model.dtype), model.kernel(count_step)
        self._filter = None if all(declared.is_mesh) else model.kernel(filter_step, model.dtype, declared.solids)
        if model.mobility is not None:
            self._wanted, self._hold = [model.vectors(), model.vectors()], model.kernel(hold_locked, model.dtype)
            self._fixed = wp.zeros(model.count, dtype=model.dtype, device=device)
        self._finds_clear = model.device.is_cpu and not self.bounded
        self.moved_by_terms = any(elements.collider is not None for elements in model.terms)
        self._clearance = None
        if self.moved_by_terms and not (self.bounded or any(declared.moves)):
            self._clearance = Clearance(self, state)
        self.near = None if self._clearance is None else self._clearance.near
        self.terms = []
        for elements in model.terms:
            c = elements.collider
            self.terms.append(elements if c is None else self._bound(elements, c, state))

    @property
    def solid(self):
        return [elements for elements in self.terms if elements.term.gap]

    def _bound(self, elements, c, state):
        model, declared = self.model, self.model.colliders
        first = all(each.refresh is None or each.collider is None for each in self.terms)
        term = elements.term.bounded if self.bounded else elements.term
        launch, h = None, 0.0 if self.bounded else self.h
        if elements.term.law:
            self.anchors[c] = state.add(f"anchors on collider {c}", self.anchor_rows[c])
            kernel = model.kernel(anchor_vertices, model.dtype, declared.solids, elements.term.law, self.bounded)
            launch = partial(self._anchor, kernel, self.anchors[c])
        elif declared.moves[c] or not (self.bounded or declared.half_space[c]):
            kernel = model.kernel(kernels.pose_collider, model.dtype, declared.solids)
            launch = partial(launch_pose, kernel, self.filter, h, self.x_before, state.v)
        refresh = Refresh(STEP, partial(self._refresh, first, launch, state.v))
        clear = None
        if self._finds_clear:
            clear = wp.zeros(elements.count, dtype=model.dtype, device=model.device)
        return replace(elements, term=term, rest=wp.clone(elements.rest), refresh=refresh, clear=clear)

    def _refresh(self, first, launch, v, model, elements, moment):
        """Launches the start of a step. The first of the terms also moves the colliders."""
        if first:
            self.launch_start(moment.x)
            if self._clearance is not None:
                self._clearance.launch_begin(self.x_before, v)
        if launch is not None and self._clearance is None:
            launch(model, elements)
        elif launch is not None:
            self._clearance.launch_refresh(partial(launch, model, elements))

    def _anchor(self, kernel, anchors, model, elements):
        if self._reads:
            wp.copy(self._spare, anchors)
        launch_anchors(kernel, self.filter, anchors, self.x_before, model, elements)
        if self._reads:
            wp.copy(anchors, self._spare)

    @contextmanager
    def reading_anchors(self):
        """Within this context, refreshing terms does not change the anchors."""
        self._reads = True
        try:
            yield
        finally:
            self._reads = False

    def follow(self):
        """Makes all steps refresh contact, and allows :meth:`reading_anchors`."""
        if self._clearance is not None:
            self._clearance.follow()
        if self._spare is None:
            self._spare = wp.zeros(self.model.count, dtype=self._anchor_type, device=self.model.device)

    def launch_start(self, x):
        self.launch_move()
        wp.copy(self.x_before, x)

    def launch_move(self):
        self.model.launch(self._move, self._dim, self._given, [self.poses])

    def launch_clear(self, terms, x):
        """Launches the distances by which vertices can move from x̃ before they touch."""
        for elements in terms:
            if elements.clear is not None:
                kernel = self.model.kernel(find_clear, elements.term, self.model.dtype)
                self.model.launch(kernel, elements.count, [elements.stencil, elements.rest, x], [elements.clear])

    def launch_count(self):
        self.model.launch(self._count, self.model.copies, [], [self.steps])

    @property
    def drift(self):
        """Upper bound of the move of a point of a collider in a step [m]."""
        return max(collider.centred().most_move for collider in self.model.scene.colliders) / self.steps_per_frame

    def note_pushes(self):
        """Makes the filter add to ``pushed`` and ``kicked``. Graphs must be recorded again."""
        self.pushed, self.kicked = (wp.zeros(self.model.count, dtype=wp.vec3d, device=self.model.device) for _ in range(2))
        self.notes.pushed, self.notes.kicked = self.pushed, self.kicked

    def launch_end(self, x, v, move=None):
        """Moves vertices that would end in, or cross, a collider that is no mesh out; corrects x, v and ``move``, (N,)."""
        if self._clearance is None:
            self._launch_end(x, v, move)
        else:
            self._clearance.launch_end(self.x_before, x, partial(self._launch_end, x, v, move))
        if not self._again:
            self.launch_count()

    def _launch_end(self, x, v, move):
        model = self.model
        if model.mobility is not None:
            for wanted, array in zip(self._wanted, (x, v), strict=True):
                wp.copy(wanted, array)
        self._launch_filter(model.inverse_mass, x, v, move, self.notes)
        if model.mobility is not None:  # vertices that locked axes hold inside are noted like pins
            model.launch(self._hold, model.count, [model.mobility, *self._wanted], [x, v, move, self.notes])
            self._launch_filter(self._fixed, x, v, move, self.notes)

    def _launch_filter(self, inverse_mass, x, v, move, notes):
        if self._filter is None:
            return
        given = [inverse_mass, self.filter, self.x_before, self.h]
        self.model.launch(self._filter, self.model.count, given, [x, v, move, notes])

    # For self-contact, which can hold vertices back inside a collider that moves onto them.

    def end_again(self):
        """Prepares :meth:`launch_out` and :meth:`launch_inside`, which then counts the step."""
        device, model, self._again = self.model.device, self.model, True
        self._fixed = wp.zeros(model.count, dtype=model.dtype, device=device)
        inside = wp.zeros(self._dim, dtype=wp.int64, device=device)
        self._unread = filled(FilterNotes, steps=self.steps, cut=model.scalars(wp.int64), inside=inside)

    def launch_out(self, x, v):
        """Moves vertices in x and v as :meth:`launch_end` does, and notes nothing."""
        self._launch_filter(self.model.inverse_mass, x, v, None, self._unread)

    def launch_inside(self, x, v):
        """Notes vertices inside colliders, without moving them, and counts the step."""
        self._launch_filter(self._fixed, x, v, None, self.notes)
        self.launch_count()

    @property
    def share(self):
        return cut_share(self.model, self.notes.cut, self.steps)

    def inside(self):
        """The first vertex that ended a step inside each collider: (copy, collider, step, vertex, held by).

        The last is the index of another collider, CLOTH, or None for a vertex that is not free.
        """
        colliders, found, n = self._dim[1], [], self.model.per_copy
        free = self.model.inverse_mass.numpy() > 0.0 if self._again else np.zeros(self.model.count, dtype=bool)
        for (copy, c), value in np.ndenumerate(self.notes.inside.numpy()):
            if value:
                rest, other = divmod(int(FIRST) - int(value), colliders + 1)
                step, vertex = divmod(rest, n)
                held = CLOTH if free[copy * n + vertex] else None
                found.append((copy, c, step, vertex, other if other < colliders else held))
        return found

    def start_again(self):
        for array in (self.steps, self.notes.cut, self.notes.inside, *self.anchors.values()):
            array.zero_()
