"""Sets of vertices around each vertex of a mesh: rings of neighbours, or the nearest points."""

import re

import numpy as np

from .checks import shown
from .rotation import point_sets

_RULE = 'must be "1-ring", "2-ring", "nearest:k=12", "nearest:radius=0.05" [m], "nearest:2%" of the vertices, or a set for each'
_SHARE = 2.0  # per cent


def neighbourhoods(mesh, chosen):
    """The neighbourhood of each vertex, itself among them.

    Rings follow edges. Nearest points are those of the rest shape, as the crow flies: of a garment they may belong to a layer
    that only lies near, and a vertex that is not at a finite place has none. A vertex without a triangle has none, and is in
    none.

    Args:
        mesh: The :class:`warpcloth.Mesh`.
        chosen: "1-ring", "2-ring", "nearest:k=12", "nearest:radius=0.05" [m], "nearest:2%" of the vertices, which is
            "nearest" too; or sets of vertices, (n, k) or n lists.

    Returns:
        tuple: offsets (n + 1,) and members, int32: those of vertex i are members[offsets[i]:offsets[i + 1]].

    Raises:
        ValueError: It is none of these.
    """
    n = len(mesh.points)
    used = np.ones(n, dtype=bool)
    used[mesh.isolated] = False
    if not isinstance(chosen, str):
        sizes, members = point_sets(chosen, n)
        if len(sizes) != n:
            raise ValueError(f"neighbourhood has {len(sizes)} sets, must be one for each of the {n} vertices")
        return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32), members.astype(np.int32)
    ring = re.fullmatch(r"([12])-ring", chosen)
    return _rings(mesh, used, int(ring[1])) if ring else _nearest(mesh, used, chosen)


def _rings(mesh, used, count):
    from scipy.sparse import coo_array

    n, itself = len(used), np.flatnonzero(used)
    rows, columns = (np.concatenate(part) for part in ((*mesh.edges.T, itself), (*mesh.edges.T[::-1], itself)))
    reached = near = coo_array((np.ones(len(rows), dtype=np.int32), (rows, columns)), shape=(n, n)).tocsr()
    for _ in range(count - 1):
        reached = reached @ near
    reached.sort_indices()
    return reached.indptr.astype(np.int32), reached.indices.astype(np.int32)


def _nearest(mesh, used, chosen):
    from scipy.spatial import cKDTree

    vertices = np.flatnonzero(used & np.isfinite(mesh.points).all(axis=1))
    points = mesh.points[vertices]
    found = re.fullmatch(r"nearest(?::(?:(k|radius)=([0-9.eE+-]+)|([0-9.eE+-]+)%))?", chosen)
    kind, value = (None, None) if not found else (found[1] or "share", found[2] or found[3] or _SHARE)
    try:
        value = float(value)
    except (TypeError, ValueError):
        value = np.nan
    if not (np.isfinite(value) and value > 0.0) or (kind == "k" and value % 1) or (kind == "share" and value > 100.0):
        raise ValueError(f"neighbourhood = {shown(chosen)}: {_RULE}")
    tree = cKDTree(points)
    if kind == "radius":
        # One vertex after another: together they may be more than memory holds as Python's lists.
        rows = [np.sort(np.asarray(tree.query_ball_point(point, value), dtype=np.int32)) for point in points]
        sizes = np.array([len(row) for row in rows])
        members = np.concatenate(rows)
    else:
        k = int(value) if kind == "k" else int(np.ceil(value / 100.0 * len(points)))
        if k < 3 or k > len(points):
            raise ValueError(
                f"neighbourhood = {shown(chosen)}: is {k} of the {len(points)} vertices, must be 3 or more and at most all"
            )
        members = np.empty((len(points), k), dtype=np.int32)
        for start in range(0, len(points), 4096):
            part = slice(start, start + 4096)
            members[part] = np.sort(tree.query(points[part], k=k)[1], axis=1)
        sizes = np.full(len(points), k)
        members = members.ravel()
    if sizes.sum() > np.iinfo(np.int32).max:
        raise ValueError(f"neighbourhood = {shown(chosen)}: has {sizes.sum()} members in all, must be less than 2³¹")
    counts = np.zeros(len(used), dtype=np.int64)
    counts[vertices] = sizes
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32), vertices[members].astype(np.int32)
