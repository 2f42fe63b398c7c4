"""How cloth touches itself."""

from dataclasses import dataclass

from ..base.checks import number


@dataclass(frozen=True)
class SelfContact:
    """How cloth touches itself and other pieces of cloth: as it touches colliders, see :class:`warpcloth.Contact`.

    U = Σ kA φ(d) over pairs of a vertex and a triangle and pairs of edges at the distance d, see
    :mod:`warpcloth.kernels.self_contact`. In one connected piece the contact distance of a pair is at most half of its distance
    at rest, so that neighbours do not push one another, and pairs that share a vertex do not touch. At the end of each step a
    filter cuts short what would cross: no step ends with cloth that went through cloth.

    Attributes:
        distance: Contact distance r [m].
        stiffness: k [Pa/m]. By default 10 w/r with the weight w of the cloth per area, so that the weight of one layer leaves a
            gap of 0.9 r.

    Raises:
        ValueError: If a value breaks a rule.
    """

    distance: float = 1e-3
    stiffness: float | None = None

    def __post_init__(self) -> None:
        number("self_contact.distance", self.distance, above=0.0)
        if self.stiffness is not None:
            number("self_contact.stiffness", self.stiffness, above=0.0)
