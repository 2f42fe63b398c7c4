"""Coulomb's law of friction, for colliders and self-contact: a spring to an anchor that yields at the force μN.

Per stiffness k [N/m], its energy is the Huber function H of the length l of its stretch u, with ε = μN/k:

    H = ½l²  for l ≤ ε,   εl − ½ε²  beyond;     force kH′u/l;     second derivatives kH″ along u and kH′/l across

The anchor follows to a distance of ε where a step begins, so that a spring at rest keeps its stretch and does not creep
(Cundall and Strack 1979, *A discrete numerical model for granular assemblies*). N and the normal are constant in a step.
"""

from typing import Any

import warp as wp


@wp.func
def huber_energy(l: Any, limit: Any):
    """H."""
    held = wp.min(l, limit)
    return held * (l - type(l)(0.5) * held)


@wp.func
def huber_secant(l: Any, limit: Any):
    """H′/l, 1 where l is 0. It is also the fraction of u that remains when the anchor follows."""
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
