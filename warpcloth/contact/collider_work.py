"""Work of colliders, against friction, and of the filter."""

import warp as wp

from ..core.energy import Energy
from ..core.filled import filled
from ..core.gradient import Gradient
from ..core.sums import Sums
from ..kernels.contact import collider_work as kernels
from ..kernels.project import add_momentum
from ..kernels.work import add_rubbing_work, add_scaled
from .present import ColliderPulls, PresentContact


def launch_mean(model, a, b, out):
    out.zero_()
    for each in (a, b):
        model.launch(model.kernel(add_scaled, model.dtype), model.count, [each, 0.5], [out])


class ColliderWork:
    """Sums the work of colliders but meshes over steps.

    Args:
        terms: The elements as its steps take them.
        cuts: The :class:`FilterWork` of the stepper, which must be launched before.
        of_colliders, against_friction, of_filter: Sums per vertex, (N,) float64 [J].
        hard: See :class:`.ColliderPulls`.
    """

    def __init__(self, colliders, terms, cuts, of_colliders, against_friction, of_filter, hard=None):
        self.colliders, self.model, self._x, model = colliders, colliders.model, cuts.uncut, colliders.model
        self._sums, self._at_end, self._cuts = [of_colliders, against_friction, of_filter], colliders.part == 1.0, cuts.cuts
        self.pulls = ColliderPulls(model, terms, hard)
        self._solid = [(c, self.pulls.found[c]) for c in self.pulls.solid]
        self._before, self._x_step = [], self._x if self._at_end else colliders.x_before
        others, self._limit = [elements for elements in terms if elements.collider is None], None
        if colliders.correction is not None and model.mobility is None and not any(elements.hard for elements in others):
            self._limit = [model.kernel(each, model.dtype) for each in (add_momentum, add_scaled, kernels.limit_pulls)]
            self._elastic, self._given, self._taken = Gradient(model, terms=others), model.vectors(), model.vectors()
        for _c, now in self._solid:
            kept = [name for name in ("all", "friction") if self._at_end and getattr(now, name)]
            self._before.append(filled(kernels.collider_pulls(model.dtype), **{name: model.vectors() for name in kept}))
        if colliders.part == 0.5:
            self._x_step = model.vectors()
        self._add = model.kernel(kernels.add_collider_work, model.dtype)

    def begin(self, found, vertices):
        """Sets the state before the first step from ``vertices`` of the pulls ``found``."""
        if self._at_end:
            for before, now in zip(self._before, (found[c] for c in self.pulls.solid), strict=True):
                wp.copy(before.all, now.all[vertices])
                if before.friction:
                    wp.copy(before.friction, now.friction[vertices])

    def launch(self):
        """Launches the sums after a step."""
        model, colliders = self.model, self.colliders
        if colliders.part == 0.5:
            launch_mean(model, colliders.x_before, self._x, self._x_step)
        self.pulls.launch(self._x_step)
        if self._limit:
            self._launch_limit()
        for (c, now), before in zip(self._solid, self._before, strict=True):
            given = [colliders.filter, colliders.x_before, self._x_step, self._x, self._cuts, now, c, model.colliders.distance]
            model.launch(self._add, model.count, given, [before, *self._sums])

    def _launch_limit(self):
        """Limits the contact forces of an unconverged step by f = −M(x − x̃)/hₑ² − ∇U of all other terms."""
        model, (momentum, add, limit) = self.model, self._limit
        self._given.zero_()
        self._taken.zero_()
        self._elastic.add(self._x_step, self._given)
        he = self.colliders.he
        model.launch(momentum, model.count, [model.mass, self.colliders.correction, 1.0 / he**2], [self._given])
        for _c, now in self._solid:
            model.launch(add, model.count, [now.all, 1.0], [self._taken])
        for _c, now in self._solid:
            model.launch(limit, model.count, [self._given, self._taken], [now])


class PairWork:
    """Sums the work of meshes on cloth, and the work against friction of pairs, over steps.

    Work is ∂U/∂y times the travel of the meshes in a step, y = Σ wᵢxᵢ of each pair.

    Args:
        against_friction: Sums per vertex of the cloth, (N,) float64 [J]. The part of meshes is in ``against_meshes``.

    Attributes:
        of_meshes, against_meshes: Sums for each collider, (B, C) float64 [J].
    """

    def __init__(self, stepper, against_friction):
        self._stepper, self._against, model = stepper, against_friction, stepper.model
        size = model.copies, len(model.scene.colliders)
        self.of_meshes, self.against_meshes = (wp.zeros(size, dtype=wp.float64, device=model.device) for _ in range(2))
        self._moves, self._x = any(model.scene.colliders[c].moves for c in model.scene.meshes), model.vectors()
        self._pulls, self._rub = model.vectors(), model.kernel(add_rubbing_work, model.dtype)

    def launch(self):
        stepper, pairs, x = self._stepper, self._stepper.pairs, self._stepper.state.x
        friction, acting = pairs.friction, self._positions(x)
        if self._moves:
            pairs.forces.launch(acting)
            pairs.launch_work(self.of_meshes, pairs.forces.terms)
        if friction is not None:
            friction.launch_acting(acting, self._pulls)
            stepper.model.launch(self._rub, stepper.model.count, [self._pulls, friction.start, x], [self._against])
            if self._moves:
                pairs.launch_work(self.against_meshes, [friction])

    def _positions(self, x):
        stepper, model, integrator = self._stepper, self._stepper.model, self._stepper.integrator
        if (integrator is not None and integrator.parts == 1) or not (self._moves or stepper.pairs.friction):
            return x
        start = stepper.pairs.friction.start if stepper.x_before is None else stepper.x_before
        if integrator is None:
            return start
        launch_mean(model, start, x, self._x)
        return self._x

    def sums(self):
        """Returns the work of meshes, and their part in the work against friction, (B,) [J], and resets both."""
        sums = self.of_meshes, self.against_meshes
        found = [array.numpy().sum(axis=1) for array in sums]
        for array in sums:
            array.zero_()
        return found


class FilterWork:
    """Sums the energy that the collider filter adds to the cloth.

    Args:
        of_filter: Sums per vertex, (N,) float64 [J].

    Attributes:
        uncut: Positions (N,) [m] after the last step without the filter.
        cuts: UNCUT, NOW or 1 for each vertex, (N,) int32.
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
        self.cuts.zero_()
        for array in (self._stepper.colliders.pushed, self._stepper.colliders.kicked):
            array.zero_()
        self._launch_contact()
        for before, now in zip(self._before, self._contact.of_elements, strict=True):
            wp.copy(before, now)

    def launch(self):
        """Launches the sums after a step: ½Σ m v² − Σ (m g + f)·x + U without contact, minus that of the unfiltered step."""
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
        """Returns the part of the sums from U without contact, (B,) [J], and resets it."""
        found = self._found.numpy() - self._without.numpy()
        for array in (self._found, self._without):
            array.zero_()
        return found
