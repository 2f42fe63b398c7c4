"""Contact and friction of vertices with one collider."""

from dataclasses import dataclass, field

import numpy as np

from ..kernels.coulomb import COULOMB, Law
from ..kernels.term import Term
from ..kernels.terms.contact import ROUNDED_BOX, Solid, contact, rest_state
from ..kernels.terms.friction import FRICTION, friction
from ..mesh.mesh import Mesh
from .declared import Declared, own_stencil


@dataclass(frozen=True, eq=False, kw_only=True)
class VertexContact(Declared):
    """Contact of vertices with a collider, U = Σ kA φ(d) (:mod:`warpcloth.kernels.terms.contact`).

    Attributes:
        vertices: Indices (E,).
        stiffness: k [Pa/m].
        areas: A (E,) [m²].
        distance: r [m].
        pose, solid, core, radius: Pose and shape of the collider at the start.
        collider: Its index in the scene.
    """

    vertices: np.ndarray = field(default_factory=lambda: np.empty(0, np.int32))
    areas: np.ndarray = field(default_factory=lambda: np.empty(0))
    distance: float = 1e-3
    pose: np.ndarray = field(default_factory=lambda: np.zeros(7))
    solid: Solid = ROUNDED_BOX
    core: np.ndarray = field(default_factory=lambda: np.zeros(3))
    radius: float = 0.0
    collider: int = 0

    @property
    def term(self) -> Term:
        return contact(self.solid)

    def stencil(self, mesh: Mesh) -> np.ndarray:
        return own_stencil(self.label, "vertices", self.vertices, 1, len(mesh.points))

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        return rest_state(mesh.points, stencil, self.pose, self.core, self.radius, self.distance, self.areas)


@dataclass(frozen=True, eq=False, kw_only=True)
class VertexFriction(VertexContact):
    """Friction of vertices on a collider, U = Σ kA H(‖u‖) (:mod:`warpcloth.kernels.terms.friction`)."""

    law: Law = COULOMB

    @property
    def term(self) -> Term:
        return friction(self.law)

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        return FRICTION.rest_state(mesh.points, stencil, self.areas)
