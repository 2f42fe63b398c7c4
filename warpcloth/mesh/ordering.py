"""Vertex orders that keep neighbours near one another in memory."""

from typing import Any

import numpy as np

from .mesh import Mesh

# Smaller meshes fit in caches in any order, and gain less in a second of motion than the import of SciPy costs.
LEAST = 4096


def near_order(mesh: Mesh) -> np.ndarray:
    """Returns the vertices in reverse Cuthill–McKee order of the graph of edges, which keeps neighbours near.

    (Cuthill and McKee 1969, *Reducing the bandwidth of sparse symmetric matrices*; George 1971.)

    Args:
        mesh: The :class:`warpcloth.Mesh`.

    Returns:
        np.ndarray: (n,) int32, for :meth:`warpcloth.Scene.build`.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    n, (a, b) = len(mesh.points), mesh.edges.T
    both = np.concatenate([a, b]), np.concatenate([b, a])
    graph = coo_array((np.ones(len(both[0]), dtype=np.int8), both), shape=(n, n)).tocsr()
    return reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int32)


def spread(mesh: Mesh, order: np.ndarray | None = None) -> float:
    """Returns the mean of |i − j| over the edges (i, j) of a mesh, as it is numbered or in another ``order`` (n,)."""
    ranks = np.arange(len(mesh.points)) if order is None else np.argsort(order)
    return float(np.abs(np.diff(ranks[mesh.edges], axis=1)).mean())


def worthwhile_order(mesh: Mesh) -> np.ndarray | None:
    """Returns `near_order` if the mesh has :data:`LEAST` vertices or more and the `spread` falls below half, else None."""
    if len(mesh.points) < LEAST:
        return None
    order = near_order(mesh)
    return order if spread(mesh, order) < 0.5 * spread(mesh) else None


def order_of_run(scene: Any, solver: Any) -> np.ndarray | None:
    """Returns the vertex order of a run, see `worthwhile_order`, or None to keep that of the scene.

    Gauss–Seidel sweeps keep it, because their result depends on the order of elements by more than rounding.

    Args:
        scene: The :class:`warpcloth.Scene`.
        solver: Options such as ``Explicit(substeps=160)``.
    """
    return None if solver.ordered else worthwhile_order(scene.mesh)
