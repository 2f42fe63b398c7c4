"""Coulomb's law of friction: a spring to an anchor that yields at the force μN.

Per stiffness k [N/m], its energy is the Huber function H of the length l of its stretch u, ε = μN/k:

    H = ½l²  for l ≤ ε,   εl − ½ε²  beyond;     force kH′u/l;     second derivatives kH″ along u and kH′/l across

Where a step begins, the anchor follows to a distance of ε, so a spring at rest does not creep (Cundall and Strack 1979, *A
discrete numerical model for granular assemblies*). N and the normal are constant in a step.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import warp as wp


@wp.func
def coulomb_limit(push: Any, friction: Any):
    """ε of a push N/k above 0."""
    return friction * push


@wp.func
def huber_energy(l: Any, limit: Any):
    """H."""
    held = wp.min(l, limit)
    return held * (l - type(l)(0.5) * held)


@wp.func
def huber_secant(l: Any, limit: Any):
    """H′/l, 1 where l is 0."""
    return wp.where(l > limit, limit / wp.max(l, limit), type(l)(1.0))


@wp.func
def huber_bend(l: Any, limit: Any):
    """H″."""
    return wp.where(l > limit, type(l)(0.0), type(l)(1.0))


@wp.func
def huber_prox(l: Any, limit: Any, compliance: Any):
    """The fraction f of u by which u* = (1 − f) u minimises H(l*) + (l* − l)²/2c, l > 0."""
    one = type(l)(1.0)
    return wp.min(one / (one + one / compliance), compliance * limit / l)


@dataclass(frozen=True)
class Law:
    """A law of friction, as device functions.

    Attributes:
        name: Its name in the modules of kernels.
        limit: (N/k, μ) → ε, for N above 0.
        energy: (l, ε) → H.
        secant: (l, ε) → H′/l, at most 1.
        bend: (l, ε) → H″, at most 1.
        prox: (l, ε, c) → the fraction of u that the prox takes away.
        kept: (l, ε) → the fraction of u that remains when the anchor follows, 1 before it yields.
    """

    name: str
    limit: Any = coulomb_limit
    energy: Any = huber_energy
    secant: Any = huber_secant
    bend: Any = huber_bend
    prox: Any = huber_prox
    kept: Any = huber_secant


COULOMB = Law("coulomb")


class Friction(float):
    """A coefficient μ of friction with a law. Another law is a subclass; a plain number is Coulomb's."""

    law: ClassVar[Law] = COULOMB


def law_of(friction):
    """Returns the :class:`Law` of a coefficient of friction."""
    return friction.law if isinstance(friction, Friction) else COULOMB
