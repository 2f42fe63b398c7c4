"""Numbering vertices so that neighbours lie near one another in memory."""

from typing import Any

import numpy as np

from .mesh import Mesh

# Fewer stay in caches whatever their order is, and gain less in a second of motion than loading SciPy takes.
LEAST = 4096


def near_order(mesh: Mesh) -> np.ndarray:
    """The vertices of a mesh in an order that keeps neighbours near: reverse Cuthill–McKee of its edges.

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
    """The mean of |i − j| over the edges of a mesh, as its vertices are numbered or in an ``order`` of them (n,)."""
    ranks = np.arange(len(mesh.points)) if order is None else np.argsort(order)
    return float(np.abs(np.diff(ranks[mesh.edges], axis=1)).mean())


def worthwhile_order(mesh: Mesh) -> np.ndarray | None:
    """`near_order` of a mesh of :data:`LEAST` vertices or more where edges then span less than half as much, else None."""
    if len(mesh.points) < LEAST:
        return None
    order = near_order(mesh)
    return order if spread(mesh, order) < 0.5 * spread(mesh) else None


def order_of_run(scene: Any, solver: Any) -> np.ndarray | None:
    """The order of vertices that a run of a scene has, see `worthwhile_order`; None where it keeps that of the scene.

    Methods whose result depends on the order of elements, Gauss–Seidel sweeps, keep it, for theirs would change by more than
    rounding.

    Args:
        scene: The :class:`warpcloth.Scene`.
        solver: Options such as ``Explicit(substeps=160)``.
    """
    return None if solver.ordered else worthwhile_order(scene.mesh)
