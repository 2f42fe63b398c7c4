"""The pairs of vertices and triangles and of edges that are near one another, against all pairs in NumPy."""

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from warpcloth.contact.proximity import Proximity
from warpcloth.model.model import Model


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


def all_pairs(mesh, x):
    """All pairs that share no vertex: (VT stencils, distances now, at rest), and those of edges."""
    points, kinds = mesh.points, []
    v, t = (each.ravel() for each in np.indices((len(points), len(mesh.triangles))))
    e, f = np.triu_indices(len(mesh.edges), 1)
    for s, measure in (
        (np.column_stack([v, mesh.triangles[t]]), from_triangle),
        (np.column_stack([mesh.edges[e], mesh.edges[f]]), between_edges),
    ):
        apart = (s[:, :1] != s[:, 1:]).all(axis=1) & (s[:, 1] != s[:, 2]) & (s[:, 1] != s[:, 3])
        s = s[apart]
        kinds.append((s, measure(*x[s.T]), measure(*points[s.T])))
    return kinds


def pieces(mesh):
    """A number for each connected piece, of each vertex."""
    piece = np.arange(len(mesh.points))
    while True:
        low = piece[mesh.edges].min(axis=1)
        new = piece.copy()
        np.minimum.at(new, mesh.edges.ravel(), np.repeat(low, 2))
        if (new == piece).all():
            return piece
        piece = new


def found_by(model, x, distance, skin):
    """The lists of a detection at x, with as much room as it takes."""
    found = Proximity(model, distance, skin)
    positions = model.array(x, model.vec3)
    found.launch(positions)
    while found.overflowed:
        found.grow()
        found.launch(positions)
    vt, ee = found.counts.numpy()
    stencils, distances = found.stencils.numpy()[: vt + ee], found.distances.numpy()[: vt + ee]
    first, corners = found.first.numpy(), found.corners.numpy()[: 4 * (vt + ee)]
    vertices = stencils.reshape(-1)[corners]
    assert first[-1] == 4 * (vt + ee)
    np.testing.assert_array_equal(vertices, np.repeat(np.arange(model.count), np.diff(first)))
    assert (np.sort(corners) == np.arange(4 * (vt + ee))).all() and (np.diff(corners)[np.diff(vertices) == 0] > 0).all()
    return (stencils[:vt], distances[:vt]), (stencils[vt:], distances[vt:])


def check(mesh, x, distance, skin, dtype="float32", device="cpu", **options):
    """That a model finds the pairs of ``x`` and no others, but those at the limit to rounding; how many there are."""
    model = Model(wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=1.0)]), device=device, dtype=dtype, **options)
    exact = x.astype(model.numpy_dtype).astype(np.float64)
    own = exact if model.order is None else exact[model.order]
    copies = np.tile(own, (model.copies, 1))
    piece, rounding, counts = (
        pieces(mesh),
        64 * np.finfo(model.numpy_dtype).eps * (np.abs(x).max() + np.abs(mesh.points).max()),
        [],
    )
    for (stencils, distances), (s, now, rest) in zip(
        found_by(model, copies, distance, skin), all_pairs(mesh, exact), strict=True
    ):
        cutoff = np.where(piece[s[:, 0]] == piece[s[:, 3]], np.minimum(distance, rest / 2), distance)
        n, count = len(mesh.points), len(stencils) // model.copies
        assert count * model.copies == len(stencils)
        for copy in range(1, model.copies):
            np.testing.assert_array_equal(stencils[copy * count : (copy + 1) * count], stencils[:count] + copy * n)
        mine = stencils[:count] if model.order is None else model.order[stencils[:count]]

        def keyed(rows, edges=len(counts) == 1):
            if edges:
                ends = [tuple(sorted((tuple(sorted(row[:2])), tuple(sorted(row[2:]))))) for row in rows.tolist()]
            else:
                ends = [(row[0], tuple(sorted(row[1:]))) for row in rows.tolist()]
            return ends

        want = dict(zip(keyed(s), zip(now - cutoff - skin, cutoff, strict=True), strict=True))
        have = dict(zip(keyed(mine), distances[:count], strict=True))
        assert len(have) == count
        for pair in want.keys() | have.keys():
            gap, expected = want[pair]
            assert (gap < rounding) if pair in have else (gap > -rounding), (pair, gap)
            if pair in have:
                np.testing.assert_allclose(have[pair], expected, atol=rounding)
        counts.append(count)
    return counts


def folded(mesh, rng, gap, times=3):
    """The points of a mesh, folded over random lines at a gap, and shaken by half of it."""
    x = mesh.points.copy()
    for _ in range(times):
        angle = rng.uniform(0, np.pi)
        along, middle = np.array([np.cos(angle), 0, np.sin(angle)]), x[rng.integers(len(x))]
        side = (x - middle) @ along
        over = side > 0
        x[over] -= 2 * side[over, None] * along
        x[over, 1] += gap
    return x + rng.uniform(-0.5, 0.5, x.shape) * gap


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_folded_cloth_has_the_pairs_of_all_pairs(dtype, device):
    rng = np.random.default_rng(3)
    mesh = wc.Mesh.grid(9, 11, pattern="alternating")
    counts = [check(mesh, folded(mesh, rng, 0.02), 0.02, 0.01, dtype, device) for _ in range(3)]
    assert np.min(counts) > 20
