"""The part of a direction along which a pair of self-contact stays apart."""

import numpy as np
import pytest
import warp as wp

from warpcloth.kernels.contact.self_gaps import nearest
from warpcloth.kernels.contact.self_planes import part_apart

SAMPLES = 400


@wp.kernel(module="unique", enable_backward=False)
def advance_pairs(
    of_vertex: bool,
    x: wp.array2d(dtype=wp.vec3d),
    p: wp.array2d(dtype=wp.vec3d),
    keep: wp.float64,
    part: wp.array(dtype=wp.float64),
    gaps: wp.array2d(dtype=wp.float64),
):
    """The part of each pair, and its gaps over ``keep`` times that at the start, on the way."""
    e = wp.tid()
    _w, y, _inside = nearest(of_vertex, x[e, 0], x[e, 1], x[e, 2], x[e, 3])
    floor = keep * wp.length(y)
    t = part_apart(of_vertex, x[e, 0], x[e, 1], x[e, 2], x[e, 3], p[e, 0], p[e, 1], p[e, 2], p[e, 3], floor)
    part[e] = t
    for k in range(SAMPLES):
        s = t * wp.float64(k + 1) / wp.float64(SAMPLES)
        _w, y, _inside = nearest(
            of_vertex, x[e, 0] + s * p[e, 0], x[e, 1] + s * p[e, 1], x[e, 2] + s * p[e, 2], x[e, 3] + s * p[e, 3]
        )
        gaps[e, k] = wp.length(y) / floor


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
    given = [of_vertex, *(wp.array(each, dtype=wp.vec3d, device=device) for each in (x, p)), keep]
    wp.launch(advance_pairs, count, given, [part, gaps], device=device)
    t, least = part.numpy(), gaps.numpy().min(axis=1)
    assert (least >= 1.0 - 1e-8).all() and t.max() == 1.0
    if keep == 1.0 and not of_vertex:
        assert (t > 0.0).mean() > 0.5
