"""The stable Neo-Hookean membrane."""

from dataclasses import dataclass
from typing import ClassVar

from ..kernels.term import Term
from ..kernels.terms.neo_hookean_membrane import NEO_HOOKEAN_MEMBRANE
from .membrane import IsotropicMembrane


@dataclass(frozen=True, kw_only=True)
class NeoHookeanMembrane(IsotropicMembrane):
    """A stable Neo-Hookean membrane, U = Σ A(½μ(‖F‖² − 2) − μ(J − 1) + ½(λ + μ)(J − 1)²) (Smith, De Goes and Kim 2018).

    F (3×2) = [f₁, f₂] is the deformation gradient, J = ‖f₁×f₂‖, and A the rest area of a triangle. A triangle recovers from any
    deformation.

    Attributes:
        stiffness: k = Et [N/m], Young's modulus times thickness at small strain, one or (T,). μ = k/(2(1 + ν)), λ = kν/(1 −
            ν²).
        poisson_ratio: ν, above −1 and below 1, one or (T,).
        damping: β [N·s/m], one or (T,): a stress βĖ, E the Green strain ½(FᵀF − I).
    """

    term: ClassVar[Term] = NEO_HOOKEAN_MEMBRANE
    material: ClassVar[str] = "neo-hookean"
