"""Contact with colliders inside the kernels of explicit steps."""

import numpy as np
import warp as wp

from ..core.filled import filled
from ..kernels.contact.collider_filter import note_fixed
from ..kernels.copy import copy_chosen
from ..kernels.fast import contact_guard as kernels
from ..model.host_values import host_values
from ..terms.refresh import STEP, Moment
from .structs import int32_array


class ContactGuard:
    """Collider contact in the kernels of explicit steps, see :mod:`warpcloth.kernels.fast.contact_guard`.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        colliders: The :class:`warpcloth.contact.collider_steps.ColliderSteps`.

    Attributes:
        kernels: The :class:`warpcloth.kernels.fast.guard.ContactFactories` that steps take.
        data: The struct of the kernels.
        terms: The elements of the other terms.
        moving: Whether a collider or a pin moves.
        followed: Whether contact terms are refreshed at the start of a step, because others read them.
    """

    kernels = kernels.CONTACT_GUARD

    def __init__(self, model, colliders):
        self.model, self.colliders, declared = model, colliders, model.colliders
        self.terms = tuple(elements for elements in model.terms if elements.collider is None)
        self.moving, self.followed = any(declared.moves) or model.pins is not None, False
        fixed = np.flatnonzero(model.inverse_mass.numpy() == 0.0) if self.moving else []
        self._fixed, self._numbers = (int32_array(each, model.device) for each in (fixed, np.arange(len(fixed))))
        self._fixed_before = wp.zeros(len(fixed), dtype=model.vec3, device=model.device)
        self._copy, self._note = model.kernel(copy_chosen, model.dtype), model.kernel(note_fixed, model.dtype, declared.solids)
        self._contact = [elements for elements in model.terms if elements.collider is not None]
        stiffness = np.zeros((len(declared.moves), model.count))
        for elements in self._contact:
            areas = elements.rest.numpy()[:, -1]
            stiffness[elements.collider, host_values(elements.stencil)[:, 0]] = host_values(elements.stiffness) * areas
        balls = np.zeros((model.count, 4))
        balls[:, 3] = np.where(model.inverse_mass.numpy() > 0.0, -1.0, np.inf)
        self.data = filled(
            kernels.guard_struct(model.dtype),
            filter=colliders.filter,
            stiffness=model.array(stiffness, model.dtype),
            anchors=colliders.anchor_rows,
            balls=model.array(balls, wp.types.vector(4, model.dtype)),
            found=wp.zeros(model.count, dtype=wp.int32, device=model.device),
            steps=colliders.steps,
            notes=colliders.notes,
            per_copy=model.per_copy,
            distance=declared.distance,
            drift=colliders.drift,
        )
        colliders.launch_move()

    def follow(self):
        """Makes steps refresh the contact terms too."""
        self.followed = True
        self.data.notes = self.colliders.notes
        self.colliders.follow()

    def launch_start(self, x):
        """Launches the motion of colliders at the start of a step from x (N,)."""
        if self.followed:
            with self.colliders.reading_anchors():
                self.model.refresh(STEP, Moment(x), self._contact)
        elif self.moving:
            self.colliders.launch_move()
        if len(self._fixed):
            self.model.launch(self._copy, len(self._fixed), [self._fixed, self._numbers, x], [self._fixed_before])

    def launch_end(self, x):
        """Launches, after pins have moved, the notes of pins inside colliders, and the step count if kernels do not count."""
        colliders, model = self.colliders, self.model
        if len(self._fixed):
            given = [self._fixed, colliders.filter, self._fixed_before, x]
            model.launch(self._note, len(self._fixed), given, [colliders.notes])
        if self.moving:
            colliders.launch_count()
