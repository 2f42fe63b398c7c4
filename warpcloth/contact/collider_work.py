"""The work of moving colliders and the work against friction, both summed over steps."""

import warp as wp

from ..kernels import work as kernels
from ..kernels.mesh_colliders import surface_moves
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
        self._sums, self._at_end = [of_colliders, against_friction], colliders.part == 1.0
        self.pulls = ColliderPulls(model, terms, hard)
        self._before, self._x_step = [], x if self._at_end else colliders.x_before
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
        self._surface = model.kernel(surface_moves, model.dtype) if self._deform else None

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
            self._launch_moves(c, self._x_step, colliders.poses.at, int(2.0 * colliders.part), now.move)
            if self._at_end:
                self._launch_moves(c, colliders.x_before, colliders.poses.before, 0, before.move)
            given = [colliders.x_before, self._x, now, model.colliders.distance]
            model.launch(self._add, model.count, given, [before, *self._sums])

    def _launch_moves(self, c, x, poses, when, out):
        """The moves of the material of collider c at positions x, half steps after the step began."""
        model, colliders = self.model, self.colliders
        if c in self._deform:
            meshes = colliders.meshes
            given = [meshes.geometry, x, poses, meshes.motion, when, c, model.per_copy, meshes.lists]
            model.launch(self._surface, model.count, given, [out])
        else:
            model.launch(self._rigid, model.count, [x, poses, colliders.poses, c, model.per_copy], [out])
