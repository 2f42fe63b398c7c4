"""Contact and friction of vertices with one collider. A scene makes these terms from its colliders."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ..kernels.term import Term
from ..kernels.terms.contact import CONTACT
from ..kernels.terms.friction import FRICTION
from ..mesh.mesh import Mesh
from .declared import Declared, own_stencil


@dataclass(frozen=True, eq=False, kw_only=True)
class VertexContact(Declared):
    """Contact of vertices with a collider, U = Σ kA φ(d), see :mod:`warpcloth.kernels.terms.contact`.

    Attributes:
        vertices: Indices (E,).
        stiffness: k [Pa/m].
        areas: A (E,) [m²].
        distance: r [m].
        pose, core, radius: Pose and shape of the collider at the start, see :mod:`warpcloth.kernels.terms.contact`.
        collider: Index of the collider in the scene.
        facet: For a mesh, index of the half-space, of those that approximate it near a vertex.
    """

    term: ClassVar[Term] = CONTACT
    vertices: np.ndarray = field(default_factory=lambda: np.empty(0, np.int32))
    areas: np.ndarray = field(default_factory=lambda: np.empty(0))
    distance: float = 1e-3
    pose: np.ndarray = field(default_factory=lambda: np.zeros(7))
    core: np.ndarray = field(default_factory=lambda: np.zeros(3))
    radius: float = 0.0
    collider: int = 0
    facet: int = 0

    def stencil(self, mesh: Mesh) -> np.ndarray:
        return own_stencil(self.label, "vertices", self.vertices, 1, len(mesh.points))

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        return CONTACT.rest_state(mesh.points, stencil, self.pose, self.core, self.radius, self.distance, self.areas)


@dataclass(frozen=True, eq=False, kw_only=True)
class VertexFriction(VertexContact):
    """Friction of vertices on a collider, U = Σ kA H(‖u‖), see :mod:`warpcloth.kernels.terms.friction`."""

    term: ClassVar[Term] = FRICTION

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        return FRICTION.rest_state(mesh.points, stencil, self.areas)
