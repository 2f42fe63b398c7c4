"""Vertex orders that keep neighbours near one another in memory."""

from typing import Any

import numpy as np

from .mesh import Mesh

# Smaller meshes fit in caches in any order, and gain less in a second of motion than the import of SciPy costs.
MIN_VERTICES = 4096


def near_order(mesh: Mesh) -> np.ndarray:
    """Returns the vertices in reverse Cuthill–McKee order of the edges (Cuthill and McKee 1969, *Reducing the bandwidth of
    sparse symmetric matrices*; George 1971), (n,) int32.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    n, (a, b) = len(mesh.points), mesh.edges.T
    both = np.concatenate([a, b]), np.concatenate([b, a])
    graph = coo_array((np.ones(len(both[0]), dtype=np.int8), both), shape=(n, n)).tocsr()
    return reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int32)


def spread(mesh: Mesh, order: np.ndarray | None = None) -> float:
    """Returns the mean of |i − j| over edges (i, j), in the order of the mesh or ``order`` (n,)."""
    ranks = np.arange(len(mesh.points)) if order is None else np.argsort(order)
    return float(np.abs(np.diff(ranks[mesh.edges], axis=1)).mean())


def worthwhile_order(mesh: Mesh) -> np.ndarray | None:
    """Returns `near_order` if the mesh has :data:`MIN_VERTICES` vertices and the `spread` halves, else None."""
    if len(mesh.points) < MIN_VERTICES:
        return None
    order = near_order(mesh)
    return order if spread(mesh, order) < 0.5 * spread(mesh) else None


def order_of_run(scene: Any, solver: Any) -> np.ndarray | None:
    """Returns the vertex order of a run by `worthwhile_order`, or None.

    Gauss–Seidel sweeps keep that of the scene, on which their result depends.
    """
    return None if solver.ordered else worthwhile_order(scene.mesh)
