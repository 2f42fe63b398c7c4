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
        least, most: σ_min, σ_max, ratios to the rest length L, each one or (E,); at least one of the two is required.
        pairs: Pairs of vertices, and their order, as in :class:`warpcloth.Spring`.
        stiffness: k [N/m], one or (E,): a pair beyond its limit is a spring of this stiffness. Infinite for solvers that take
            hard constraints, such as PBD; finite for solvers that need forces.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = SPRING_LIMIT

    pairs: str | tuple | np.ndarray = field(default="edges", metadata=indices(each=2, text="word"))

    def stencil(self, mesh: Mesh) -> np.ndarray:
        return pairs_on(mesh, self.label, self.pairs)
