"""A shape of collider from outside the package, by its signed distance."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import warp as wp

from warpcloth.kernels.terms.contact import Solid
from warpcloth.scene.colliders import Collider

TILTED = (0.18257419, 0.36514837, 0.54772256, 0.73029674)  # a unit quaternion


@wp.func
def torus(X: Any, half: Any, radius: Any):
    zero = type(radius)(0.0)
    ring = wp.vector(X[0], zero, X[2])
    l = wp.length(ring)
    if l == zero:
        ring = wp.vector(type(radius)(1.0), zero, zero)
        l = type(radius)(1.0)
    away = X - half[0] / l * ring
    return wp.length(away) - radius, wp.normalize(away)


@dataclass(frozen=True, eq=False, kw_only=True)
class Torus(Collider):
    """A tube about a circle of a radius about the y axis."""

    solid: ClassVar[Solid] = Solid(torus, convex=False)
    radius: float
    tube: float

    @property
    def core(self):
        return np.array([self.radius, 0.0, self.radius]), self.tube
