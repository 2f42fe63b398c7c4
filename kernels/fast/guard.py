"""The part of explicit steps that handles contact with colliders, which steps without colliders leave out."""

from collections.abc import Callable
from dataclasses import dataclass

import warp as wp


@dataclass(frozen=True)
class ContactFactories:
    """Factories of contact with colliders in the kernels of explicit steps, which are those of :mod:`.contact_guard`.

    Attributes:
        struct: (dtype) → the struct of its data.
        in_ball: (dtype, moving) → device function, whether a step is without contact; ``moving``: some colliders move.
        touching_step: (dtype, symplectic) → device function, a step with contact.
    """

    struct: Callable
    in_ball: Callable
    touching_step: Callable

    def functions(self, dtype, symplectic: bool, moving: bool):
        return self.in_ball(dtype, moving), self.touching_step(dtype, symplectic)


@wp.struct
class NoGuard:
    """Struct of steps without colliders, which has fewer parameters."""

    per_copy: int


def guard_type(dtype, contact: ContactFactories | None):
    """The struct of contact, or :class:`NoGuard` without."""
    return NoGuard if contact is None else contact.struct(dtype)
