"""Energies of contact, and forces on colliders, in the current state of a solver."""

from dataclasses import replace
from functools import partial

import numpy as np
import warp as wp

from ..core.filled import filled
from ..core.gradient import Gradient
from ..kernels.contact import colliders as kernels
from ..kernels.contact.anchors import anchor_vertices
from ..kernels.contact.collider_work import collider_pulls
from .collider_steps import launch_anchors, launch_pose


class PresentContact:
    """The elements of a model for the current poses of colliders, and the anchors of the next step.

    Args:
        parts: Tuples (:class:`.ColliderSteps`, first copy, last copy + 1); empty for colliders at their start.

    Attributes:
        terms: The elements of all terms.
    """

    def __init__(self, model, parts=()):
        self.model, self._parts, self._launches = model, parts, []
        self.terms = model.terms
        if not parts:
            return
        declared, steps = model.colliders, parts[0][0]
        pose_type, self._anchor_type = kernels.pose_types(model.dtype)
        self._dim, self._steps = (model.copies, len(declared.radius)), model.scalars(wp.int32)
        at, after = (wp.zeros(self._dim, dtype=pose_type, device=model.device) for _ in range(2))
        poses = filled(kernels.step_poses(model.dtype), before=at, at=at, after=at)
        values = {"shape": steps.shapes, "poses": poses, "per_copy": model.per_copy, "least": steps.least}
        self._colliders = filled(kernels.filters(model.dtype), **values)
        self._moved = filled(kernels.step_poses(model.dtype), before=at, at=at, after=after)  # the last are not read
        self._given = [declared.keyframes, declared.firsts, self._steps, steps.steps_per_frame, 0]
        self._move = model.kernel(kernels.move_colliders, model.dtype)
        self.terms = tuple(elements if elements.collider is None else self._own(elements, steps) for elements in model.terms)

    def _own(self, elements, steps):
        model, c = self.model, elements.collider
        term = elements.term.bounded if steps.bounded else elements.term
        own, solids = replace(elements, term=term, rest=wp.clone(elements.rest)), model.colliders.solids
        if elements.term.law:
            anchors = wp.zeros(model.count, dtype=self._anchor_type, device=model.device)
            kernel = model.kernel(anchor_vertices, model.dtype, solids, elements.term.law, steps.bounded)
            self._launches.append(partial(self._anchor, kernel, own, anchors))
        elif model.colliders.moves[c]:
            self._launches.append(partial(self._pose, model.kernel(kernels.pose_collider, model.dtype, solids), own))
        return own

    def launch(self, x, v):
        """Launches the rest states at x (N,) [m] and v (N,) [m/s]."""
        if not self._launches:
            return
        for steps, first, end in self._parts:
            wp.copy(self._steps, steps.steps, first, 0, end - first)
        self.model.launch(self._move, self._dim, self._given, [self._moved])
        for launch in self._launches:
            launch(x, v)

    def _pose(self, kernel, own, x, v):
        launch_pose(kernel, self._colliders, 0.0, x, v, self.model, own)

    def _anchor(self, kernel, own, anchors, x, _v):
        n = self.model.per_copy
        for steps, first, end in self._parts:
            wp.copy(anchors, steps.anchors[own.collider], first * n, 0, (end - first) * n)
        launch_anchors(kernel, self._colliders, anchors, x, self.model, own)


class ColliderPulls:
    """∂U/∂x of contact and friction with each collider, the force of the cloth on it.

    Args:
        terms: Elements; those of soft contact and of friction are used.
        hard: Function (index) → launcher that adds ∂U/∂x of hard contact with that collider to an array (N,), or None.
        pairs: The :class:`.SelfSteps` with the pairs of cloth and meshes; None leaves the pulls of meshes 0.

    Attributes:
        found: A :func:`warpcloth.kernels.contact.collider_work.collider_pulls` for each collider.
        solid: The indices of the colliders that are not meshes.
    """

    def __init__(self, model, terms, hard=None, pairs=None):
        self.found, self._adds, self.hard = [], {}, any(each.hard for each in terms if each.collider is not None)
        self._pairs, scene = pairs, model.scene
        self.solid = [c for c in range(len(scene.colliders)) if c not in scene.meshes]
        for collider in scene.colliders:
            friction = model.vectors() if collider.friction else None
            self.found.append(filled(collider_pulls(model.dtype), all=model.vectors(), friction=friction))
        for c in self.solid:
            mine = [elements for elements in terms if elements.collider == c]
            friction = tuple(elements for elements in mine if elements.term.law)
            contact = tuple(elements for elements in mine if elements not in friction)
            add = None if self.hard else Gradient(model, terms=contact)
            hidden = hard(c) if hard and self.hard else None
            self._adds[c] = add, Gradient(model, terms=friction) if friction else None, hidden

    def launch(self, x):
        """Launches ∂U/∂x at x (N,). The pairs must be those there."""
        self._launch_meshes(x)
        for c, (contact, friction, hidden) in self._adds.items():
            found = self.found[c]
            found.all.zero_()
            if contact is not None:
                contact.add(x, found.all)
            if hidden is not None:
                hidden(found.all)
            if friction is not None:
                friction.add(x, found.all)
                found.friction.zero_()
                friction.add(x, found.friction)

    def _launch_meshes(self, x):
        pairs = self._pairs
        for c, found in enumerate(self.found):
            if c in self._adds or pairs is None:
                continue
            pairs.forces.launch(x)
            pairs.keep(c)
            found.all.zero_()
            pairs.forces.add_gradient(found.all)
            if found.friction:
                found.friction.zero_()
                pairs.friction.add_gradient(found.friction)

    def sums(self, copies):
        """Forces of the cloth on the colliders: total, and the part of friction, (B, C, 2, 3) [N]."""

        def of(array):
            return array.numpy().astype(np.float64).reshape(copies, -1, 3).sum(axis=1) if array else np.zeros((copies, 3))

        return np.stack([np.stack([of(each.all), of(each.friction)], axis=1) for each in self.found], axis=1)
