"""Neighbourhoods of vertices: rings or nearest points."""

import re
import warnings

import numpy as np

from ..base.checks import shown
from ..numerics.rotation import point_sets

_RULE = 'must be "1-ring", "2-ring", "nearest:k=12", "nearest:radius=0.05" [m], "nearest:2%" of the vertices, or a set for each'
_SHARE = 2.0  # per cent
# Points count as on a line if their spread across it is at most this fraction of the spread along it. Rotations about the line
# would amplify errors a hundredfold.
_LINE = 0.01
# Number of nearest points that are checked for all vertices at once; only on very uneven meshes, more lie on a line.
_FEW = 8


def neighbourhoods(mesh, chosen):
    """Returns the neighbourhood of each vertex, itself included: those of vertex i are members[offsets[i]:offsets[i + 1]],
    int32.

    Rings follow edges; nearest points are in space at rest, maybe of another layer. A vertex without a triangle has none and is
    in none; without a finite position it has no nearest points. A percentage that determines no rotation takes more vertices,
    with a warning.

    Args:
        mesh: The mesh.
        chosen: "1-ring", "2-ring", "nearest:k=12", "nearest:radius=0.05" [m], "nearest:2%" of the vertices (the default of
            "nearest"); or sets of vertices, (n, k) or n lists.

    Raises:
        ValueError: ``chosen`` is none of these.
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
    if not len(points):
        raise ValueError(f"neighbourhood = {shown(chosen)}: no vertex with a triangle is at a finite position, one must be")
    tree = cKDTree(points)
    if kind == "radius":
        # One vertex after another, because Python lists of all may exceed the memory.
        rows = [np.sort(np.asarray(tree.query_ball_point(point, value), dtype=np.int32)) for point in points]
        sizes = np.array([len(row) for row in rows])
        members = np.concatenate(rows)
    else:
        k = int(value) if kind == "k" else int(np.ceil(value / 100.0 * len(points)))
        if (kind == "k" and k < 3) or max(k, 3) > len(points):
            raise ValueError(
                f"neighbourhood is {shown(chosen)}, {k} of the {len(points)} vertices; it must be 3 or more, at most all"
            )
        sizes, members = _sets(tree, k, widen=kind == "share")
        if wide := np.count_nonzero(sizes > k):
            warnings.warn(
                f"neighbourhood = {shown(chosen)}: {k} of the {len(points)} vertices determine{'s' * (k == 1)} no rotation at "
                f"{wide} of them; there it takes the fewest nearest that do, {sizes[sizes > k].min()} to {sizes.max()}",
                stacklevel=2,
            )
    if sizes.sum() > np.iinfo(np.int32).max:
        raise ValueError(f"neighbourhood is {shown(chosen)}, with {sizes.sum()} members in all; it must have less than 2³¹")
    counts = np.zeros(len(used), dtype=np.int64)
    counts[vertices] = sizes
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32), vertices[members].astype(np.int32)


def _sets(tree, k, widen):
    """Finds sizes (n,) and members of the sets of k nearest points; ``widen`` adds points until they determine a rotation."""
    points, n = tree.data, tree.n
    most = min(max(k, _FEW), n) if widen else k
    todo = [(np.arange(start, min(start + 4096, n)), 3, most) for start in range(0, n, 4096)]
    pieces, sizes = [], np.empty(n, dtype=np.int64)
    while todo:
        part, least, most = todo.pop()
        near = tree.query(points[part], k=most)[1]
        size = np.full(len(part), 0 if widen else k)
        for count in range(least, most + 1):  # ends soon, as three or four points are seldom on a line
            unknown = np.flatnonzero(size == 0)
            if not len(unknown):
                break
            size[unknown[~_on_a_line(points[near[unknown, :count]])]] = max(count, k)
        open_, found = (size == 0) & (most < n), (size > 0) | (most == n)
        size[size == 0] = n
        if open_.any():
            todo.append((part[open_], most + 1, min(2 * most, n)))
        near = np.where(np.arange(most) < size[:, None], near, n)[found]
        sizes[part[found]] = size[found]
        pieces.append((part[found], np.sort(near, axis=1)))
    ends, members = np.cumsum(sizes), np.empty(sizes.sum(), dtype=np.int32)
    for part, near in pieces:
        at = (ends - sizes)[part][:, None] + np.arange(near.shape[1])
        members[at[near < n]] = near[near < n]
    return sizes, members


def _on_a_line(sets):
    spread = np.linalg.svd(sets - sets.mean(axis=1, keepdims=True), compute_uv=False)
    return ~(spread[:, 1] > _LINE * spread[:, 0])
