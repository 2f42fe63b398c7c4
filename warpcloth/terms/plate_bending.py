"""Bending of an isotropic or orthotropic plate, on any mesh."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

import numpy as np

from ..base.checks import numeric, refuse
from ..kernels.membrane import side_axes
from ..kernels.term import Term
from ..kernels.terms.plate_bending import PLATE_BENDING
from ..mesh.curvature import curvature_operator
from ..mesh.mesh import Mesh
from .declared import quantity
from .sparse import Sparse
from .woven import ABOVE_0, Woven, isotropic_twist

Own = TypeVar("Own", bound="PlateBending")


@dataclass(frozen=True, kw_only=True)
class PlateBending(Woven, Sparse):
    """Plate bending, U = Σ ½AκᵀCκ.

    κᵀCκ is D₁κ₁₁² + D₂κ₂₂² + 2D₁₂κ₁₁κ₂₂ + 4D₆₆κ₁₂². κ holds second derivatives of the positions along warp and weft, exact at
    constant curvature on any mesh. The error of deflections is of second order in the edge length. Forces are linear in x. The
    plate is flat at rest: a curved rest shape gives edge lengths only.

    D₁₂ = ν√(D₁D₂); an isotropic plate has D₂ = D₁ and D₆₆ = ½(1 − ν)D₁.

    Attributes:
        stiffness: D₁ [N·m], the bending stiffness along warp, one or (T,).
        poisson_ratio: ν, above −1 and below 1, one or (T,).
        weft_ratio: D₂/D₁, one or (T,).
        twist_ratio: D₆₆/D₁, one or (T,); ½(1 − ν)√(D₂/D₁) if None.
        warp, warp_angle: As of :class:`warpcloth.OrthotropicMembrane`; isotropic plates need neither.

    Examples:
        >>> import warpcloth as wc
        >>> wc.PlateBending(stiffness=1e-5, poisson_ratio=0.3).operator(wc.Mesh.grid(3, 3)).shape
        (24, 9)
    """

    term: ClassVar[Term] = PLATE_BENDING
    shearing: ClassVar[str] = "twist_ratio"

    poisson_ratio: float | Sequence[float] | np.ndarray = field(
        default=0.0,
        metadata=quantity("must be above -1 and below 1", lambda ratio: (ratio > -1.0) & (ratio < 1.0)),
    )
    twist_ratio: float | Sequence[float] | np.ndarray | None = field(default=None, metadata=ABOVE_0)

    @classmethod
    def from_stiffnesses(
        cls: type[Own], warp: float, weft: float, coupling: float, twist: float, direction: Any = None, **fields: Any
    ) -> Own:
        """Returns the plate with D₁, D₂, D₁₂ and D₆₆ [N·m], numbers or (T,), and the warp along ``direction``.

        Raises:
            ValueError: D₁, D₂ or D₆₆ is not above 0, or D₁₂² is not below D₁D₂.
        """
        given = {"warp": warp, "weft": weft, "coupling": coupling, "twist": twist}
        D1, D2, D12, D66 = (numeric(f"{cls.__name__}.{name}", value, "be a number") for name, value in given.items())
        for name, values in (("warp", D1), ("weft", D2), ("twist", D66)):
            refuse(f"{cls.__name__}.{name}", values, ~((values > 0.0) & np.isfinite(values)), "must be finite and above 0")
        if not (D12**2 < D1 * D2).all():
            raise ValueError(f"{cls.__name__}.coupling is {coupling}; its square must be below that of warp times weft")
        ratios = {"weft_ratio": D2 / D1, "poisson_ratio": D12 / np.sqrt(D1 * D2), "twist_ratio": D66 / D1}
        return cls(stiffness=D1, **ratios, warp=direction, **fields)

    def operator(self, mesh: Mesh) -> Any:
        return self.roots(mesh) @ curvature_operator(mesh)

    def roots(self, mesh: Mesh) -> Any:
        """Returns square roots of C/D₁ as a block diagonal matrix (3T, 3T), for κ in the triangles' axes.

        Raises:
            ValueError: The mesh has no hinges.
        """
        from scipy.sparse import csr_array

        T = len(mesh.triangles)
        if not T or not len(mesh.hinges):
            raise ValueError(f"{self.label} has no elements on this mesh of {T} triangles; leave it out")
        ratio, weft = self.of_elements("poisson_ratio", T), self.of_elements("weft_ratio", T)
        twist = isotropic_twist(ratio, weft) if self.twist_ratio is None else self.of_elements("twist_ratio", T)
        root = np.zeros((T, 3, 3))  # of C/D₁
        root[:, 0, 0], root[:, 0, 1] = 1.0, ratio * np.sqrt(weft)
        root[:, 1, 1], root[:, 2, 2] = np.sqrt(weft * (1.0 - ratio**2)), 2.0 * np.sqrt(twist)
        axes = side_axes(mesh.points, mesh.triangles)
        warp = axes[:, 0] if self.warp is None and not self.anisotropic else self.warp_directions(mesh)
        c, s = np.einsum("tai,ti->at", axes, warp)  # rotates κ from the axes of each triangle to warp and weft
        turn = np.stack([c * c, s * s, 2.0 * c * s, s * s, c * c, -2.0 * c * s, -c * s, c * s, c * c - s * s], axis=1)
        columns = np.broadcast_to(3 * np.arange(T)[:, None, None] + np.arange(3), root.shape)
        entries = (root @ turn.reshape(-1, 3, 3)).ravel(), columns.ravel(), np.arange(0, 9 * T + 1, 3)
        return csr_array(entries, shape=(3 * T, 3 * T))

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        return mesh.triangle_areas[:, None]
