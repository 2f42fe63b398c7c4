"""Counts the degrees of freedom that hard and stiff edges leave, by the rank of the Jacobian of their lengths.

E edges of n vertices remove at most E of 3n degrees of freedom (Maxwell 1864). Closed surfaces are rigid in general position
(Gluck 1975, *Almost all simply connected closed surfaces are rigid*); flat or evenly curved cloth may have more freedom.
"""

from dataclasses import dataclass

import numpy as np

from ..terms.bending import Bending

# Largest number of free vertices for which the rank is computed, in a few seconds; time and memory grow faster than linearly.
MAX_VERTICES = 20_000
# Radius, in edges, of the fold whose cost decides whether an edge is stiff.
FOLD = 4.0
# Squared singular values below this count as 0, for rows of unit length. In nets of up to MAX_VERTICES, nonzero ones are 1e-9
# or more, and zeros round to some 1e-13.
_ZERO = 1e-11


@dataclass(frozen=True)
class Freedom:
    """Degrees of freedom that edges of fixed length leave, in general position.

    Attributes:
        edges: Number of edges of fixed length, but for pairs of pins.
        hard: Whether some of them are hard.
        coordinates: Number of coordinates that are neither pinned nor locked.
        rank: Rank of the Jacobian of the lengths.
        left: ``coordinates`` − ``rank``.
        rigid: Degrees of freedom of the pieces as rigid bodies on their pins.
        counted: Whether ``rank`` is the bound by the number of edges, as the mesh is too large.
    """

    edges: int
    hard: bool
    coordinates: int
    rank: int
    left: int
    rigid: int
    counted: bool

    @property
    def locked(self):
        """Whether only rigid motion is left, or with ``counted`` may be."""
        return self.edges > 0 and self.left <= self.rigid


def freedom(scene):
    """Counts the degrees of freedom that hard and stiff edges of a scene leave.

    Springs hold their pairs, membranes the edges of triangles. An edge is stiff if the strain (h/r)²/24 of a net about a fold
    of radius r = 4h costs more than bending and weight, K/2·((h/r)²/24)² > D/2r² + ρgL, with K = 2k/√3 for springs and Et for
    membranes, D of all bending terms, and L the diagonal of the bounding box. Limits and rigid clusters are ignored.
    """
    mesh = scene.mesh
    pairs, hard = _held(scene)
    free = np.ones((len(mesh.points), 3), dtype=bool) if scene.free_axes is None else scene.free_axes.copy()
    free[scene.fixed] = False
    coordinates, rigid = int(free.sum()), _rigid(mesh, pairs, free)
    pairs = pairs[free[pairs].any(axis=(1, 2))]
    counted = int(free.any(axis=1).sum()) > MAX_VERTICES
    rank = min(len(pairs), max(coordinates - rigid, 0)) if counted else rank_of(pairs, free)
    return Freedom(len(pairs), hard, coordinates, rank, coordinates - rank, rigid, counted)


def rank_of(pairs, free):
    """Rank of the Jacobian of lengths of pairs (E, 2) by free coordinates (n, 3), in general position.

    It is the number of positive pivots of JᵀJ − ε at random positions (Sylvester's law of inertia).
    """
    from scipy.sparse import csr_array, identity
    from scipy.sparse.linalg import splu

    columns = np.flatnonzero(free)
    if not (len(pairs) and len(columns)):
        return 0
    points = np.random.default_rng(0).normal(size=(len(free), 3))
    along = points[pairs[:, 1]] - points[pairs[:, 0]]
    along /= np.linalg.norm(along, axis=1)[:, None]
    values, columns_of = np.stack([-along, along], axis=1), 3 * pairs[:, :, None] + np.arange(3)
    shape = len(pairs), 3 * len(free)
    J = csr_array((values.ravel(), columns_of.ravel(), 6 * np.arange(len(pairs) + 1)), shape=shape)[:, columns]
    shifted = (J.T @ J - _ZERO * identity(len(columns))).tocsc()
    options = {"SymmetricMode": True, "Equil": False}
    factors = splu(shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return int((factors.U.diagonal() > 0.0).sum())


def _held(scene):
    mesh, found, hard = scene.mesh, [np.empty((0, 2), dtype=np.int64)], False
    area, size = mesh.triangle_areas.sum(), np.linalg.norm(np.ptp(mesh.points, axis=0))
    bending = [term.stiffness for term in scene.terms if isinstance(term, Bending)]
    D = sum(float(np.max(stiffness)) for stiffness in bending)
    # A mesh of edges alone does not strain in a fold.
    weight = scene.vertex_masses.sum() / area * np.linalg.norm(scene.gravity) * size if area else np.inf
    for term in scene.terms:
        pairs, K = term.held(mesh, scene.positions)
        radius = FOLD * np.linalg.norm(mesh.points[pairs[:, 1]] - mesh.points[pairs[:, 0]], axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):  # springs between vertices in one position
            stiff = 0.5 * K * (FOLD**-2 / 24.0) ** 2 > 0.5 * D / radius**2 + weight
        found.append(np.sort(pairs[stiff | np.isinf(K)], axis=1))
        hard |= bool(np.isinf(K).any())
    return np.unique(np.concatenate(found), axis=0), hard


def _rigid(mesh, pairs, free):
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = len(free)
    joined = np.concatenate([mesh.edges, pairs])
    _, piece = connected_components(coo_array((np.ones(len(joined)), tuple(joined.T)), shape=(n, n)), directed=False)
    moves = np.array([0, 3, 5, 6])[np.minimum(np.bincount(piece), 3)]
    # Motion of each locked coordinate by the six rigid motions of its piece, in general position. The rank of a piece's Gram
    # matrix is the number of rigid motions that it loses.
    vertices, axes = np.nonzero(~free)
    units = np.eye(3)[axes]
    rows = np.hstack([units, np.cross(np.random.default_rng(0).normal(size=(n, 3))[vertices], units)])
    gram = np.zeros((len(moves), 6, 6))
    for i, j in np.ndindex(6, 6):
        gram[:, i, j] = np.bincount(piece[vertices], weights=rows[:, i] * rows[:, j], minlength=len(moves))
    values = np.linalg.eigvalsh(gram)
    return int((moves - (values > _ZERO * values[:, -1:]).sum(axis=1)).sum())
