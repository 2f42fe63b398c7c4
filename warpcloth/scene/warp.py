"""The warp of a fabric on a mesh."""

import warnings

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import array, as_array
from ..mesh.mesh import Mesh
from ..terms.woven import along_s

_FACING = 0.99  # cosine of the angle between x and a normal, above which a triangle faces x


def warp_on(mesh: Mesh, warp: ArrayLike | None = None) -> np.ndarray | None:
    """Returns ``warp``, or vectors along the warp, (3,) or (T, 3); None if the mesh gives them to all triangles.

    Raises:
        ValueError: ``warp`` has another shape, or is normal to a triangle.

    Warns:
        UserWarning: Triangles have no texture coordinates; their warp is along x at rest, or y if they face x.
    """
    x, st = mesh.points[mesh.triangles], mesh.corner_coordinates
    normals = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    if warp is not None:
        vectors = array("warp", warp, (3,) if as_array(warp).ndim < 2 else (len(x), 3))
        across = np.linalg.norm(np.cross(normals, vectors), axis=1)
        for t in np.flatnonzero(across <= 1e-6 * np.linalg.norm(normals, axis=1) * np.linalg.norm(vectors, axis=-1))[:1]:
            raise ValueError(f"warp (warpcloth:warp) has no direction in triangle {t}; it must have a part in its plane")
        return vectors
    given = np.zeros((len(x), 3)) if st is None else along_s(x, st)
    size = np.linalg.norm(given, axis=1)
    lacking = ~(size > 1e-9 * size.max(initial=0.0))
    if not lacking.any():
        return None
    facing = np.abs(normals[:, 0]) > _FACING * np.linalg.norm(normals, axis=1)
    warp = np.where(lacking[:, None], np.where(facing[:, None], (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)), given)
    what = "the mesh has no texture coordinates;"
    if not lacking.all():
        what = f"triangle {np.argmax(lacking)} and {lacking.sum() - 1} others have no area in their texture coordinates; there"
    axis = {0: "x", 1: "y"}.get(facing[lacking].mean(), "x, or along y where triangles face x")
    other = "to set another, give warp: -p warp=0,0,1 with a mesh file, warpcloth:warp in a stage"
    warnings.warn(f"{what} the warp of the fabric is along {axis} of the rest shape; {other}", stacklevel=4)
    return warp[0] if np.array_equal(warp[:-1], warp[1:]) else warp
