"""The plane between a pair of self-contact, and the part of a direction along which it stays apart."""

import numpy as np
import pytest
import warp as wp

from warpcloth.kernels.contact.self_gaps import CORNERS, nearest
from warpcloth.kernels.contact.self_planes import part_apart

SAMPLES = 400


@wp.kernel(module="unique", enable_backward=False)
def advance_pairs(
    of_vertex: bool,
    x: wp.array(dtype=CORNERS),
    p: wp.array(dtype=CORNERS),
    keep: wp.float64,
    part: wp.array(dtype=wp.float64),
    gaps: wp.array2d(dtype=wp.float64),
):
    """The part of each pair, and its gaps over ``keep`` times that at the start, on the way."""
    e = wp.tid()
    _w, y = nearest(of_vertex, x[e])
    floor = keep * wp.length(y)
    t = part_apart(of_vertex, x[e], p[e], floor)
    part[e] = t
    for k in range(SAMPLES):
        s = t * wp.float64(k + 1) / wp.float64(SAMPLES)
        _w, y = nearest(of_vertex, x[e] + s * p[e])
        gaps[e, k] = wp.length(y) / floor


@wp.kernel(module="unique", enable_backward=False)
def nearest_of_pairs(of_vertex: bool, x: wp.array(dtype=CORNERS), out: wp.array(dtype=wp.vec3d)):
    e = wp.tid()
    _w, y = nearest(of_vertex, x[e])
    out[e] = y


@pytest.mark.parametrize("of_vertex", [False, True])
@pytest.mark.parametrize("keep", [0.1, 0.9, 1.0])
def test_pairs_stay_apart_along_their_part(of_vertex, keep, device):
    """Pairs slide far at a gap that is small. One at its floor moves on if it opens, else it would stay there for ever."""
    rng, count = np.random.default_rng(3), 300
    x = np.tile([[-1.0, 0, 0], [1.0, 0, 0], [0, -1.0, 0], [0, 1.0, 0]], (count, 1, 1))
    if of_vertex:
        x[:] = [[0.0, 0, 0], [-1.0, -1.0, 0], [1.0, -1.0, 0], [0, 1.0, 0]]
    x[:, 2:] += rng.uniform(-0.3, 0.3, (count, 1, 3)) * [1, 1, 0]
    sides = np.array([True, not of_vertex, False, False])
    x[:, sides, 2] += 1e-5
    p = rng.uniform(-0.5, 0.5, (count, 4, 3)) * [1, 1, 0.1]
    p[:, sides, 2] += np.linspace(-0.05, 0.15, count)[:, None]
    part, gaps = wp.zeros(count, dtype=wp.float64, device=device), wp.zeros((count, SAMPLES), dtype=wp.float64, device=device)
    given = [of_vertex, *(wp.array(each, dtype=CORNERS, device=device) for each in (x, p)), keep]
    wp.launch(advance_pairs, count, given, [part, gaps], device=device)
    t, least = part.numpy(), gaps.numpy().min(axis=1)
    assert (least >= 1.0 - 1e-8).all() and t.max() == 1.0
    if keep == 1.0 and not of_vertex:
        assert (t > 0.0).mean() > 0.5


COUNT, GAP = 600, 5e-6


def parallel_edges(longest):
    """Edges at angles of 1e-8 to 1e-2 rad (COUNT, 4, 3)."""
    rng = np.random.default_rng(3)
    q, angle = np.linalg.qr(rng.normal(size=(COUNT, 3, 3)))[0], 10.0 ** rng.uniform(-8.0, -2.0, (COUNT, 1))
    first, second, gap = q[:, 0], np.cos(angle) * q[:, 0] + np.sin(angle) * q[:, 1], GAP * q[:, 2]
    ends = longest * rng.uniform(0.1, 1.0, (4, COUNT, 1))
    return np.stack([-ends[0] * first, ends[1] * first, -ends[2] * second - gap, ends[3] * second - gap], axis=1)


def thin_triangles(angle):
    """Vertices above the inside of triangles 10 m long with such an angle (COUNT, 4, 3)."""
    rng = np.random.default_rng(4)
    q, length = np.linalg.qr(rng.normal(size=(COUNT, 3, 3)))[0], rng.uniform(5.0, 10.0, (2, COUNT, 1))
    b, c = length[0] * q[:, 0], length[1] * (np.cos(angle) * q[:, 0] + np.sin(angle) * q[:, 1])
    w = 0.05 + 0.85 * rng.dirichlet([1.0, 1.0, 1.0], COUNT)
    w /= w.sum(axis=1)[:, None]
    return np.stack([w[:, 1:2] * b + w[:, 2:] * c + GAP * q[:, 2], 0.0 * b, b, c], axis=1)


@pytest.mark.parametrize(
    ("of_vertex", "pairs"),
    [
        *(pytest.param(False, parallel_edges(longest), id=f"edges of {longest} m") for longest in (0.1, 1.0, 14.0)),
        *(pytest.param(True, thin_triangles(angle), id=f"angle of {angle}") for angle in (1e-5, 1e-3, 0.1)),
    ],
)
def test_planes_of_pairs_that_are_almost_degenerate(of_vertex, pairs, device):
    """At a gap of 5 µm y separates all vertices by nine tenths of it."""
    out = wp.zeros(COUNT, dtype=wp.vec3d, device=device)
    wp.launch(nearest_of_pairs, COUNT, [of_vertex, wp.array(pairs, dtype=CORNERS, device=device)], [out], device=device)
    y = out.numpy()
    heights = np.einsum("ij,ikj->ki", y / np.linalg.norm(y, axis=1)[:, None], pairs)
    above, below = np.split(heights, [1 if of_vertex else 2])
    assert (above.min(axis=0) - below.max(axis=0) > 0.9 * GAP).all()
