"""The test whether a step may come near colliders that stand."""

import numpy as np
import warp as wp

from ..core.filled import filled
from ..kernels.contact.clearance import clearances, near_colliders
from ..kernels.contact.colliders import filters, shapes


class Clearance:
    """Tells the steps in which vertices may come near a collider. In others contact has no force, and the filter no effect.

    Attributes:
        near: 1 for copies in which a vertex may come near a collider in this step, (B,) int32.
    """

    def __init__(self, colliders, state):
        self._h, self.model = colliders.h, colliders.model
        model, device = self.model, self.model.device
        balls = np.zeros((model.count, 4))
        balls[:, 3] = -1.0
        if model.pins is None:
            balls[model.inverse_mass.numpy() == 0.0, 3] = np.inf  # pins may stand near
        followed, self._due, self._ended = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(3))
        self.near = model.scalars(wp.int32)
        self._clear = filled(
            clearances(model.dtype),
            before=state.add("near colliders", model.scalars(wp.int32)),
            near=self.near,
            # Rest states may also be those near colliders because the state was set to another one.
            some=wp.full(1, 1, dtype=wp.int32, device=device),
            followed=followed,
            balls=model.array(balls, wp.types.vector(4, model.dtype)),
            distance=model.colliders.distance,
        )
        halves, bounding = zip(*(collider.centred().bounds for collider in model.scene.colliders), strict=True)
        core, radius = model.array(np.array(halves), model.vec3), model.array(bounding, model.dtype)
        bounds = filled(shapes(model.dtype), core=core, radius=radius)
        self._bounds = filled(filters(model.dtype), shape=bounds, poses=colliders.poses, per_copy=model.per_copy)
        self._find_near = model.kernel(near_colliders, model.dtype)

    def follow(self):
        """Makes all steps refresh contact."""
        self._clear.followed.fill_(1)

    def launch_begin(self, x, v):
        """Launches the test at x with v, (N,)."""
        wp.copy(self._due, self._clear.some)
        self._clear.some.zero_()
        self.near.zero_()
        self._find(x, v, None, self._due)
        wp.copy(self._clear.before, self.near)

    def launch_refresh(self, launch):
        wp.capture_if(self._due, launch)

    def launch_end(self, x, end, launch):
        """Calls ``launch`` if a vertex may have come near a collider between x and ``end`` (N,)."""
        wp.copy(self._ended, self._due)
        self._find(x, None, end, self._ended)
        wp.capture_if(self._ended, launch)

    def _find(self, x, v, end, due):
        given = [self._bounds, *self.model.free_gravity, x, v, end, self._h]
        self.model.launch(self._find_near, self.model.count, given, [self._clear, due])
