"""The base classes of membranes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

import numpy as np

from ..base.checks import numeric, refuse
from ..mesh.mesh import Mesh
from .declared import Damped, quantity

Own = TypeVar("Own", bound="IsotropicMembrane")


@dataclass(frozen=True, kw_only=True)
class Membrane(Damped):
    """An energy of the deformation gradient F (3×2) of triangles, which :func:`warpcloth.analyze` can measure.

    Attributes:
        material: Name on the command line, or None.
        stiffness: k = Et [N/m], Young's modulus times thickness, one or (T,).
        damping: β [N·s/m], one or (T,): a stress βĖ, E = ½(FᵀF − I) the Green strain.
    """

    material: ClassVar[str | None] = None

    def stencil(self, mesh: Mesh) -> np.ndarray:
        return mesh.triangles

    def held(self, mesh: Mesh, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the edges of the triangles, and K = Et."""
        found = self.elements(mesh, positions)
        pairs = found.stencil[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        return pairs, np.repeat(np.broadcast_to(found.stiffness, len(found.stencil)), 3)


@dataclass(frozen=True, kw_only=True)
class IsotropicMembrane(Membrane):
    """An isotropic membrane in plane stress: k = Et, and Poisson's ratio ν.

    Its Lamé parameters are μ = k/(2(1 + ν)) and λ = kν/(1 − ν²). A varied stiffness leaves ν as it is.
    """

    poisson_ratio: float | Sequence[float] | np.ndarray = field(
        default=0.0,
        metadata=quantity("must be above -1 and below 1", lambda ratio: (ratio > -1.0) & (ratio < 1.0)),
    )

    @classmethod
    def from_material(cls: type[Own], youngs_modulus: float, poisson_ratio: float, thickness: float, **fields: Any) -> Own:
        """Returns the membrane of a material with E [Pa], ν and thickness t [m]."""
        return cls(stiffness=membrane_stiffness(cls, youngs_modulus, thickness), poisson_ratio=poisson_ratio, **fields)

    @classmethod
    def from_moduli(cls: type[Own], mu: float, lam: float, **fields: Any) -> Own:
        """Returns the membrane with Lamé parameters μ above 0 and λ above −μ [N/m]: ν = λ/(λ + 2μ), k = 2μ(1 + ν)."""
        first, second = (numeric(f"{cls.__name__}.{name}", value, "be a number") for name, value in (("mu", mu), ("lam", lam)))
        refuse(f"{cls.__name__}.mu", first, ~(first > 0.0), "must be above 0")
        ratio = second / (second + 2.0 * first)
        return cls(stiffness=2.0 * first * (1.0 + ratio), poisson_ratio=ratio, **fields)

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        return self.term.rest_state(mesh.points, stencil, poisson_ratio=self.of_elements("poisson_ratio", len(stencil)))


def membrane_stiffness(cls, youngs_modulus, thickness):
    """Returns Et [N/m]; checks both."""
    given = {"youngs_modulus": youngs_modulus, "thickness": thickness}
    modulus, t = (numeric(f"{cls.__name__}.{name}", value, "be a number") for name, value in given.items())
    refuse(f"{cls.__name__}.youngs_modulus", modulus, ~(modulus >= 0.0), "must be 0 or more")
    refuse(f"{cls.__name__}.thickness", t, ~(t > 0.0), "must be above 0")
    return (modulus * t)[()]
