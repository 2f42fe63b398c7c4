"""Limits on the distance of vertex pairs."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ..kernels.term import Term
from ..kernels.terms.spring_limit import SPRING_LIMIT
from ..mesh.mesh import Mesh
from .declared import indices
from .limit import Limit
from .spring import pairs_on


@dataclass(frozen=True, kw_only=True)
class SpringLimit(Limit):
    """Limits on the distance l between two vertices, U = Σ ½k(l − c)², c = l clamped to [σ_min L, σ_max L] (Provot 1995).

    Attributes:
        least, most: σ_min, σ_max, ratios to the rest length L, each one or (E,); at least one.
        pairs: Pairs of vertices as of :class:`warpcloth.Spring`.
        stiffness: k [N/m] beyond a limit, one or (E,), by default infinite; finite for solvers that need forces.
    """

    term: ClassVar[Term] = SPRING_LIMIT

    pairs: str | tuple | np.ndarray = field(default="edges", metadata=indices(each=2, text="word"))

    def stencil(self, mesh: Mesh) -> np.ndarray:
        return pairs_on(mesh, self.label, self.pairs)
