"""A law of friction from outside the package: sheets stick also without weight, and springs are soft."""

from typing import Any, ClassVar

import warp as wp

from warpcloth.kernels.coulomb import Friction, Law

EXTRA = 2e-5  # stretch that a spring bears without weight [m]
SOFTNESS = 0.5  # stiffness of a spring over that of contact


@wp.func
def limit(push: Any, friction: Any):
    return friction * push + type(push)(wp.static(EXTRA))


@wp.func
def energy(l: Any, limit: Any):
    s = type(l)(wp.static(SOFTNESS))
    held = wp.min(l, limit / s)
    return s * held * (l - type(l)(0.5) * held)


@wp.func
def secant(l: Any, limit: Any):
    s = type(l)(wp.static(SOFTNESS))
    return wp.where(s * l > limit, limit / wp.max(s * l, limit), type(l)(1.0)) * s


@wp.func
def bend(l: Any, limit: Any):
    s = type(l)(wp.static(SOFTNESS))
    return wp.where(s * l > limit, type(l)(0.0), s)


@wp.func
def prox(l: Any, limit: Any, compliance: Any):
    one = type(l)(1.0)
    return wp.min(one / (one + one / (type(l)(wp.static(SOFTNESS)) * compliance)), compliance * limit / l)


@wp.func
def kept(l: Any, limit: Any):
    return secant(l, limit) / type(l)(wp.static(SOFTNESS))


class Sticky(Friction):
    """μ of sheets whose friction is μN and more."""

    law: ClassVar[Law] = Law("sticky", limit, energy, secant, bend, prox, kept)
