"""Distances of points to a surface of triangles, in float64, with Warp's `wp.Mesh` for the search."""

import numpy as np
import warp as wp

from ..base.quiet import find_device
from ..base.turns import in_turn
from ..kernels import nearest
from ..mesh.mesh import areas_of

# Threshold of 2·area over the sum of the squared sides, 0.29 for an equilateral triangle. Below it, a search in float32 is
# dominated by rounding.
_FLAT = 1e-3


@in_turn
def surface_distances(points, x, triangles, device="cpu"):
    """Returns the distance (k,) [m] of each point to a surface of triangles, degenerate ones included.

    Warp searches in float32, relative to the centre and size of both; the distance to the triangle that it finds is computed in
    float64. So a distance is never too small. It may be too large by the rounding of the search, about 1e-7 of the size, if
    another triangle is nearer by less than that.

    Args:
        points: (k, 3) [m], finite.
        x: Vertices of the surface (n, 3) [m], finite.
        triangles: (T, 3), at least one.
        device: A Warp device.
    """
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
        out = wp.empty(len(points), dtype=wp.float64)
        wp.launch(nearest.distances(), len(points), inputs=elements + state, outputs=[out])
        return out.numpy() * scale
