"""Bending energies over hinges."""

from dataclasses import dataclass

import numpy as np

from ..mesh.mesh import Mesh
from .declared import Damped


@dataclass(frozen=True, kw_only=True)
class Bending(Damped):
    """The base class of bending energies over hinges, edges with two triangles.

    Attributes:
        stiffness: D, the bending stiffness of the plate [N·m], one or (E,) in the order of ``mesh.hinges``.
    """

    def stencil(self, mesh: Mesh) -> np.ndarray:
        return mesh.hinges
