"""Dihedral bending."""

from dataclasses import dataclass
from typing import ClassVar

from ..kernels.term import Term
from ..kernels.terms.dihedral_bending import DIHEDRAL_BENDING
from .bending import Bending


@dataclass(frozen=True, kw_only=True)
class DihedralBending(Bending):
    """Bending by the angle between neighbouring triangles, U = Σ ½D|e|²/(A₁+A₂)(θ−θ̄)² (Grinspun et al. 2003).

    Attributes:
        stiffness: D, the bending stiffness of the plate [N·m], calibrated as in :class:`warpcloth.QuadraticBending`.
        damping: β [N·m·s] on the rate of θ.
    """

    term: ClassVar[Term] = DIHEDRAL_BENDING
