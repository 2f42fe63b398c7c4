"""As-rigid-as-possible deformation of a rest shape by handles."""

import importlib.util
import warnings
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Literal

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..base.checks import choice, number, numeric, shown, whole
from ..base.quiet import find_device
from ..base.turns import in_turn
from ..base.types import Precision
from ..core.capture import Mirror, Segment
from ..core.sums import Lanes
from ..kernels import arap_cells as cells
from ..kernels import reduce
from ..kernels.vectors import types
from ..mesh.mesh import Mesh
from ..mesh.ordering import worthwhile_order
from ..mesh.selection import distinct_vertices
from ..model.precision import DTYPES
from ..numerics.linear import constant_factor
from ..numerics.rotation import kabsch

Weights = Literal["cotangent", "clamped", "intrinsic", "uniform"]
CellEnergy = Literal["spokes", "spokes_and_rims"]
# A weight below this fraction of the largest counts as rounding.
_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class Deformed:
    """The result of :meth:`Arap.solve`.

    Attributes:
        points: (n, 3) [m], handles at their targets.
        rotations: (n, 3, 3), R_c of the cell of each vertex, fitted to ``points``.
        energies: (iterations + 1,) [m²], at the start and after each iteration, with rotations fitted to those points.
        iterations: Number of iterations.
        converged: Whether the last iteration met the tolerance.
    """

    points: np.ndarray
    rotations: np.ndarray
    energies: np.ndarray
    iterations: int
    converged: bool


class Arap:
    """As-rigid-as-possible deformation of a mesh by handles, with a rotation R_c for the cell of each vertex c.

    Minimises E(x, R) = Σ_c Σ_(i,j)∈c w ‖(xᵢ − xⱼ) − R_c(Xᵢ − Xⱼ)‖² [m²] over the rotations and, with handles at their targets,
    over x. Energies by cells:

    - "spokes": the edges at c (Sorkine & Alexa 2007, *As-rigid-as-possible surface modeling*).
    - "spokes_and_rims": all edges of the triangles at c (Chao, Pinkall, Sanan & Schröder 2010, *A simple geometric model for
      elastic deformations*): Σ_t area ‖∇x − R_c‖² ≥ 0; with "cotangent" only.

    An iteration minimises E exactly over R, then over x by L x = b, factorised once, so the energy never rises. Weights w_ij:

    - "cotangent": ½(cot α + cot β) of the opposite angles; negative if α + β > 180°.
    - "clamped": these, at least 0, without linear precision.
    - "intrinsic": cotangents of the intrinsic Delaunay triangulation and its edges (Fisher et al. 2007), negative only on the
      boundary, for orientable manifolds. Needs libigl: ``pip install -e '.[intrinsic]'`` in the checkout.
    - "uniform": 1; edge meshes take only these.

    Args:
        mesh: The rest shape, a :class:`warpcloth.Mesh`.
        handles: Moved vertices (h,), or a selection, which is sorted; every component of the mesh needs one.
        weights, energy: One of those above.
        device, dtype: A Warp device, and ``"float32"`` or ``"float64"``.

    Attributes:
        handles: (h,) int32, in the order of positions in :meth:`solve`.
        parts: Number of each vertex's connected component (n,), by edges of nonzero weight.
        laplacian: L (n, n), scipy CSR, L_ij = −w_ij, rows summing to 0.
        negative_edges: Edges (k, 2) with a negative weight; with "spokes" a rigid motion may not be a minimum, as a warning
            says.

    Raises:
        ValueError: An argument is not allowed, a vertex is isolated, a component has no handle, or the matrix is not positive
            definite.
        ImportError: "intrinsic" without libigl.

    Examples:
        >>> import warpcloth as wc
        >>> mesh = wc.Mesh.grid(3, 3)
        >>> arap = wc.Arap(mesh, "corners")
        >>> found = arap.solve(mesh.points[arap.handles] + [0, 1, 0])
        >>> round(float((found.points - mesh.points)[:, 1].min()), 6)
        1.0
    """

    @in_turn
    def __init__(
        self,
        mesh: Mesh,
        handles: str | ArrayLike,
        weights: Weights = "cotangent",
        energy: CellEnergy = "spokes",
        device: str = "cpu",
        dtype: Precision = "float64",
    ) -> None:
        from scipy.sparse import coo_matrix, diags

        choice("weights", weights, ("cotangent", "clamped", "intrinsic", "uniform"))
        choice("energy", energy, ("spokes", "spokes_and_rims"))
        choice("dtype", dtype, tuple(DTYPES))
        rims = energy == "spokes_and_rims"
        if rims and weights != "cotangent":
            raise ValueError(
                f'weights is {weights!r}; energy = "spokes_and_rims" takes "cotangent", those of each triangle, and is never '
                'negative; energy = "spokes" takes the others'
            )
        if weights != "uniform" and not len(mesh.triangles):
            raise ValueError(f'weights is {weights!r}, which needs triangles, and this is an edge mesh; use "uniform"')
        if len(mesh.isolated):
            raise ValueError(
                f"vertex {mesh.isolated[0]} is in no triangle and on no edge (isolated vertices of the mesh: "
                f"{len(mesh.isolated)}); remove such vertices, for nothing says where they go"
            )
        self.device, self.dtype = find_device(device), dtype
        self._scalar, self._numpy = DTYPES[dtype]
        self.handles = distinct_vertices("handles", handles, mesh)
        if not len(self.handles):
            raise ValueError(f"handles is {shown(handles)}, which names no vertex; at least one is needed")
        self.handles.setflags(write=False)
        n = len(mesh.points)
        f = n - len(self.handles)

        pairs, w = edge_weights(mesh, weights)
        self.negative_edges = pairs[w < -_ROUNDING * np.abs(w).max(initial=0.0)]
        if len(self.negative_edges) and not rims:
            others = "" if weights == "intrinsic" else 'weights = "intrinsic" do inside the mesh, '
            warnings.warn(
                f"negative weights: {len(self.negative_edges)}, the most negative {w.min():.3g} of edge "
                f"{pairs[w.argmin()].tolist()}, so that the energy can be negative and lowest where nothing is rigid; "
                f'energy = "spokes_and_rims" avoids it, {others}and weights = "clamped" do at the price of linear precision',
                stacklevel=3,
            )
        pairs, w = pairs[w != 0.0], w[w != 0.0]
        adjacency = coo_matrix((w, pairs.T), shape=(n, n)).tocsr()
        adjacency = adjacency + adjacency.T
        self.laplacian = (diags(np.asarray(adjacency.sum(axis=1))[:, 0]) - adjacency).tocsr()
        self.parts = self._connected(adjacency)

        # Free vertices come first, so that the unknowns are a slice of every array.
        near = worthwhile_order(mesh)
        vertices = np.arange(n) if near is None else near
        self._order = np.concatenate([vertices[~np.isin(vertices, self.handles)], self.handles])
        self._rank = np.argsort(self._order)
        system = self.laplacian[self._order[:f]]
        self._coupling = system[:, self.handles]
        self._factor = constant_factor(system[:, self._order[:f]], self.device, self._scalar) if f else None

        # Scales to about unit size near the origin, so that the position and size of a mesh cost no precision. A power of two
        # adds no rounding.
        self._unit = 2.0 ** np.ceil(np.log2(np.ptp(mesh.points, axis=0).max()))
        self._rest = (mesh.points - mesh.points[self.handles].mean(axis=0)) / self._unit
        # The energy of edges that are all strained by 1.
        self._size = 2.0 * float(np.abs(w) @ (np.diff(self._rest[pairs], axis=1)[:, 0] ** 2).sum(axis=1))
        # Energy by the rounding of coordinates of size 1.
        self._rounding = 16.0 * np.finfo(self._numpy).eps ** 2 * np.abs(adjacency).sum()

        vec3, mat33 = types(self._scalar)
        self._x = Mirror(self._zeros(n, vec3))
        self._x_free = self._x.array[:f]
        self._start, self._b = Mirror(self._zeros(f, vec3)), self._zeros(f, vec3)
        self._rotations = Mirror(self._zeros(n, mat33))
        self._energy = Mirror(self._zeros(1, wp.float64))
        self._local = self._record(mesh, pairs, w, rims)

    @in_turn
    def solve(
        self, positions: ArrayLike, iterations: int = 100, tolerance: float = 1e-6, initial: ArrayLike | None = None
    ) -> Deformed:
        """Moves the handles and solves for all points; reuses the factorisation.

        Args:
            positions: Targets of the handles (h, 3) [m].
            iterations: Maximum number of iterations.
            tolerance: Iterations end when one lowers the energy by at most this fraction, the energy of edges with this strain,
                or rounding; 0 makes all.
            initial: Initial points (n, 3) [m]; by default the rest shape, each component moved rigidly to fit its handles best,
                which follows a rigid motion exactly.

        Raises:
            ValueError: An argument is not allowed, or the energy overflows.
        """
        whole("iterations", iterations, 0)
        number("tolerance", tolerance, least=0.0)
        targets = _points("positions", positions, len(self.handles), lambda k: f" of handle {self.handles[k]}")
        f = len(self._start.host)
        with np.errstate(over="ignore", invalid="ignore"):  # the energy shows it
            origin = targets.mean(axis=0)
            held = (targets - origin) / self._unit
            if initial is None:
                x = self.carry(self._rest, self._rest[self.handles], held)
            else:
                x = (_points("initial", initial, len(self._order), lambda i: f" of vertex {i}") - origin) / self._unit
            x[self.handles] = held
            self._x.write(x[self._order])
            self._start.write(-(self._coupling @ held))
        energies = [self._fit(0)]
        least = max(self._rounding * np.abs(x).max() ** 2, tolerance * tolerance * self._size) * self._unit**2
        converged = f == 0
        while f and len(energies) <= iterations and not converged:
            self._factor.solve(self._b, self._x_free)
            energies.append(self._fit(len(energies)))
            fall = energies[-2] - energies[-1]
            converged = tolerance > 0.0 and fall <= max(tolerance * abs(energies[-1]), least)
        if energies[-1] < -least:
            warnings.warn(
                f"the energy ends at {energies[-1]:.3g} m², below 0: negative weights pull the mesh apart; use "
                'energy = "spokes_and_rims", or weights = "clamped"',
                stacklevel=3,
            )
        points = self._x.read()[self._rank] * self._unit + origin
        points[self.handles] = targets
        rotations = self._rotations.read()[self._rank].astype(np.float64)
        return Deformed(points, rotations, np.array(energies), len(energies) - 1, bool(converged))

    def _fit(self, iteration):
        """Fits the rotations to x and gathers the next right-hand side; returns the energy [m²]."""
        self._local()
        energy = float(self._energy.read()[0]) * self._unit**2
        if not np.isfinite(energy):
            raise ValueError(
                f"the energy after {iteration} iterations is {energy}; {self.dtype} does not hold the squares of such lengths"
            )
        return energy

    @in_turn
    def carry(self, points: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Moves points with the handles, each component rigidly by the best fit.

        Args:
            points: (n, 3) [m].
            before: Positions of the handles before (h, 3) [m].
            after: Their positions after (h, 3) [m].

        Returns:
            np.ndarray: (n, 3) [m].
        """
        own = self.parts[self.handles]
        sets = np.split(np.argsort(own, kind="stable"), np.cumsum(np.bincount(own))[:-1])
        rotations = kabsch(before, after, neighbours=sets)
        old, new = (np.stack([held[members].mean(axis=0) for members in sets]) for held in (before, after))
        return np.einsum("nij,nj->ni", rotations[self.parts], points - old[self.parts]) + new[self.parts]

    def _connected(self, adjacency):
        """Returns the connected component of each vertex (n,); each must have a handle."""
        from scipy.sparse.csgraph import connected_components

        count, parts = connected_components(adjacency, directed=False)
        loose = np.setdiff1d(np.arange(count), parts[self.handles])
        if len(loose):
            part = np.flatnonzero(parts == loose[0])
            raise ValueError(
                f"handles leave {len(loose)} of the {count} parts of the mesh without one, the first of them with {len(part)} "
                f"vertices, such as vertex {part[0]}; every part that hangs together needs a handle"
            )
        return parts

    def _record(self, mesh, pairs, w, rims):
        rest, rank, n = self._rest, self._rank, len(self._order)
        vec3, _ = types(self._scalar)
        if rims:
            triangles, cotangents = mesh.triangles, half_cotangents(mesh)
            e0, e1, e2 = (rest[triangles[:, (k + 2) % 3]] - rest[triangles[:, (k + 1) % 3]] for k in range(3))
            c0, c1, c2 = cotangents.T[..., None]
            moments = np.stack([c1 * e1 - c2 * e2, c2 * e2 - c0 * e0, c0 * e0 - c1 * e1], axis=1)
            # The moments of a triangle are the same in the cells of its three vertices.
            entries = np.repeat(triangles, 3, axis=1).ravel(), np.tile(triangles, 3).ravel(), np.tile(moments, (1, 3, 1))
            elements, kernel, weights, kind = triangles, cells.triangle_energy, cotangents, vec3
        else:
            i, j = pairs.T
            moments = w[:, None] * (rest[j] - rest[i])
            entries = np.r_[i, i, j, j], np.r_[j, i, i, j], np.concatenate([moments, -moments, -moments, moments])
            elements, kernel, weights, kind = pairs, cells.edge_energy, w, self._scalar
        cell, member, moments = _summed(rank[entries[0]], rank[entries[1]], entries[2].reshape(-1, 3), n)
        rows = self._compressed(cell, member, moments, n)
        # Every edge is in 2 cells, or every side of a triangle in 3, so that the sum over cells is 2 or 3 times L x = b.
        columns = self._compressed(member, cell, moments / (3 if rims else 2), n)

        index = wp.types.vector(elements.shape[1], wp.int32)
        elements = rank[elements].astype(np.int32)
        order = np.argsort(elements.min(axis=1), kind="stable")  # so that neighbours are read one after another
        elements, weights = wp.array(elements[order], dtype=index, device=self.device), self._array(weights[order], kind)
        energies = self._zeros(len(elements), wp.float64)
        lanes = Lanes(SimpleNamespace(device=self.device, copies=1), len(elements))
        block, of_lanes, of_block, parts = lanes.block, lanes.dim, lanes.of_block, lanes.parts()
        placed = self._array(rest[self._order], vec3)
        # Local variables, because a graph that refers to self would keep the factors alive until the garbage collector runs.
        device, scalar, x, rotations = self.device, self._scalar, self._x.array, self._rotations.array
        total, start, b = self._energy.array, self._start.array, self._b

        def launch(kernel, dim, inputs, output):
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=[output], device=device)

        def fit_cells():
            launch(cells.fit_rotations(scalar), n, [*rows, x], rotations)
            launch(kernel(scalar), len(elements), [elements, weights, placed, rotations, x], energies)
            launch(reduce.partial_sum(block), of_lanes, [energies, len(elements), of_lanes[1]], parts)
            launch(reduce.finish_sum(block), of_block, [parts, 0], total)
            if len(b):
                launch(cells.gather_moments(scalar), len(b), [*columns, rotations, start], b)

        return Segment(self.device, fit_cells)

    def _compressed(self, rows, columns, values, count):
        order = np.lexsort((columns, rows))
        offsets = np.searchsorted(rows[order], np.arange(count + 1))
        indices = [wp.array(part.astype(np.int32), dtype=wp.int32, device=self.device) for part in (offsets, columns[order])]
        return *indices, self._array(values[order], types(self._scalar)[0])

    def _array(self, values, dtype):
        return wp.array(np.ascontiguousarray(values, dtype=self._numpy), dtype=dtype, device=self.device)

    def _zeros(self, shape, dtype):
        return wp.zeros(shape, dtype=dtype, device=self.device)


def _points(name, value, count, label):
    found = numeric(name, value, f"have shape {(count, 3)}")
    if found.shape != (count, 3):
        raise ValueError(f"{name} has shape {found.shape}; it must be {(count, 3)}")
    for k in np.flatnonzero(~np.isfinite(found).all(axis=1))[:1]:
        raise ValueError(f"{name}[{k}]{label(k)} is {found[k].tolist()}; it must be finite")
    return found


def half_cotangents(mesh):
    """Returns signed ½ cot at each corner (T, 3)."""
    corners = mesh.points[mesh.triangles]
    one, other = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    return 0.5 * np.einsum("tki,tki->tk", one, other) / np.linalg.norm(np.cross(one, other), axis=2)


def edge_weights(mesh, weights):
    """Returns edges (E, 2) and their weights (E,)."""
    from scipy.sparse import coo_matrix, triu

    if weights == "uniform":
        return mesh.edges, np.ones(len(mesh.edges))
    n = len(mesh.points)
    if weights == "intrinsic":
        if not importlib.util.find_spec("igl"):
            raise ImportError("weights = 'intrinsic' needs libigl: pip install -e '.[intrinsic]' in the checkout")
        import igl

        triangles = igl.bfs_orient(mesh.triangles.astype(np.int64))[0]  # edge flips need a consistent orientation
        sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
        sides, counts = np.unique(sides, axis=0, return_counts=True)
        for side in sides[counts > 1][:1]:
            raise ValueError(
                'weights is "intrinsic", which needs a manifold that can be oriented, and at edge '
                f"{np.sort(side).tolist()} two triangles run the same way, or three meet; the other weights do without"
            )
        matrix = igl.intrinsic_delaunay_cotmatrix(np.array(mesh.points), triangles)[0]
    else:
        opposite = mesh.triangles[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2)
        matrix = coo_matrix((half_cotangents(mesh).ravel(), np.sort(opposite, axis=1).T), shape=(n, n))
    upper = triu(matrix.tocsr(), 1).tocoo()
    values = np.maximum(upper.data, 0.0) if weights == "clamped" else upper.data
    return np.stack([upper.row, upper.col], axis=1), values


def _summed(rows, columns, values, n):
    keys, inverse = np.unique(rows.astype(np.int64) * n + columns, return_inverse=True)
    rows, columns = np.divmod(keys, n)
    values = np.stack([np.bincount(inverse, axis) for axis in values.T], axis=1)
    keep = values.any(axis=1) | (rows == columns)
    return rows[keep], columns[keep], values[keep]
