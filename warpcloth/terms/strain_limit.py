"""Limits of the stretches of triangles."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..kernels.term import Term
from ..kernels.terms import STRAIN_LIMIT
from ..mesh.mesh import Mesh
from .limit import Limit


@dataclass(frozen=True, kw_only=True)
class StrainLimit(Limit):
    """Limits of the principal stretches of triangles, U = Σ ½kA‖F − p‖², p the nearest with σ_min ≤ σᵢ ≤ σ_max (Thomaszewski
    et al. 2009).

    Attributes:
        least, most: σ_min, σ_max of the singular values of the deformation gradient F, one or (T,); at least one of the two.
        stiffness: k [N/m], one or (T,), that of :class:`warpcloth.CorotatedMembrane` beyond the limits; infinite for PBD,
            which takes hard constraints, finite for solvers that need forces.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = STRAIN_LIMIT

    def stencil(self, mesh: Mesh) -> np.ndarray:
        return mesh.triangles
