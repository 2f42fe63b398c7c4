"""Contact and friction of vertices with one collider. A scene makes these terms from its colliders."""

from dataclasses import dataclass, field

import numpy as np

from ..kernels.coulomb import COULOMB, Law
from ..kernels.term import Term
from ..kernels.terms.contact import ROUNDED_BOX, Solid, contact, rest_state
from ..kernels.terms.face_contact import FACE_CONTACT
from ..kernels.terms.face_contact import PAIRS as PAIRS
from ..kernels.terms.face_friction import FACE_FRICTION, face_friction
from ..kernels.terms.friction import FRICTION, friction
from ..mesh.mesh import Mesh
from .declared import Declared, own_stencil

FAR = 1e30  # distance without a pair; finite, so that differences are not NaN


@dataclass(frozen=True, eq=False, kw_only=True)
class VertexContact(Declared):
    """Contact of vertices with a collider, U = Σ kA φ(d), see :mod:`warpcloth.kernels.terms.contact`.

    Attributes:
        vertices: Indices (E,).
        stiffness: k [Pa/m].
        areas: A (E,) [m²].
        distance: r [m].
        pose, solid, core, radius: Pose and shape of the collider at the start, see :mod:`warpcloth.kernels.terms.contact`.
        collider: Index of the collider in the scene.
        facet: For a mesh, index of the half-space, of those that approximate it near a vertex.
    """

    vertices: np.ndarray = field(default_factory=lambda: np.empty(0, np.int32))
    areas: np.ndarray = field(default_factory=lambda: np.empty(0))
    distance: float = 1e-3
    pose: np.ndarray = field(default_factory=lambda: np.zeros(7))
    solid: Solid = ROUNDED_BOX
    core: np.ndarray = field(default_factory=lambda: np.zeros(3))
    radius: float = 0.0
    collider: int = 0
    facet: int = 0

    @property
    def term(self) -> Term:
        """That of contact with this shape."""
        return contact(self.solid)

    def stencil(self, mesh: Mesh) -> np.ndarray:
        return own_stencil(self.label, "vertices", self.vertices, 1, len(mesh.points))

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        return rest_state(mesh.points, stencil, self.pose, self.core, self.radius, self.distance, self.areas)


@dataclass(frozen=True, eq=False, kw_only=True)
class VertexFriction(VertexContact):
    """Friction of vertices on a collider, U = Σ kA H(‖u‖), see :mod:`warpcloth.kernels.terms.friction`."""

    law: Law = COULOMB

    @property
    def term(self) -> Term:
        return friction(self.law)

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        return FRICTION.rest_state(mesh.points, stencil, self.areas)


@dataclass(frozen=True, eq=False, kw_only=True)
class FaceContact(Declared):
    """Contact of triangles with a mesh, U = Σ kA φ(d), see :mod:`warpcloth.kernels.terms.face_contact`.

    Attributes:
        triangles: Vertices (E, 3).
        stiffness: k [Pa/m].
        areas: A (E,) [m²].
        distance: r [m].
        collider: Index of the collider in the scene.
        facet: Index of the pair of each triangle. Steps set all.
    """

    @property
    def term(self) -> Term:
        return FACE_CONTACT

    triangles: np.ndarray = field(default_factory=lambda: np.empty((0, 3), np.int32))
    areas: np.ndarray = field(default_factory=lambda: np.empty(0))
    distance: float = 1e-3
    collider: int = 0
    facet: int = 0

    def stencil(self, mesh: Mesh) -> np.ndarray:
        return own_stencil(self.label, "triangles", self.triangles, 3, len(mesh.points))

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        return FACE_CONTACT.rest_state(mesh.points, stencil, radius=-FAR, distance=self.distance, areas=self.areas)


@dataclass(frozen=True, eq=False, kw_only=True)
class FaceFriction(FaceContact):
    """Friction of triangles on a mesh, U = Σ kA H(‖u‖), see :mod:`warpcloth.kernels.terms.face_friction`."""

    law: Law = COULOMB

    @property
    def term(self) -> Term:
        return face_friction(self.law)

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        return FACE_FRICTION.rest_state(mesh.points, stencil, self.areas)
