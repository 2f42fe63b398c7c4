"""Limits on the stretches of triangles."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..kernels.term import Term
from ..kernels.terms.strain_limit import STRAIN_LIMIT
from ..mesh.mesh import Mesh
from .limit import Limit


@dataclass(frozen=True, kw_only=True)
class StrainLimit(Limit):
    """Limits on the principal stretches of triangles, U = Σ ½kA‖F − p‖², p the matrix nearest to F with σ_min ≤ σᵢ ≤ σ_max
    (Thomaszewski et al. 2009).

    Attributes:
        least, most: Bounds σ_min, σ_max of the singular values σᵢ of the deformation gradient F, each one or (T,); at least
            one.
        stiffness: k [N/m] beyond a limit, one or (T,), as of :class:`warpcloth.CorotatedMembrane`, by default infinite; finite
            for solvers that need forces.
    """

    term: ClassVar[Term] = STRAIN_LIMIT

    def stencil(self, mesh: Mesh) -> np.ndarray:
        return mesh.triangles
