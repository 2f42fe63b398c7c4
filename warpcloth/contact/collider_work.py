"""The work of moving colliders and the work against friction, summed over steps."""

import warp as wp

from ..kernels import work as kernels
from .present import ColliderPulls


class ColliderWork:
    """Sums the works of the steps of one stepper, with the forces that its steps took.

    Args:
        colliders: The :class:`warpcloth.contact.collider_steps.ColliderSteps` of the stepper.
        terms: The elements as its steps take them.
        x: Its positions (N,) [m].
        of_colliders, against_friction: Sums of each vertex, (N,) float64 [J].
        hard: See :class:`warpcloth.contact.present.ColliderPulls`.
    """

    def __init__(self, colliders, terms, x, of_colliders, against_friction, hard=None):
        self.colliders, self.model, self._x, model = colliders, colliders.model, x, colliders.model
        for c in [] if model.colliders.meshes is None else model.colliders.meshes.deform:
            label = model.scene.colliders[c].label
            raise ValueError(
                f"the collider {label} deforms, the work of which is not recorded; move it as a rigid body, or leave record out"
            )
        self._sums, self._at_end = [of_colliders, against_friction], colliders.part == 1.0
        self.pulls = ColliderPulls(model, terms, hard)
        self._before, self._x_step = [], x if self._at_end else colliders.x_before
        for found in self.pulls.found:
            before = kernels.pulls(model.dtype)()
            if self._at_end:
                before.all, before.friction = model.vectors(), model.vectors() if found.friction else None
            self._before.append(before)
        self._half_way = None
        if colliders.part == 0.5:
            self._half_way, self._x_step = model.kernel(kernels.half_way, model.dtype), model.vectors()
        self._add = model.kernel(kernels.add_collider_work, model.dtype, self._at_end)

    def begin(self, found, vertices):
        """Begins where the pulls are ``found``, of which it has those in the slice ``vertices``."""
        if self._at_end:
            for before, now in zip(self._before, found, strict=True):
                wp.copy(before.all, now.all[vertices])
                if before.friction:
                    wp.copy(before.friction, now.friction[vertices])

    def launch(self):
        """Launches the sums, after a step."""
        model, colliders = self.model, self.colliders
        if self._half_way:
            model.launch(self._half_way, model.count, [colliders.x_before, self._x], [self._x_step])
        self.pulls.launch(self._x_step)
        for c, (now, before) in enumerate(zip(self.pulls.found, self._before, strict=True)):
            given = [colliders.x_before, self._x, self._x_step, now, colliders.poses, c, model.per_copy]
            model.launch(self._add, model.count, given, [before, *self._sums])
