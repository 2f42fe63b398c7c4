"""Contact of cloth with itself."""

from dataclasses import dataclass
from typing import Literal

from ..base.checks import choice, keep_plain, number
from ..base.types import Converted, default

HELD = ("fail", "allow")


@dataclass(frozen=True)
class SelfContact:
    """Contact of cloth with itself and with other pieces of cloth, with the φ of :class:`warpcloth.Contact`.

    The energy is U = Σᵥ ½ k aᵥ Σ_F m φ(d(v, F)) + Σ k (π/2) bₑ b_f φ(4 D(e, f)), over vertices v and faces, edges and vertices
    F near v, and over pairs of edges e and f (:mod:`warpcloth.kernels.contact.pair_potential`). :class:`warpcloth.Explicit`
    leaves out the second sum. Elements with a common vertex, or of one piece and nearer than 2r at rest, have no energy. A
    filter at the end of each step shortens moves that would cross, so cloth never passes through cloth. A start in which cloth
    crosses cloth is refused. Pieces that touch at the start are moved apart along normals, by at most r.

    Attributes:
        distance: Contact distance r [m]; by default the thickness of the scene, or 1 mm without one.
        stiffness: k [Pa/m], by default that of :class:`warpcloth.Contact`.
        friction: Coefficient μ of friction.
        held_pins: Whether a run in which cloth holds pins back from their keyframes is unusable, ``"fail"``, or may be usable,
            ``"allow"``.

    Raises:
        ValueError: A value is not allowed.
    """

    distance: Converted[float | None, float] = default(None)
    stiffness: float | None = None
    friction: float = 0.0
    held_pins: Literal["fail", "allow"] = "fail"

    def __post_init__(self) -> None:
        keep_plain(self)
        if self.distance is not None:
            number("self_contact.distance", self.distance, above=0.0)
        if self.stiffness is not None:
            number("self_contact.stiffness", self.stiffness, above=0.0)
        number("self_contact.friction", self.friction, least=0.0)
        choice("self_contact.held_pins", self.held_pins, HELD)
