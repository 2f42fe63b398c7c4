"""Bending of a shell with a curved rest shape, on any mesh."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ..kernels.term import Term
from ..kernels.terms.shell_bending import SHELL_BENDING
from ..mesh.curvature import covariant_operator
from ..mesh.mesh import Mesh
from .plate_bending import PlateBending

_FLAT = 1e-9  # κ̄ times the longest side of a triangle below which κ̄ is rounding of a flat mesh, and is set to 0


@dataclass(frozen=True, kw_only=True)
class ShellBending(PlateBending):
    """Shell bending, U = Σ ½AδᵀCδ.

    δ = κ − κ̄n, and κᵀCκ is that of :class:`warpcloth.PlateBending`. κ̄ is the curvature at rest along warp and weft, n the
    normal of a triangle. The rest shape has no energy, however it moves; without stretch the energy is that of the change of
    curvature. Forces are not linear in x. Triangles with ‖κ̄‖ below 1e-9 over their longest side are flat.

    Attributes:
        stiffness: D₁ [N·m], the bending stiffness along warp, one or (T,).
        poisson_ratio: ν, above −1 and below 1, one or (T,).
        weft_ratio: D₂/D₁, one or (T,).
        twist_ratio: D₆₆/D₁, one or (T,); ½(1 − ν)√(D₂/D₁) if None.
        warp, warp_angle: As of :class:`warpcloth.OrthotropicMembrane`; isotropic shells need neither.

    Examples:
        >>> import warpcloth as wc
        >>> wc.ShellBending(stiffness=1e-5, poisson_ratio=0.3).operator(wc.Mesh.grid(3, 3)).shape
        (40, 9)
    """

    term: ClassVar[Term] = SHELL_BENDING

    def operator(self, mesh: Mesh) -> Any:
        from scipy.sparse import diags_array, vstack

        bent, gradient, curvature = self._at_rest(mesh)
        T = len(mesh.triangles)
        order = np.concatenate([np.arange(3 * T).reshape(T, 3), 3 * T + np.arange(2 * T).reshape(T, 2)], axis=1)
        size = diags_array(np.repeat(np.linalg.norm(curvature, axis=1), 2))
        return vstack([bent, size @ gradient]).tocsr()[order.ravel()]

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        curvature = self._at_rest(mesh)[2]
        square = (curvature**2).sum(axis=1)[:, None]
        return np.column_stack([mesh.triangle_areas, curvature / np.where(square > 0.0, square, 1.0)])

    def _at_rest(self, mesh):
        """Returns the matrices of κ (3T, n) and of f₁ and f₂ (2T, n), and κ̄ (T, 3) [1/m]."""
        second, first = covariant_operator(mesh)
        bent = self.roots(mesh) @ second
        f = (first @ mesh.points).reshape(-1, 2, 3)
        curvature = np.einsum("tmi,ti->tm", (bent @ mesh.points).reshape(-1, 3, 3), np.cross(f[:, 0], f[:, 1]))
        corners = mesh.points[mesh.triangles]
        longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        curvature[np.linalg.norm(curvature, axis=1) * longest < _FLAT] = 0.0
        return bent, first, curvature
