"""Springs."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ..kernels.term import Term
from ..kernels.terms.spring import SPRING
from ..mesh.mesh import Mesh
from .declared import FINITE_FROM_0, Damped, indices, own_stencil


@dataclass(frozen=True, kw_only=True)
class Spring(Damped):
    """Springs between vertex pairs, U = Σ ½k(l − L)² (Provot 1995).

    Attributes:
        pairs: Pairs of vertices (E, 2), a kind, or a tuple of kinds, without repeated pairs. Kinds are ``"edges"``, and on a
            grid ``"structural"`` (rows and columns), ``"shear"`` (both diagonals of cells) and ``"bending"`` (two apart;
            elsewhere opposite vertices of hinges). Arrays of other fields have their order: that of given pairs; that of
            ``mesh.edges`` for ``"edges"`` (and ``"structural"`` without a grid); else lexicographic, the smaller index first.
        stiffness: k [N/m], one or (E,); ``math.inf`` for solvers that take hard constraints.
        rest_lengths: L [m], one or (E,); by default the lengths in the rest shape.
        damping: β [N·s/m], one or (E,): a force −β dl/dt along the spring.

    Examples:
        >>> import warpcloth as wc
        >>> mesh = wc.Mesh.grid(3, 3)
        >>> springs = wc.Spring(pairs=("structural", "shear"), stiffness=1e3)
        >>> springs.stencil(mesh).shape
        (20, 2)
    """

    term: ClassVar[Term] = SPRING

    pairs: str | tuple | np.ndarray = field(default="edges", metadata=indices(each=2, text="word"))
    rest_lengths: float | Sequence[float] | np.ndarray | None = field(default=None, metadata=FINITE_FROM_0)

    def stencil(self, mesh: Mesh) -> np.ndarray:
        return pairs_on(mesh, self.label, self.pairs)

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        if self.rest_lengths is None:
            return super().rest(mesh, positions, stencil)
        lengths = self.of_elements("rest_lengths", len(stencil))
        return np.broadcast_to(lengths, len(stencil))[:, None].copy()

    def held(self, mesh: Mesh, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pairs, and K = 2k/√3 of a sheet of equilateral triangles."""
        found = self.elements(mesh, positions)
        return found.stencil, 2.0 / np.sqrt(3.0) * np.broadcast_to(found.stiffness, len(found.stencil))


def pairs_on(mesh, label, pairs):
    """Returns the pairs of :class:`Spring`, (E, 2) int32."""
    kinds = (pairs,) if isinstance(pairs, str) else pairs
    if isinstance(kinds, (tuple, list)) and kinds and all(isinstance(kind, str) for kind in kinds):
        found = [mesh.springs(kind) for kind in kinds]
        return found[0] if len(found) == 1 else mesh.distinct_pairs(np.concatenate(found))
    return own_stencil(label, "pairs", pairs, 2, len(mesh.points))
