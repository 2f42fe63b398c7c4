"""Distances of points to a surface of triangles, and samples of a surface."""

import numpy as np
import warp as wp

from ..base.quiet import find_device
from ..base.turns import in_turn
from ..kernels import nearest
from .mesh import areas_of

# Threshold of 2·area over the sum of the squared sides, 0.29 for an equilateral triangle. Below it, a search in float32 is
# dominated by rounding.
_FLAT = 1e-3


def surface_distances(points, x, triangles, device="cpu"):
    """Returns the distance (k,) [m] of points (k, 3) to a surface of triangles (T, 3) of x (n, 3) [m], all finite.

    Warp finds the triangle in float32, its distance is computed in float64: never too small, and too large by at most about
    1e-7 of the size.
    """
    return _nearest(points, x, triangles, device)[0]


def nearest_on_surface(points, x, triangles, device="cpu"):
    """Returns the distance (k,) [m] of each point, the triangle (k,) and the weights (k, 3) of the nearest point Σ wᵢxᵢ.

    A weight is exactly 0 on a side or corner that the point is not above. Arguments are those of :func:`surface_distances`.
    """
    distances, faces = _nearest(points, x, triangles, device)
    return distances, faces, nearest_weights(points, x[triangles[faces]])


@in_turn
def _nearest(points, x, triangles, device):
    low, high = (bound(np.stack([bound(points, axis=0), bound(x, axis=0)]), axis=0) for bound in (np.min, np.max))
    centre = low + 0.5 * (high - low)
    # A power of two, which adds no rounding.
    scale = 2.0 ** np.ceil(np.log2(np.max(high - low) / 2.0 or 1.0))
    points, x = (points - centre) / scale, (x - centre) / scale
    sides = x[triangles] - x[np.roll(triangles, 1, axis=1)]
    flat = 2.0 * areas_of(x, triangles) <= _FLAT * np.einsum("tki,tki->t", sides, sides)
    triangles = np.ascontiguousarray(triangles, dtype=np.int32)
    with wp.ScopedDevice(find_device(device)):
        mesh = wp.Mesh(wp.array(x, dtype=wp.vec3), wp.array(triangles.ravel(), dtype=wp.int32))
        elements = [mesh.id, wp.array(triangles, dtype=wp.vec3i), wp.array(np.flatnonzero(flat), dtype=wp.int32)]
        state = [wp.array(x, dtype=wp.vec3d), wp.array(points, dtype=wp.vec3d)]
        out, faces = wp.empty(len(points), dtype=wp.float64), wp.empty(len(points), dtype=wp.int32)
        wp.launch(nearest.distances(), len(points), inputs=elements + state, outputs=[out, faces])
        return out.numpy() * scale, faces.numpy()


def nearest_weights(points, corners):
    """Barycentric coordinates (k, 3) of the nearest points of triangles (k, 3, 3) to points (k, 3)."""
    a, b, c = corners.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    size = np.maximum(np.einsum("ki,ki->k", normal, normal), 1e-300)
    parts = [np.einsum("ki,ki->k", np.cross(q - p, points - p), normal) / size for p, q in ((b, c), (c, a), (a, b))]
    found = np.stack(parts, axis=1)
    outside = (found < 0.0).any(axis=1) | ~found.any(axis=1)  # or of triangles without area
    best = np.full(len(points), np.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        p, along = corners[:, i], corners[:, j] - corners[:, i]
        t = np.einsum("ki,ki->k", points - p, along) / np.maximum(np.einsum("ki,ki->k", along, along), 1e-300)
        t = np.clip(t, 0.0, 1.0)
        distance = np.linalg.norm(p + t[:, None] * along - points, axis=1)
        nearer = outside & (distance < best)
        best[nearer] = distance[nearer]
        found[nearer] = 0.0
        found[nearer, i], found[nearer, j] = 1.0 - t[nearer], t[nearer]
    return found


def surface_samples(x, triangles, count):
    """Returns at least ``count`` samples of a surface by area: triangles (k,), weights of corners (k, 3) and areas (k,) [m²].

    Each triangle is cut into m² equal parts, none above 3/count of the whole area. Three points of each, with the weights (2/3,
    1/6, 1/6), are exact for polynomials of degree 2 (Strang & Fix 1973).
    """
    areas = areas_of(x, triangles)
    cuts = np.maximum(np.ceil(np.sqrt(count / 3.0 * areas / areas.sum())), 1).astype(int)
    faces, weights, shares = [], [], []
    for m in np.unique(cuts):
        i, j, corner = (each.ravel() for each in np.meshgrid(np.arange(m), np.arange(m), np.arange(3), indexing="ij"))
        second, third = i + np.choose(corner, [1 / 6, 2 / 3, 1 / 6]), j + np.choose(corner, [1 / 6, 1 / 6, 2 / 3])
        turned = i + j >= m  # the cells beyond the diagonal, turned about the middle of the long side, are those between others
        second, third = (np.where(turned, m - each, each) / m for each in (second, third))
        chosen = np.flatnonzero(cuts == m)
        faces.append(np.repeat(chosen, 3 * m * m))
        weights.append(np.tile(np.stack([1.0 - second - third, second, third], axis=1), (len(chosen), 1)))
        shares.append(np.repeat(areas[chosen] / (3 * m * m), 3 * m * m))
    return np.concatenate(faces), np.concatenate(weights), np.concatenate(shares)


class Boundary:
    """The boundary of a surface: sides of one triangle only; vertices at one position count as one.

    Args:
        x: Vertices (n, 3) [m].
        triangles: (T, 3).
    """

    def __init__(self, x, triangles):
        _, one = np.unique(x + 0.0, axis=0, return_inverse=True)
        corners = one.ravel()[triangles]
        sides = np.sort(np.stack([np.roll(corners, -1, axis=1), np.roll(corners, 1, axis=1)], axis=2), axis=2)
        _, number, counts = np.unique(sides @ [len(x), 1], return_inverse=True, return_counts=True)
        self._sides = (counts == 1)[number.reshape(-1, 3)]  # of each triangle that opposite to each corner
        ends = np.zeros(len(x), dtype=bool)
        ends[sides[self._sides]] = True
        self._corners = ends[corners]

    def has(self, faces, weights):
        """Returns which points with weights (k, 3) in triangles (k,) are on the boundary, (k,)."""
        zero = weights == 0.0
        on_side, at_corner = zero.sum(axis=1) == 1, zero.sum(axis=1) == 2
        of_side = self._sides[faces, np.argmax(zero, axis=1)]
        return (on_side & of_side) | (at_corner & self._corners[faces, np.argmin(zero, axis=1)])
