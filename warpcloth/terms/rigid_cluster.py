"""Rigid bodies, by shape matching."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from ..base.checks import shown
from ..kernels.clusters import fit_targets
from ..kernels.term import Term
from ..kernels.terms.rigid_cluster import RIGID_CLUSTER
from ..mesh.mesh import Mesh
from ..mesh.selection import distinct_vertices
from .declared import FROM_0, Declared, Elements, indices, own_indices
from .refresh import EVALUATION, Refresh


@dataclass(frozen=True, kw_only=True)
class RigidCluster(Declared):
    """Rigid bodies by shape matching, U = Σ (κ/2)Σ mᵢ‖xᵢ − (c + R qᵢ)‖², c and R the best fit of the rest shape (Müller et al.
    2005).

    Bodies are joined at shared vertices, which have their whole mass in each. In the fit, a pinned vertex has a thousand times
    the mass of the rest of its body. A body on a line has no orientation about it. Newton's method takes more iterations where
    κh² is near 1 or above, and ``equilibrium`` may use them up.

    Attributes:
        vertices: Vertices of the bodies, one after the other, (E,); a list of an array per body; a selection such as ``"x <
            0.1"`` for one body, or a list of these.
        sizes: Numbers of vertices of the bodies in one array, (C,).
        stiffness: κ [1/s²], one or (C,), the squared frequency of a vertex about its position in the body; infinite for solvers
            that take hard constraints.
    """

    term: ClassVar[Term] = RIGID_CLUSTER

    vertices: str | Sequence | np.ndarray = field(default=(), metadata=indices(text="selection"))
    sizes: Sequence[int] | np.ndarray | None = field(default=None, metadata=indices())
    stiffness: float | Sequence[float] | np.ndarray = field(default=math.inf, metadata=FROM_0)

    def __post_init__(self):
        super().__post_init__()
        if not isinstance(self.vertices, (str, Sequence)) and not (
            isinstance(self.vertices, np.ndarray) and self.vertices.ndim
        ):
            raise ValueError(f"{self.label}.vertices is {shown(self.vertices)}; it must be a list of bodies or a selection")
        texts = self._selections
        if texts and self.sizes is not None:
            raise ValueError(f"{self.label} has sizes and selections, which are one body each; leave sizes out")
        if texts or not len(self.vertices) or np.ndim(self.vertices[0]) == 0:
            return
        if self.sizes is not None:
            raise ValueError(f"{self.label} has sizes and a list for each body; at most one of the two may be given")
        bodies = [own_indices(f"{self.label}.vertices[{c}]", body) for c, body in enumerate(self.vertices)]
        object.__setattr__(self, "vertices", np.concatenate(bodies))
        object.__setattr__(self, "sizes", np.array([len(body) for body in bodies]))

    @property
    def _selections(self):
        vertices = (self.vertices,) if isinstance(self.vertices, str) else self.vertices
        texts = [isinstance(body, str) for body in vertices]
        if any(texts) and not all(texts):
            raise ValueError(
                f"{self.label}.vertices has both selections and indices; all bodies must be given by one of the two"
            )
        return tuple(vertices) if any(texts) else ()

    def _bodies(self, mesh):
        if texts := self._selections:
            bodies = [mesh.select(text) for text in texts]
            for text in [text for text, body in zip(texts, bodies, strict=True) if not len(body)][:1]:
                raise ValueError(f"{self.label}.vertices: {text!r} selects nothing; a body must have one vertex or more")
            return bodies
        vertices = own_indices(f"{self.label}.vertices", self.vertices)
        if not len(vertices) and self.sizes is None:
            return []
        sizes = np.array([len(vertices)]) if self.sizes is None else own_indices(f"{self.label}.sizes", self.sizes)
        if sizes.sum() != len(vertices) or (sizes < 1).any():
            raise ValueError(
                f"{self.label}.sizes is {shown(sizes.tolist())}; it must be 1 or more each and {len(vertices)} in all"
            )
        return np.split(vertices, np.cumsum(sizes)[:-1])

    def stencil(self, mesh: Mesh) -> np.ndarray:
        bodies = [
            distinct_vertices(f"{self.label}.vertices, body {c}", body, mesh) for c, body in enumerate(self._bodies(mesh))
        ]
        return np.concatenate([np.zeros(0, np.int32), *bodies])[:, None]

    def _stiffness(self, count):
        bodies = (len(self._selections) or 1) if self.sizes is None else len(self.sizes)
        return self.of_elements("stiffness", bodies)

    def elements_on(self, mesh: Mesh, positions: np.ndarray) -> Elements:
        found = super().elements_on(mesh, positions)
        cells = np.cumsum([0, *(len(body) for body in self._bodies(mesh))])
        return replace(found, cells=cells, refresh=Refresh(EVALUATION, _fit))


def _fit(model, elements, moment):
    cells, d = elements.cells, moment.correction
    kernel = model.kernel(fit_targets, model.dtype, d is not None)
    given = [cells.offsets, elements.stencil, cells.shape, moment.x, d]
    model.launch(kernel, cells.count, given, [elements.rest])
