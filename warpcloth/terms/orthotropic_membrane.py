"""The membrane of woven fabrics."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, TypeVar

import numpy as np

from ..base.checks import numeric, refuse
from ..kernels.term import Term
from ..kernels.terms.orthotropic_membrane import ORTHOTROPIC_MEMBRANE
from ..mesh.mesh import Mesh
from .declared import FINITE
from .membrane import Membrane
from .woven import ABOVE_0, Woven

Own = TypeVar("Own", bound="OrthotropicMembrane")


@dataclass(frozen=True, kw_only=True)
class OrthotropicMembrane(Woven, Membrane):
    """A St. Venant–Kirchhoff membrane along warp and weft, U = Σ ½AεᵀCε.

    ε = (E₁₁, E₂₂, 2E₁₂) is the Green strain ½(FᵀF − I) along warp (1) and weft (2), and A the rest area of a triangle. With k₁
    = E₁t/(1 − ν₁₂ν₂₁), εᵀCε is k₁E₁₁² + (E₂/E₁)k₁E₂₂² + 2ν₂₁k₁E₁₁E₂₂ + 4GtE₁₂². It collapses under large compression. E₁ and E₂
    are moduli of strips that narrow freely.

    Attributes:
        stiffness: E₁t [N/m], Young's modulus along the warp times thickness, one or (T,).
        weft_ratio: E₂/E₁, one or (T,).
        poisson_ratio: ν₁₂, the narrowing of a strip along the warp, with ν₁₂² < E₁/E₂, one or (T,); ν₂₁ = ν₁₂E₂/E₁.
        shear_ratio: G/E₁, one or (T,). If None, G = √(E₁E₂)/2(1 + √(ν₁₂ν₂₁)), isotropic if E₁ = E₂.
        warp: Vector along the warp, (3,) or (T, 3), projected to each triangle; by default where the texture coordinate s grows
            and t does not.
        warp_angle: Angle [rad] from there to the warp in the triangle, counter-clockwise from the front, one or (T,).
        damping: β [N·s/m], one or (T,): a stress βĖ.

    Raises:
        ValueError: A value is not allowed, or the energy would not be positive definite.

    Examples:
        >>> import warpcloth as wc
        >>> denim = wc.OrthotropicMembrane.from_moduli(warp=1673.0, weft=3152.0, shear=1616.0, poisson_ratio=0.5)
        >>> denim.stiffness, round(denim.weft_ratio, 3)
        (1673.0, 1.884)
    """

    term: ClassVar[Term] = ORTHOTROPIC_MEMBRANE
    shearing: ClassVar[str] = "shear_ratio"

    poisson_ratio: float | Sequence[float] | np.ndarray = field(default=0.0, metadata=FINITE)
    shear_ratio: float | Sequence[float] | np.ndarray | None = field(default=None, metadata=ABOVE_0)

    def __post_init__(self):
        super().__post_init__()
        ratio, weft = self._numeric("poisson_ratio"), self._numeric("weft_ratio")
        if ratio.shape == weft.shape or not (ratio.ndim and weft.ndim):  # else one of them is refused on the mesh
            indefinite = ~(ratio**2 * weft < 1.0)
            rule = "must have a square below 1/weft_ratio, or the energy is not positive definite"
            refuse(f"{self.label}.poisson_ratio", np.broadcast_to(ratio, indefinite.shape), indefinite, rule)

    @classmethod
    def from_moduli(
        cls: type[Own],
        warp: float,
        weft: float,
        shear: float,
        poisson_ratio: float = 0.0,
        direction: Any = None,
        **fields: Any,
    ) -> Own:
        """Returns the membrane with E₁t, E₂t and Gt [N/m] and ν₁₂, numbers or (T,), and the warp along ``direction``.

        Raises:
            ValueError: E₁t, E₂t or Gt is not above 0, or ν₁₂² is not below E₁/E₂.
        """
        given = {"warp": warp, "weft": weft, "shear": shear}
        found = {name: numeric(f"{cls.__name__}.{name}", value, "be a number") for name, value in given.items()}
        for name, values in found.items():
            refuse(f"{cls.__name__}.{name}", values, ~((values > 0.0) & np.isfinite(values)), "must be finite and above 0")
        E1, E2, G = (values[()] for values in found.values())
        ratios = {"weft_ratio": E2 / E1, "shear_ratio": G / E1}
        return cls(stiffness=E1, **ratios, poisson_ratio=poisson_ratio, warp=direction, **fields)

    def isotropic(self: Own) -> Own:
        """Returns the isotropic membrane with √(E₁E₂)t and ν = √(ν₁₂ν₂₁)."""
        ratio = self._numeric("poisson_ratio") * np.sqrt(self._numeric("weft_ratio"))
        return replace(super().isotropic(), poisson_ratio=ratio[()])

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        T = len(stencil)
        weft, ratio = self.of_elements("weft_ratio", T), self.of_elements("poisson_ratio", T)
        shear = 0.5 * np.sqrt(weft) / (1.0 + ratio * np.sqrt(weft))
        if self.shear_ratio is not None:
            shear = self.of_elements("shear_ratio", T)
        return self.term.rest_state(mesh.points, stencil, self.warp_directions(mesh), weft, ratio, shear)
