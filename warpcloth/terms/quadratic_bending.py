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
        stiffness: D, the bending stiffness of the plate [N·m], calibrated on an equilateral mesh, whose Poisson's ratio is
            −1/3. Other meshes are not isotropic: a grid with one diagonal per cell has 0.75 to 3 D, with alternating diagonals
            1 to 1.5 D, by the direction.
        damping: β [N·m·s] on the rate of ‖y‖, |e|·|θ| for a small angle θ.

    Examples:
        >>> import warpcloth as wc
        >>> mesh = wc.Mesh.grid(3, 3)
        >>> bending = wc.QuadraticBending(stiffness=1e-5)
        >>> bending.stencil(mesh).shape == mesh.hinges.shape
        True
    """

    term: ClassVar[Term] = QUADRATIC_BENDING
