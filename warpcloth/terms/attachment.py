"""Attachments."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ..kernels.term import Term
from ..kernels.terms.attachment import ATTACHMENT
from ..mesh.mesh import Mesh
from .declared import Damped, indices, own_stencil, quantity


@dataclass(frozen=True, kw_only=True)
class Attachment(Damped):
    """Springs of rest length 0 from vertices to targets, U = Σ ½k‖x − target‖²: soft pins.

    Attributes:
        vertices: Indices (E,), or a selection such as ``"corners"``.
        stiffness: k [N/m], one or (E,).
        targets: Positions (E, 3) [m], or one for all (3,); by default the positions at the start.
        damping: β [N·s/m], one or (E,): a force −βv, also in rigid motion.
    """

    term: ClassVar[Term] = ATTACHMENT

    vertices: str | Sequence[int] | np.ndarray = field(default=(), metadata=indices(text="selection"))
    targets: Sequence | np.ndarray | None = field(default=None, metadata=quantity("must be finite", np.isfinite, shape=(3,)))

    def stencil(self, mesh: Mesh) -> np.ndarray:
        vertices = mesh.select(self.vertices) if isinstance(self.vertices, str) else self.vertices
        return own_stencil(self.label, "vertices", vertices, 1, len(mesh.points))

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        if self.targets is None:
            return super().rest(mesh, positions, stencil) if positions is None else positions[stencil[:, 0]]
        return np.broadcast_to(self.of_elements("targets", len(stencil)), (len(stencil), 3)).copy()
