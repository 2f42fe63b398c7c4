"""All pairs of a vertex and a triangle, and of two edges, with their distances and the energy of contact, in NumPy."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from support.judges import barrier


def from_segment(p, a, b):
    """Distances of points to segments (…, 3)."""
    e = b - a
    length = (e * e).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        t = np.where(length > 0.0, ((p - a) * e).sum(axis=-1) / length, 0.0).clip(0.0, 1.0)
    return np.linalg.norm(p - a - t[..., None] * e, axis=-1)


def from_triangle(p, a, b, c):
    """Distances of points to triangles, by their sides, and by their planes where a point is above the inside."""
    n = np.cross(b - a, c - a)
    size = np.linalg.norm(n, axis=-1)
    found = np.minimum(np.minimum(from_segment(p, a, b), from_segment(p, b, c)), from_segment(p, c, a))
    inside = size > 0.0
    for one, other in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(other - one, p - one) * n).sum(axis=-1) >= 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(inside, np.abs(((p - a) * n).sum(axis=-1)) / size, found)


def between_edges(a, b, c, d):
    """Distances of segments: from an end of one to the other, or of the lines where both feet are inside."""
    found = np.minimum(from_segment(a, c, d), from_segment(b, c, d))
    found = np.minimum(found, np.minimum(from_segment(c, a, b), from_segment(d, a, b)))
    e, f, r = b - a, d - c, a - c
    ee, ff, ef, er, fr = ((u * v).sum(axis=-1) for u, v in ((e, e), (f, f), (e, f), (e, r), (f, r)))
    det = ee * ff - ef * ef
    with np.errstate(invalid="ignore", divide="ignore"):
        s, t = (ef * fr - er * ff) / det, (ee * fr - ef * er) / det
        inside = (det > 1e-12 * ee * ff) & (s >= 0.0) & (s <= 1.0) & (t >= 0.0) & (t <= 1.0)
        return np.where(inside, np.linalg.norm(r + s[..., None] * e - t[..., None] * f, axis=-1), found)


_AT_REST = {}  # by the id of a mesh, which is kept, so that no other has it


def _at_rest(mesh):
    """Of pairs of either kind that share no vertex: stencils, what measures their distance, and it at rest."""
    points, kinds = mesh.points, []
    v, t = (each.ravel() for each in np.meshgrid(np.unique(mesh.triangles), np.arange(len(mesh.triangles)), indexing="ij"))
    e, f = np.triu_indices(len(mesh.edges), 1)
    for s, measure in (
        (np.column_stack([v, mesh.triangles[t]]), from_triangle),
        (np.column_stack([mesh.edges[e], mesh.edges[f]]), between_edges),
    ):
        apart = (s[:, :1] != s[:, 1:]).all(axis=1) & (s[:, 1] != s[:, 2]) & (s[:, 1] != s[:, 3])
        s = s[apart]
        kinds.append((s, measure, measure(*points[s.T])))
    return kinds


def pieces(mesh):
    """The number of the connected piece of each vertex."""
    joined = coo_array((np.ones(len(mesh.edges)), tuple(mesh.edges.T)), shape=(len(mesh.points),) * 2)
    return connected_components(joined, directed=False)[1]


def all_pairs(mesh, x):
    """All pairs that share no vertex: (VT stencils, distances now, at rest), and those of edges."""
    if id(mesh) not in _AT_REST:
        _AT_REST[id(mesh)] = mesh, _at_rest(mesh)
    _, kinds = _AT_REST[id(mesh)]
    return [(s, measure(*x[s.T]), rest) for s, measure, rest in kinds]


def least(f, turns=60):
    """The least values over [0, 1] of convex functions f(t) → (m,) at t (m,), by thirds."""
    low, high = 0.0, 1.0
    for _ in range(turns):
        one, other = low + (high - low) / 3.0, high - (high - low) / 3.0
        falls = f(one) > f(other)
        low, high = np.where(falls, one, low), np.where(falls, high, other)
    return np.min([f(0.5 * (low + high)), f(0.0), f(1.0)], axis=0)


def of_two_edges(a, b, c, d):
    """D = min over s and t of ‖y‖ √(1 + ⅛((2s − 1)² + (2t − 1)²))."""

    def square(s, t):
        s, t = np.broadcast_to(s, len(a))[:, None], np.broadcast_to(t, len(a))[:, None]
        y = a + s * (b - a) - c - t * (d - c)
        return (y * y).sum(axis=1) * (1.0 + 0.125 * ((2.0 * s - 1.0) ** 2 + (2.0 * t - 1.0) ** 2))[:, 0]

    return np.sqrt(least(lambda s: least(lambda t: square(s, t))))


def energies(mesh, x, r, k):
    """U of vertices and of pairs of edges [J]: plain sums over all faces, edges and vertices, without their cancellation."""
    area, (of_faces, of_edges) = mesh.vertex_areas, all_pairs(mesh, x)
    piece, total = pieces(mesh), 0.0
    at_edges, at_vertices = {}, {}  # the numbers of faces at each edge, and of faces minus edges at each vertex
    s, now, rest = of_faces
    acts = (piece[s[:, 0]] != piece[s[:, 1]]) | (rest >= 2.0 * r)
    for (v, *face), d in zip(s[acts], now[acts], strict=True):
        total += area[v] * barrier(d, r)
        for p, q in ((0, 1), (1, 2), (2, 0)):
            key = v, *sorted((face[p], face[q]))
            at_edges[key] = at_edges.get(key, 0) + 1
            at_vertices[v, face[p]] = at_vertices.get((v, face[p]), 0) + 1
    for (v, p, q), count in at_edges.items():
        total += area[v] * (1 - count) * barrier(from_segment(x[v], x[p], x[q]), r)
        for end in (p, q):
            at_vertices[v, end] -= 1
    for (v, p), more in at_vertices.items():
        total += area[v] * (1 + more) * barrier(np.linalg.norm(x[v] - x[p]), r)
    s, now, rest = of_edges
    s = s[((piece[s[:, 0]] != piece[s[:, 2]]) | (rest >= 2.0 * r)) & (now < 0.25 * r)]
    share = area / np.bincount(mesh.edges.ravel(), minlength=len(x))
    b, b_other = (
        share[ends].sum(axis=1) / np.linalg.norm(mesh.points[ends[:, 1]] - mesh.points[ends[:, 0]], axis=1)
        for ends in (s[:, :2], s[:, 2:])
    )
    D = of_two_edges(*(x[s[:, i]] for i in range(4)))
    return 0.5 * k * total, 0.5 * np.pi * k * (b * b_other * barrier(4.0 * D, r)).sum()


def detect(found, x):
    """A detection with as much room as it takes; its stencils of either kind."""
    positions = found.model.array(x, found.model.vec3)
    found.launch(positions)
    while found.overflowed:
        found.grow()
        found.launch(positions)
    vt, ee = found.counts.numpy()
    return np.split(found.stencils.numpy()[: vt + ee], [vt])
