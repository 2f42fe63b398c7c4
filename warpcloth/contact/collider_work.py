"""Work of moving colliders, work against friction, and work of the collider filter, summed over steps."""

import warp as wp

from ..core.energy import Energy
from ..core.gradient import Gradient
from ..core.sums import Sums
from ..kernels.contact import collider_work as kernels
from ..kernels.project import add_momentum
from ..kernels.work import add_scaled
from .present import ColliderPulls, PresentContact


class ColliderWork:
    """Sums the work over the steps of one stepper, from the forces that its steps used.

    Args:
        colliders: The :class:`warpcloth.contact.collider_steps.ColliderSteps` of the stepper.
        terms: The elements as its steps take them.
        cuts: The :class:`FilterWork` of the stepper, which must be launched before.
        of_colliders, against_friction, of_filter: Sums per vertex, (N,) float64 [J].
        hard: See :class:`warpcloth.contact.present.ColliderPulls`.
    """

    def __init__(self, colliders, terms, cuts, of_colliders, against_friction, of_filter, hard=None):
        self.colliders, self.model, self._x, model = colliders, colliders.model, cuts.uncut, colliders.model
        self._sums, self._at_end = [of_colliders, against_friction, of_filter], colliders.part == 1.0
        self._cuts = cuts.cuts
        self.pulls = ColliderPulls(model, terms, hard)
        self._before, self._x_step = [], self._x if self._at_end else colliders.x_before
        others, self._limit = [elements for elements in terms if elements.collider is None], None
        if colliders.correction is not None and model.mobility is None and not any(elements.hard for elements in others):
            self._limit = [model.kernel(each, model.dtype) for each in (add_momentum, add_scaled, kernels.limit_pulls)]
            self._elastic, self._given, self._taken = Gradient(model, terms=others), model.vectors(), model.vectors()
        for now in self.pulls.found:
            before = kernels.collider_pulls(model.dtype)()
            now.move = model.vectors()
            if self._at_end:
                before.all, before.friction = model.vectors(), model.vectors() if now.friction else None
                before.move = model.vectors()
            self._before.append(before)
        self._half_way = None
        if colliders.part == 0.5:
            self._half_way, self._x_step = model.kernel(kernels.half_way, model.dtype), model.vectors()
        self._add = model.kernel(kernels.add_collider_work, model.dtype)
        self._rigid, meshes = model.kernel(kernels.rigid_moves, model.dtype), model.colliders.meshes
        self._deform = [] if meshes is None else meshes.deform
        self._surface = model.kernel(kernels.surface_moves, model.dtype) if self._deform else None

    def begin(self, found, vertices):
        """Sets the state before the first step from the pulls ``found``, of which it takes the slice ``vertices``."""
        if self._at_end:
            for before, now in zip(self._before, found, strict=True):
                wp.copy(before.all, now.all[vertices])
                if before.friction:
                    wp.copy(before.friction, now.friction[vertices])

    def launch(self):
        """Launches the sums after a step."""
        model, colliders = self.model, self.colliders
        if self._half_way:
            model.launch(self._half_way, model.count, [colliders.x_before, self._x], [self._x_step])
        self.pulls.launch(self._x_step)
        if self._limit:
            self._launch_limit()
        for c, (now, before) in enumerate(zip(self.pulls.found, self._before, strict=True)):
            self._launch_moves(c, self._x_step, colliders.poses.at, int(2.0 * colliders.part), now.move)
            if self._at_end:
                self._launch_moves(c, colliders.x_before, colliders.poses.before, 0, before.move)
            given = [colliders.x_before, self._x, self._cuts, now, model.colliders.distance]
            model.launch(self._add, model.count, given, [before, *self._sums])

    def _launch_limit(self):
        """Limits the contact forces of an unconverged step by f = −M(x − x̃)/hₑ² − ∇U of all other terms."""
        model, (momentum, add, limit) = self.model, self._limit
        self._given.zero_()
        self._taken.zero_()
        self._elastic.add(self._x_step, self._given)
        he = self.colliders.he
        model.launch(momentum, model.count, [model.mass, self.colliders.correction, 1.0 / he**2], [self._given])
        for now in self.pulls.found:
            model.launch(add, model.count, [now.all, 1.0], [self._taken])
        for now in self.pulls.found:
            model.launch(limit, model.count, [self._given, self._taken], [now])

    def _launch_moves(self, c, x, poses, when, out):
        """Launches out = displacements of the material of collider c at x, ``when`` half steps after the start of the step."""
        model, colliders = self.model, self.colliders
        if c in self._deform:
            meshes = colliders.meshes
            given = [meshes.geometry, x, poses, meshes.motion, when, c, model.per_copy, meshes.lists]
            model.launch(self._surface, model.count, given, [out])
        else:
            model.launch(self._rigid, model.count, [x, poses, colliders.poses, c, model.per_copy], [out])


class FilterWork:
    """Sums the energy that the collider filter adds to the cloth of one stepper, see :meth:`launch`.

    Args:
        stepper: The :class:`warpcloth.solvers.solver.Stepper`, with contact.
        of_filter: Sums per vertex, (N,) float64 [J].

    Attributes:
        uncut: Positions (N,) [m] after the last step without the filter.
        cuts: Whether the filter shortened the move of each vertex, (N,) int32, see
            :mod:`warpcloth.kernels.contact.collider_work`.
    """

    def __init__(self, stepper, of_filter):
        self._stepper, self.model, self._of_filter = stepper, stepper.colliders.model, of_filter
        model, sums = self.model, Sums(self.model)
        self.uncut, self.cuts = model.vectors(), wp.zeros(model.count, dtype=wp.int32, device=model.device)
        elastic = [elements for elements in model.terms if elements.collider is None and not elements.hard]
        self._elastic = Energy(model, sums, terms=elastic)
        self._present = PresentContact(model, [(stepper.colliders, 0, model.copies)])
        pairs = zip(model.terms, self._present.terms, strict=True)
        pairs = [(each, own) for each, own in pairs if each.collider is not None and not each.hard]
        contact = [own for each, own in pairs if each.term.law is None]
        self._contact = Energy(model, sums, terms=contact)
        self._before = [wp.zeros_like(each) for each in self._contact.of_elements]
        self._found, self._without, self._scratch = model.scalars(), model.scalars(), model.scalars()
        self._add, self._stored = model.kernel(kernels.add_filter_work, model.dtype), kernels.add_stored

    def begin(self):
        """Begins from the present state."""
        self.cuts.zero_()
        for array in (self._stepper.colliders.pushed, self._stepper.colliders.kicked):
            array.zero_()
        self._launch_contact()
        for before, now in zip(self._before, self._contact.of_elements, strict=True):
            wp.copy(before, now)

    def launch(self):
        """Launches the sums after a step: ½Σ m v² − Σ (m g + f)·x + U without contact, minus that of the unfiltered step.

        The change of the contact energy in a filtered step, minus the work of contact along the unfiltered step, is also work
        of the filter. :class:`ColliderWork` adds the latter.
        """
        model, colliders, (x, v) = self.model, self._stepper.colliders, self._stepper.state
        force = None if model.loads is None else model.loads.force
        given = [model.mass, model.gravity, model.per_copy, x, v, force]
        out = [colliders.pushed, colliders.kicked, self.uncut, self.cuts, self._of_filter]
        model.launch(self._add, model.count, given, out)
        self._elastic.add(x, self._found)
        self._elastic.add(self.uncut, self._without)
        self._launch_contact()
        for elements, before, now in zip(self._contact.terms, self._before, self._contact.of_elements, strict=True):
            model.launch(self._stored, elements.count, [elements.stencil, now, self.cuts], [before, self._of_filter])

    def _launch_contact(self):
        self._present.launch(*self._stepper.state)
        self._contact.add(self._stepper.state.x, self._scratch)

    def elastic(self):
        """Returns the part of the sums from U without contact, (B,) [J], and resets it to 0."""
        found = self._found.numpy() - self._without.numpy()
        for array in (self._found, self._without):
            array.zero_()
        return found
