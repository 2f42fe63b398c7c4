"""How many degrees of freedom hard and stiff edges leave a cloth: the rank of the Jacobian of their lengths.

E edges between n vertices hold at most E of 3n coordinates (Maxwell 1864, *On the calculation of the equilibrium and stiffness
of frames*). All edges of a triangulated disc are independent, and so leave 3 + its boundary edges, 6 of these rigid motion,
however fine it is; a closed surface is rigid (Gluck 1975, *Almost all simply connected closed surfaces are rigid*), and so is a
grid with both diagonals in each cell. The count is of general position: a flat or evenly curved cloth may have more freedom,
as a regular net has, which bends in any one direction, and loses it as it leaves that shape.
"""

from dataclasses import dataclass

import numpy as np

from .terms import CorotatedMembrane, DihedralBending, NeoHookeanMembrane, QuadraticBending, Spring, StVKMembrane

# Free vertices up to which the rank is found, in a second or a few; time and memory grow faster than they do.
MOST = 20_000
# Edges that a fold is round, whose cost says whether an edge is stiff.
FOLD = 4.0
# Of unit rows: nets of so many vertices have squares of singular values of 1e-9 and more, and zeros rounded to some 1e-13.
_ZERO = 1e-11


@dataclass(frozen=True)
class Freedom:
    """What edges that hold their lengths leave free, in general position.

    Attributes:
        edges: How many hold, each pair of vertices once, without those between pinned vertices.
        hard: Whether some are hard.
        coordinates: Of vertices that are not pinned.
        rank: Of the Jacobian of the lengths with respect to these.
        left: Degrees of freedom that are left, ``coordinates`` − ``rank``.
        rigid: How many of them each piece of cloth has if it is one body that hangs on its pins.
        counted: Whether ``rank`` is the most that so many edges can have, for the mesh is too large to find it.
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
        """Whether nothing but rigid motion is left, and so nothing to bend; where ``counted``, whether that may be."""
        return self.edges > 0 and self.left <= self.rigid


def freedom(scene):
    """What the hard and stiff edges of a scene leave free.

    Springs hold their pairs and membranes the edges of their triangles, where they are hard or stiff: bent round a fold of
    radius r = 4h a net strains by (h/r)²/24, and where that costs more than bending and weight, K/2·((h/r)²/24)² > D/2r² + ρgL,
    the edge holds. K is 2k/√3 of springs, Et of membranes, D that of all bending terms, L the diagonal of the bounding box.
    Limits, which hold only when they are reached, and rigid clusters are left out.

    Args:
        scene: The :class:`warpcloth.Scene`.

    Returns:
        :class:`Freedom`.
    """
    mesh = scene.mesh
    pairs, hard = _held(scene)
    free = np.ones(len(mesh.points), dtype=bool)
    free[scene.pins.vertices] = False
    coordinates, rigid = 3 * int(free.sum()), _rigid(mesh, pairs, free)
    pairs = pairs[free[pairs].any(axis=1)]
    counted = int(free.sum()) > MOST
    rank = min(len(pairs), max(coordinates - rigid, 0)) if counted else rank_of(pairs, free)
    return Freedom(len(pairs), hard, coordinates, rank, coordinates - rank, rigid, counted)


def rank_of(pairs, free):
    """Rank of the Jacobian of the lengths of pairs (E, 2) with respect to the vertices that are free (n,), in general position.

    JᵀJ at random positions has so many eigenvalues that are not 0; those below a small ε are counted by the signs of the pivots
    of JᵀJ − ε (Sylvester's law of inertia).
    """
    from scipy.sparse import csr_array, identity
    from scipy.sparse.linalg import splu

    columns = np.flatnonzero(np.repeat(free, 3))
    if not (len(pairs) and len(columns)):
        return 0
    points = np.random.default_rng(0).normal(size=(len(free), 3))
    along = points[pairs[:, 1]] - points[pairs[:, 0]]
    along /= np.linalg.norm(along, axis=1)[:, None]
    values, places = np.stack([-along, along], axis=1), 3 * pairs[:, :, None] + np.arange(3)
    shape = len(pairs), 3 * len(free)
    J = csr_array((values.ravel(), places.ravel(), 6 * np.arange(len(pairs) + 1)), shape=shape)[:, columns]
    shifted = (J.T @ J - _ZERO * identity(len(columns))).tocsc()
    options = {"SymmetricMode": True, "Equil": False}
    factors = splu(shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return int((factors.U.diagonal() > 0.0).sum())


def _held(scene):
    """Pairs of vertices whose distance is held (E, 2), each once, and whether by something hard."""
    mesh, found, hard = scene.mesh, [np.empty((0, 2), dtype=np.int64)], False
    area, size = mesh.triangle_areas.sum(), np.linalg.norm(np.ptp(mesh.points, axis=0))
    bending = [term.stiffness for term in scene.terms if isinstance(term, (QuadraticBending, DihedralBending))]
    D = sum(float(np.max(stiffness)) for stiffness in bending)
    # Of edges alone no fold strains anything.
    weight = scene.vertex_masses.sum() / area * np.linalg.norm(scene.gravity) * size if area else np.inf
    for term in scene.terms:
        triangles = isinstance(term, (CorotatedMembrane, StVKMembrane, NeoHookeanMembrane))
        if not (triangles or isinstance(term, Spring)):
            continue
        elements = term.elements(mesh, scene.positions)
        stiffness = np.broadcast_to(elements.stiffness, len(elements.stencil))
        pairs = elements.stencil[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2) if triangles else elements.stencil
        K = np.repeat(stiffness, 3) if triangles else 2.0 / np.sqrt(3.0) * stiffness
        radius = FOLD * np.linalg.norm(mesh.points[pairs[:, 1]] - mesh.points[pairs[:, 0]], axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):  # springs between vertices in one position
            stiff = 0.5 * K * (FOLD**-2 / 24.0) ** 2 > 0.5 * D / radius**2 + weight
        found.append(np.sort(pairs[stiff | np.isinf(K)], axis=1))
        hard |= bool(np.isinf(stiffness).any())
    return np.unique(np.concatenate(found), axis=0), hard


def _rigid(mesh, pairs, free):
    """Degrees of freedom of the pieces of cloth, each moved as one body about its pinned vertices."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = len(free)
    joined = np.concatenate([mesh.edges, pairs])
    _, piece = connected_components(coo_array((np.ones(len(joined)), tuple(joined.T)), shape=(n, n)), directed=False)
    sizes, pinned = np.bincount(piece), np.bincount(piece, weights=~free).astype(int)
    unpinned = np.array([0, 3, 5, 6])[np.minimum(sizes, 3)]
    return int(np.maximum(unpinned - np.array([0, 3, 5, 6])[np.minimum(pinned, 3)], 0).sum())
