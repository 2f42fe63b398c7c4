"""The colliders of a scene in the steps of a solver."""

from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import numpy as np
import warp as wp

from ..kernels.contact import colliders as kernels
from ..kernels.contact import mesh_colliders as mesh_kernels
from ..kernels.fast.clear_elements import find_clear
from ..kernels.step import count_step
from ..kernels.terms.contact import FLOOR
from ..kernels.terms.friction import FRICTION
from ..terms.refresh import STEP, Refresh
from .mesh_faces import MeshFaces
from .mesh_steps import MeshSteps

# Where a vertex stops that would end in a collider, relative to the contact distance: where it comes to rest, a deep gap would
# be a strong force, and in float32 a noisy one.
LANDING = 0.1
# What held a vertex back in a collider where no other collider did.
CLOTH = "other cloth"


class ColliderSteps:
    """The motion of colliders, anchors of friction and the filter, in the steps of one solver.

    Where a step begins (a ``Refresh`` of the terms) colliders move on, the positions of the vertices are kept, and friction
    anchors them. Where it ends, :meth:`launch_end` keeps vertices out of colliders.

    Args:
        model: The :class:`warpcloth.model.model.Model` of a scene with colliders.
        state: The :class:`warpcloth.core.state.State` of the solver, to which it adds its own arrays.
        h: Step [s].
        steps_per_frame: Steps a frame.
        part: Where in a step its forces are taken, from 0, its start, to 1; 0 is that of explicit steps, whose contact is
            ``bounded``.
        resting: Whether it is not a solver but an equilibrium, whose rounds are its steps, with h = 0.

    Attributes:
        terms: The elements of the model, those of contact as steps take them.
        bounded: Whether contact is that of explicit steps.
        part: As given.
        x_before: Positions where the step began, (N,) [m].
        poses: Those of the step, a :func:`warpcloth.kernels.contact.colliders.step_poses`.
        shapes: A :func:`warpcloth.kernels.contact.colliders.shapes`.
        anchors: Those of friction on each collider that has it, by its index; rows of ``anchor_rows`` (C, N).
        least: Distance below which no vertex ends a step [m].
        faces: :class:`warpcloth.contact.mesh_faces.MeshFaces` that keeps triangles from crossing meshes, or None.
        steps_per_frame: As given.
        notes: :class:`warpcloth.kernels.contact.colliders.FilterNotes`.
        steps: Steps that the colliders have made, (B,) int32.
        correction: x − x̃ of the steps with contact (N,) [m], or None for explicit steps; of the effective step ``he`` [s].
        pushed, kicked: What the filter changed in positions [m] and velocities [m/s] since these were 0, (N,) double precision,
            after :meth:`note_pushes`.
    """

    def __init__(self, model, state, h, steps_per_frame, part, resting=False):
        self.model, self.h, self.part, device = model, h, part, model.device
        self.steps_per_frame = steps_per_frame
        declared = model.colliders
        pose_type, self._anchor_type = kernels.pose_types(model.dtype)
        self.shapes = kernels.shapes(model.dtype)()
        self._friction = model.array(declared.friction, model.dtype)  # whose memory the struct does not keep
        self.shapes.core, self.shapes.radius, self.shapes.friction = declared.core, declared.radius, self._friction
        self._dim, self.poses = (model.copies, len(declared.radius)), kernels.step_poses(model.dtype)()
        for name in ("before", "at", "after"):
            setattr(self.poses, name, wp.zeros(self._dim, dtype=pose_type, device=device))
        self.x_before = model.vectors()
        self.steps = state.add("steps of colliders", wp.zeros(model.copies, dtype=wp.int32, device=device))
        self.notes = kernels.FilterNotes()
        self.notes.steps = self.steps
        self.notes.cut = state.add("vertices cut short", wp.zeros(model.copies, dtype=wp.int64, device=device))
        self.notes.inside = state.add("first inside colliders", wp.zeros(self._dim, dtype=wp.int64, device=device))
        self.correction, self.he = None, h
        self.anchors, rows = {}, len(declared.radius) * bool(declared.friction.any())
        self.anchor_rows = wp.zeros((rows, model.count), dtype=self._anchor_type, device=device)
        self._spare, self._reads, self._again = None, False, False
        self.least = FLOOR * declared.distance
        # Of midpoint forces are those half-way, of others at the end.
        self._given = [declared.keyframes, declared.firsts, self.steps, steps_per_frame, int(np.ceil(2.0 * part))]
        self.bounded = part == 0.0
        self._move, self._count = model.kernel(kernels.move_colliders, model.dtype), model.kernel(count_step)
        self.meshes = self.faces = None
        if declared.meshes is not None:
            given = {"steps": self.steps, "per_frame": 2 * steps_per_frame, "ahead": self._given[-1], "h": h}
            given |= {"r": declared.distance, "least": self.least, "landing": LANDING * declared.distance}
            self.meshes = MeshSteps(model, self.poses, self.bounded, resting, **given)
            if model.scene.contact.elements == "triangles" and not resting:
                self.faces = MeshFaces(model, self.meshes, h)
        self._filter = model.kernel(kernels.filter_step if self.meshes is None else mesh_kernels.filter_meshes, model.dtype)
        if model.mobility is not None:
            self._wanted, self._hold = [model.vectors(), model.vectors()], model.kernel(kernels.hold_locked, model.dtype)
            self._fixed = wp.zeros(model.count, dtype=model.dtype, device=device)
        self._finds_clear = model.device.is_cpu and not (self.bounded or resting)
        self.terms = []
        for elements in model.terms:
            c = elements.collider
            self.terms.append(elements if c is None else self._bound(elements, c, state))

    def _bound(self, elements, c, state):
        """The elements of contact or friction with collider c, with rest states of their own."""
        model, declared = self.model, self.model.colliders
        first = all(each.refresh is None or each.collider is None for each in self.terms)
        if elements.term is FRICTION:
            anchors = self.anchors[c] = state.add(f"anchors on collider {c}", self.anchor_rows[c])
        if declared.facets[c]:
            if elements.term is FRICTION:
                of_mesh = self.meshes.friction(elements, float(declared.friction[c]), anchors)
            else:
                of_mesh = self.meshes.contact(elements)
            launch = partial(self._on_mesh, of_mesh, state.v)
        elif elements.term is FRICTION:
            kernel = model.kernel(kernels.anchor_vertices, model.dtype, self.bounded)
            launch = partial(self._anchor, kernel, c, anchors, float(declared.friction[c]))
        elif declared.moves[c] or not (self.bounded or declared.half_space[c]):
            launch = partial(self._pose_elements, model.kernel(kernels.pose_collider, model.dtype), c, state.v)
        else:
            launch = None
        term = elements.term.bounded if self.bounded else elements.term
        refresh = Refresh(STEP, partial(self._refresh, first, launch))
        clear = None
        if self._finds_clear:
            clear = wp.zeros(elements.count, dtype=model.dtype, device=model.device)
        return replace(elements, term=term, rest=wp.clone(elements.rest), refresh=refresh, clear=clear)

    def _refresh(self, first, launch, model, elements, moment):
        """Where a step begins: by the first of the terms for all of them, then for each."""
        if first:
            self.launch_move()
            if self.meshes is not None:
                self.meshes.launch_trees()
            wp.copy(self.x_before, moment.x)
        if launch is not None:
            launch(model, elements)

    def _on_mesh(self, launch, v, model, elements):
        launch(elements, self.x_before, v)

    def _pose_elements(self, kernel, c, v, model, elements):
        given = [elements.stencil, self.shapes, *model.free_gravity, self.x_before, v, self.poses]
        given += [c, elements.per_copy, self.least, 0.0 if self.bounded else self.h]
        model.launch(kernel, elements.count, given, [elements.rest])

    def _anchor(self, kernel, c, anchors, friction, model, elements):
        if self._reads:
            wp.copy(self._spare, anchors)
            anchors = self._spare
        given = [elements.stencil, self.shapes, self.x_before, self.poses]
        given += [c, elements.per_copy, model.colliders.distance, friction]
        model.launch(kernel, elements.count, given, [anchors, elements.rest])

    @contextmanager
    def reading_anchors(self):
        """Meanwhile terms that are refreshed leave anchors as they are, which steps then move themselves."""
        self._reads = True
        try:
            yield
        finally:
            self._reads = False

    def follow(self):
        """Allocates what terms need to do so."""
        if self._spare is None:
            self._spare = wp.zeros(self.model.count, dtype=self._anchor_type, device=self.model.device)

    def launch_release(self):
        """Launches the end of all anchors, where nothing is in contact."""
        if self.anchors:
            self.anchor_rows.zero_()

    def launch_move(self):
        """Launches the poses of the step that begins."""
        self.model.launch(self._move, self._dim, self._given, [self.poses])

    def launch_clear(self, terms, x):
        """Launches what finds how far the vertices of ``terms`` may move from x̃ in this step before they touch."""
        for elements in terms:
            if elements.clear is not None:
                kernel = self.model.kernel(find_clear, elements.term, self.model.dtype)
                self.model.launch(kernel, elements.count, [elements.stencil, elements.rest, x], [elements.clear])

    def launch_count(self):
        """Launches what counts a step."""
        self.model.launch(self._count, self.model.copies, [], [self.steps])

    @property
    def drift(self):
        """By how much the bounds of a collider move on in a step, at most [m]."""
        return max(collider.centred().most_move for collider in self.model.scene.colliders) / self.steps_per_frame

    def note_pushes(self):
        """Allocates ``pushed`` and ``kicked``, which the filter then keeps; steps that were recorded are recorded again."""
        self.pushed, self.kicked = (wp.zeros(self.model.count, dtype=wp.vec3d, device=self.model.device) for _ in range(2))
        self.notes.pushed, self.notes.kicked = self.pushed, self.kicked

    def launch_end(self, x, v, move=None):
        """Keeps vertices that would end in a collider or cross one out of it, in x, v and ``move`` (N,)."""
        model = self.model
        if model.mobility is not None:
            for wanted, array in zip(self._wanted, (x, v), strict=True):
                wp.copy(wanted, array)
        self._launch_filter(model.inverse_mass, x, v, move, self.notes)
        if model.mobility is not None:  # those who then end inside are noted like pins
            model.launch(self._hold, model.count, [model.mobility, *self._wanted], [x, v, move, self.notes])
            self._launch_filter(self._fixed, x, v, move, self.notes)
        if self.faces is not None:
            self.faces.launch_end(self.x_before, x, v, move, self.notes)
        if not self._again:
            self.launch_count()

    def _launch_filter(self, inverse_mass, x, v, move, notes):
        model = self.model
        if self.meshes is None:
            given = [inverse_mass, self.shapes, self.x_before, self.poses]
            given += [model.per_copy, self.least, LANDING * model.colliders.distance, self.h]
        else:
            given = [inverse_mass, self.shapes, self.meshes.geometry, self.x_before]
            given += [self.meshes.motion, self.meshes.lists, model.per_copy]
        model.launch(self._filter, model.count, given, [x, v, move, notes])

    # Of cloth that touches itself, which may hold vertices back in a collider that comes over them.

    def end_again(self):
        """Says that these methods are used, the last of which then counts the step."""
        device, model = self.model.device, self.model
        self._again, self._unread = True, kernels.FilterNotes()
        self._fixed = wp.zeros(model.count, dtype=model.dtype, device=device)
        self._unread.steps, self._unread.cut = self.steps, wp.zeros(model.copies, dtype=wp.int64, device=device)
        self._unread.inside = wp.zeros(self._dim, dtype=wp.int64, device=device)

    def launch_out(self, x, v):
        """Moves vertices in x and v as :meth:`launch_end`, and notes nothing."""
        self._launch_filter(self.model.inverse_mass, x, v, None, self._unread)

    def launch_inside(self, x, v):
        """Notes vertices that colliders have come over in the step, and changes nothing; the step is over."""
        self._launch_filter(self._fixed, x, v, None, self.notes)
        self.launch_count()

    @property
    def share(self):
        """The share of the moves of free vertices in all steps that were cut short, (B,)."""
        free = (self.model.inverse_mass.numpy().reshape(self.model.copies, -1) > 0.0).sum(axis=1)
        return self.notes.cut.numpy() / np.maximum(self.steps.numpy().astype(np.float64) * free, 1.0)

    def inside(self):
        """The first vertex that ended a step inside each collider: tuples of its copy, collider, step, index, and the collider
        that held it back, None for a vertex that is not free, or CLOTH for one that other cloth held back."""
        colliders, found, n = self._dim[1], [], self.model.per_copy
        free = self.model.inverse_mass.numpy() > 0.0 if self._again else np.zeros(self.model.count, dtype=bool)
        for (copy, c), value in np.ndenumerate(self.notes.inside.numpy()):
            if value:
                rest, other = divmod(int(kernels.FIRST) - int(value), colliders + 1)
                step, vertex = divmod(rest, n)
                held = CLOTH if free[copy * n + vertex] else None
                found.append((copy, c, step, vertex, other if other < colliders else held))
        return found

    def start_again(self):
        """Forgets the steps that an integrator made to find its past."""
        for array in (self.steps, self.notes.cut, self.notes.inside, *self.anchors.values()):
            array.zero_()
