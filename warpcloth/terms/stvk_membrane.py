"""The St. Venant–Kirchhoff membrane."""

from dataclasses import dataclass
from typing import ClassVar

from ..kernels.term import Term
from ..kernels.terms.stvk_membrane import STVK_MEMBRANE
from .membrane import IsotropicMembrane


@dataclass(frozen=True, kw_only=True)
class StVKMembrane(IsotropicMembrane):
    """A St. Venant–Kirchhoff membrane of triangles, U = Σ A(μ‖E‖² + ½λ(tr E)²), E = ½(FᵀF − I) the Green strain.

    F (3×2) is the deformation gradient and A the rest area of a triangle. It collapses under large compression.

    Attributes:
        stiffness: k = Et [N/m], Young's modulus times thickness at small strain, one or (T,). μ = k/(2(1 + ν)), λ = kν/(1 −
            ν²).
        poisson_ratio: ν, above −1 and below 1, one or (T,).
        damping: β [N·s/m], one or (T,): a stress βĖ.
    """

    term: ClassVar[Term] = STVK_MEMBRANE
    material: ClassVar[str] = "stvk"
