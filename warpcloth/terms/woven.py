"""Energies of fabrics, stiffer along warp or weft."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, TypeVar

import numpy as np

from ..kernels.membrane import side_axes
from ..mesh.mesh import Mesh
from .declared import FINITE, Declared, quantity

Own = TypeVar("Own", bound="Woven")
ABOVE_0 = quantity("must be finite and above 0", lambda values: (values > 0.0) & np.isfinite(values))


@dataclass(frozen=True, kw_only=True)
class Woven(Declared):
    """An energy of triangles with two directions at right angles, the warp, with its stiffness, and the weft.

    Attributes:
        weft_ratio: Stiffness along weft over that along warp, one or (T,).
        warp, warp_angle: As of :class:`warpcloth.OrthotropicMembrane`.
    """

    # The field with the stiffness of shear or twist over that along warp; None for that of an isotropic sheet.
    shearing: ClassVar[str]

    weft_ratio: float | Sequence[float] | np.ndarray = field(default=1.0, metadata=ABOVE_0)
    warp: Sequence[float] | np.ndarray | None = field(
        default=None, metadata=quantity("must be finite", np.isfinite, shape=(3,))
    )
    warp_angle: float | Sequence[float] | np.ndarray = field(default=0.0, metadata=FINITE)

    @property
    def anisotropic(self) -> bool:
        """Whether it is not as stiff as an isotropic sheet along weft, or in shear or twist."""
        return getattr(self, self.shearing) is not None or bool((self._numeric("weft_ratio") != 1.0).any())

    def isotropic(self: Own) -> Own:
        """Returns the isotropic energy with the geometric mean of both stiffnesses."""
        mean = self._numeric("stiffness") * np.sqrt(self._numeric("weft_ratio"))
        unshearing: dict[str, Any] = {self.shearing: None}
        return replace(self, stiffness=mean[()], weft_ratio=1.0, **unshearing)

    def warp_directions(self, mesh: Mesh) -> np.ndarray:
        """Unit vectors along the warp in each triangle, (T, 3).

        Raises:
            ValueError: ``warp`` is None without texture coordinates, or a triangle has no such direction.
        """
        axes, T = side_axes(mesh.points, mesh.triangles), len(mesh.triangles)
        if self.warp is not None:
            warp = np.broadcast_to(self.of_elements("warp", T), (T, 3))
        elif (st := mesh.corner_coordinates) is None:
            raise ValueError(f"{self.label}.warp is None on a mesh without texture coordinates; it must be a vector")
        else:
            warp = along_s(mesh.points[mesh.triangles], st)
        along = np.einsum("tai,ti->at", axes, warp)
        size = np.linalg.norm(along, axis=0)
        for t in np.flatnonzero(size <= 1e-6 * np.linalg.norm(warp, axis=1))[:1]:
            raise ValueError(f"{self.label}.warp has no direction in triangle {t}; it must have a part in its plane")
        angle = np.arctan2(along[1], along[0]) + self.of_elements("warp_angle", T)
        return np.cos(angle)[:, None] * axes[:, 0] + np.sin(angle)[:, None] * axes[:, 1]


def along_s(x: np.ndarray, st: np.ndarray) -> np.ndarray:
    """Vectors (T, 3) in which s grows and t does not, of corners x (T, 3, 3) [m] with coordinates ``st`` (T, 3, 2).

    They are 0 where triangles have no area in (s, t).
    """
    sides, ((s1, t1), (s2, t2)) = x[:, 1:] - x[:, :1], (st[:, 1:] - st[:, :1]).transpose(1, 2, 0)
    return np.sign(s1 * t2 - s2 * t1)[:, None] * (t2[:, None] * sides[:, 0] - t1[:, None] * sides[:, 1])


def isotropic_twist(ratio: Any, weft: Any) -> Any:
    """Returns D₆₆/D₁ = ½(1 − ν)√(D₂/D₁), from ν and D₂/D₁."""
    return 0.5 * (1.0 - ratio) * np.sqrt(weft)
