"""Quadratic bending."""

from dataclasses import dataclass
from typing import ClassVar

from ..kernels.term import Term
from ..kernels.terms.quadratic_bending import QUADRATIC_BENDING
from .bending import Bending


@dataclass(frozen=True, kw_only=True)
class QuadraticBending(Bending):
    """Quadratic bending of a sheet that is flat at rest, U = Σ ½D‖y‖²/(A₁+A₂) (Bergou et al. 2006). Forces are linear in x.

    Attributes:
        stiffness: D, the bending stiffness of the plate [N·m], calibrated on an equilateral mesh, which has a Poisson's ratio
            of −1/3. Other meshes are not isotropic. A grid with one diagonal per cell has the stiffness 3 D when it curves
            along its diagonals, D when it folds about them or curves along its rows, and 0.75 D when it curves along directions
            15° off the rows, away from the diagonals. A grid with alternating diagonals has 1 to 1.5 D.
        damping: β [N·m·s]. It damps the rate of ‖y‖, where ‖y‖ is |e|·|θ| for a small angle θ.
        name: To tell two terms of one kind apart.

    Examples:
        >>> import warpcloth as wc
        >>> mesh = wc.Mesh.grid(3, 3)
        >>> bending = wc.QuadraticBending(stiffness=1e-5)
        >>> bending.stencil(mesh).shape == mesh.hinges.shape
        True
    """

    term: ClassVar[Term] = QUADRATIC_BENDING
