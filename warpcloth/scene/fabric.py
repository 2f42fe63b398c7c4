"""Fabrics: measured moduli, from which energies follow."""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

import warpcloth.terms as energies

from ..base.checks import keep_plain, number, shown
from ..terms.declared import Declared
from ..terms.woven import isotropic_twist

if TYPE_CHECKING:
    from ..terms import OrthotropicMembrane, PlateBending

GRAVITY = 9.81  # [m/s²]


@dataclass(frozen=True, kw_only=True)
class Fabric:
    """The density and the moduli of a fabric along warp and weft. Numbers that were not measured are None.

    Attributes:
        name: Its key in ``warpcloth.fabrics``.
        density: ρ [kg/m²].
        warp, weft: E₁t and E₂t [N/m], Young's moduli times thickness.
        shear: Gt [N/m].
        poisson_ratio: ν₁₂, the narrowing of a strip along the warp.
        bending_warp, bending_weft: D₁ and D₂ [N·m].
        thickness: t [m].
        source: Where the numbers are from.
        computed: Names of numbers that were computed, not measured.
        notes: Method, derivations and uncertainty.

    Raises:
        ValueError: A number is not finite or not allowed.

    Examples:
        >>> import warpcloth as wc
        >>> denim = wc.fabrics["denim"]
        >>> denim.density, [type(term).__name__ for term in denim.terms()]
        (0.4, ['OrthotropicMembrane', 'PlateBending'])
    """

    name: str
    density: float
    warp: float | None = None
    weft: float | None = None
    shear: float | None = None
    poisson_ratio: float | None = None
    bending_warp: float | None = None
    bending_weft: float | None = None
    thickness: float | None = None
    source: str = ""
    notes: str = ""
    computed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        keep_plain(self)
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "computed":
                numbers = [other.name for other in fields(self) if other.name not in ("name", "source", "notes", "computed")]
                if not isinstance(value, tuple) or any(name not in numbers for name in value):
                    raise ValueError(f"Fabric.computed is {shown(value)}; it must be a tuple of names of {', '.join(numbers)}")
            elif field.name in ("name", "source", "notes"):
                if not isinstance(value, str):
                    raise ValueError(f"Fabric.{field.name} is {shown(value)}; it must be a text")
            elif value is not None or field.name == "density":
                number(f"Fabric.{field.name}", value, above=None if field.name == "poisson_ratio" else 0.0)

    def membrane(self, **given: Any) -> "OrthotropicMembrane":
        """The :class:`warpcloth.OrthotropicMembrane` of the fabric, with further fields.

        Raises:
            ValueError: A number is None, or the moduli are not positive definite.
        """
        warp, weft, shear, ratio = self._known("a membrane", "warp", "weft", "shear", "poisson_ratio")
        direction = given.pop("warp", None)
        return energies.OrthotropicMembrane.from_moduli(warp, weft, shear, ratio, direction, **given)

    def bending(self, **given: Any) -> "PlateBending":
        """The :class:`warpcloth.PlateBending` of the fabric, with further fields.

        D₁₂ is √(ν₁₂ν₂₁ D₁D₂), as of one material. D₆₆ is Gt t²/12, without thickness the default of the class.

        Raises:
            ValueError: A number is None.
        """
        return energies.PlateBending(**self._plate(), **given)

    def _plate(self) -> dict[str, Any]:
        one, two = self._known("bending", "bending_warp", "bending_weft")
        E1, E2, ratio = self._known("bending", "warp", "weft", "poisson_ratio")
        found = {"stiffness": one, "weft_ratio": two / one, "poisson_ratio": ratio * (E2 / E1) ** 0.5}
        if self.shear is not None and self.thickness is not None:
            found["twist_ratio"] = self.shear * self.thickness**2 / 12.0 / one
        return found

    def terms(self, **given: Any) -> list[Declared]:
        """:meth:`membrane` and :meth:`bending`.

        Args:
            **given: Fields of both, such as ``warp_angle``.
        """
        return [self.membrane(**given), self.bending(**given)]

    def modulus_along(self, angle: float) -> float:
        """Returns E(θ) [N/m] of a strip at ``angle`` θ [rad] to the warp, that shears and narrows freely.

        1/E(θ) = c⁴/E₁ + s⁴/E₂ + (1/G − 2ν₁₂/E₁)s²c², c and s the cosine and sine of θ.

        Raises:
            ValueError: A number is None.
        """
        E1, E2, G, ratio = self._known("a membrane", "warp", "weft", "shear", "poisson_ratio")
        c, s = np.cos(angle), np.sin(angle)
        return float(1.0 / (c**4 / E1 + s**4 / E2 + (1.0 / G - 2.0 * ratio / E1) * s**2 * c**2))

    def bending_along(self, angle: float) -> float:
        """Returns D(θ) [N·m] of a cylinder curved at ``angle`` θ [rad] to the warp.

        D(θ) = D₁c⁴ + D₂s⁴ + 2(D₁₂ + 2D₆₆)s²c². A narrow strip is softer: it curves across, too.

        Raises:
            ValueError: A number is None.
        """
        plate, c, s = self._plate(), np.cos(angle), np.sin(angle)
        root, ratio = plate["weft_ratio"] ** 0.5, plate["poisson_ratio"]
        twist = plate.get("twist_ratio", isotropic_twist(ratio, plate["weft_ratio"]))
        mixed = 2.0 * (ratio * root + 2.0 * twist)
        return float(plate["stiffness"] * (c**4 + plate["weft_ratio"] * s**4 + mixed * s**2 * c**2))

    @property
    def bending_lengths(self) -> tuple[float, float]:
        """(D/ρg)^⅓ [m] of strips cut along warp and weft; NaN where D is None."""
        found = [np.nan if D is None else (D / (self.density * GRAVITY)) ** (1 / 3) for D in self._bending]
        return found[0], found[1]

    @property
    def _bending(self):
        return self.bending_warp, self.bending_weft

    def _known(self, purpose, *names):
        for name in names:
            if getattr(self, name) is None:
                raise ValueError(
                    f"fabric {self.name!r} has no {name}, which {purpose} needs; take another fabric, or give this one a {name}"
                )
        return [getattr(self, name) for name in names]
