"""Coulomb's law of friction, for colliders and self-contact: a spring to an anchor that yields at the force μN.

Per stiffness k [N/m], its energy is the Huber function H of the length l of its stretch u, with ε = μN/k:

    H = ½l²  for l ≤ ε,   εl − ½ε²  beyond;     force kH′u/l;     second derivatives kH″ along u and kH′/l across

The anchor follows to a distance of ε where a step begins, so that a spring at rest keeps its stretch and does not creep
(Cundall and Strack 1979, *A discrete numerical model for granular assemblies*). N and the normal are constant in a step.
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
    """The fraction f of u by which u* = (1 − f) u, of the length l* that minimises H(l*) + (l* − l)²/2c. l is above 0."""
    one = type(l)(1.0)
    return wp.min(one / (one + one / compliance), compliance * limit / l)


@dataclass(frozen=True)
class Law:
    """A law of friction: how far a spring stretches before it yields, and its energy per stiffness, by these device functions.

    Attributes:
        name: Its name in the modules of kernels.
        limit: (N/k, μ) → ε, for N above 0.
        energy: (l, ε) → H.
        secant: (l, ε) → H′/l, at most 1.
        bend: (l, ε) → H″, at most 1.
        prox: (l, ε, c) → the fraction of u that the prox of compliance c takes away.
        kept: (l, ε) → the fraction of u that remains when the anchor follows; 1 for a spring that has not yielded.
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
    """A coefficient μ of friction with a law. Another law is a subclass; a plain number has that of Coulomb."""

    law: ClassVar[Law] = COULOMB


def law_of(friction):
    """Returns the :class:`Law` of a coefficient of friction."""
    return friction.law if isinstance(friction, Friction) else COULOMB
