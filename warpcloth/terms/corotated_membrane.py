"""The corotated membrane."""

from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from ..kernels.term import Term
from ..kernels.terms.corotated_membrane import COROTATED_MEMBRANE
from .membrane import Membrane, membrane_stiffness

Own = TypeVar("Own", bound="CorotatedMembrane")


@dataclass(frozen=True, kw_only=True)
class CorotatedMembrane(Membrane):
    """A corotated membrane with Poisson's ratio 0, U = Σ ½kA‖F − R‖², F = RU the polar decomposition (Chao et al. 2010).

    F (3×2) is the deformation gradient and A the rest area of a triangle. The stress is linear in the stretch U.

    Attributes:
        stiffness: k = Et = 2μ [N/m], Young's modulus times thickness, one or (T,); ``math.inf`` for solvers that take hard
            constraints.
        damping: β [N·s/m], one or (T,): a stress βĖ, E the Green strain ½(FᵀF − I).
    """

    term: ClassVar[Term] = COROTATED_MEMBRANE
    material: ClassVar[str] = "corotated"

    @classmethod
    def from_material(cls: type[Own], youngs_modulus: float, thickness: float, **fields: Any) -> Own:
        """Returns the membrane of a material with E [Pa], ν = 0 and thickness t [m]."""
        return cls(stiffness=membrane_stiffness(cls, youngs_modulus, thickness), **fields)
