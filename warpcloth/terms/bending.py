"""The base of energies of bending: a hinge is an edge and the two triangles at it."""

from dataclasses import dataclass

import numpy as np

from ..mesh.mesh import Mesh
from .declared import Damped


@dataclass(frozen=True, kw_only=True)
class Bending(Damped):
    """An energy of the hinges of a mesh.

    Attributes:
        stiffness: D, the bending stiffness of the plate [N·m], one or (E,) in the order of ``mesh.hinges``.
    """

    def stencil(self, mesh: Mesh) -> np.ndarray:
        return mesh.hinges
