"""The warp of a fabric on a mesh: along the texture coordinate s, and along an axis where there is none."""

import warnings

import numpy as np

from ..mesh.mesh import Mesh
from ..terms.woven import along_s

_FACING = 0.99  # cosine of the angle between x and a normal, above which a triangle faces x


def warp_on(mesh: Mesh, corner_coordinates: np.ndarray | None = None) -> np.ndarray | None:
    """Returns vectors along the warp of a fabric, (3,) or (T, 3), of any length.

    Args:
        mesh: The mesh.
        corner_coordinates: Texture coordinates of the corners of each triangle (T, 3, 2), if the mesh has none of vertices.

    Returns:
        np.ndarray: None if the texture coordinates of the mesh give the warp of all triangles.

    Warns:
        UserWarning: Triangles have no texture coordinates. Their warp is along x of the rest shape, or along y if they face x.
    """
    if not len(mesh.triangles):
        return None
    sides = np.diff(mesh.points[mesh.triangles], axis=1)
    normals = np.cross(sides[:, 0], sides[:, 1])
    facing = np.abs(normals[:, 0]) > _FACING * np.linalg.norm(normals, axis=1)
    warp, lacking = np.where(facing[:, None], (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)), np.ones(len(facing), dtype=bool)
    st = corner_coordinates if mesh.texture_coordinates is None else mesh.texture_coordinates[mesh.triangles]
    if st is not None:
        given = along_s(mesh.points[mesh.triangles], st)
        size = np.linalg.norm(given, axis=1)
        lacking = ~(size > 1e-9 * size.max(initial=0.0))
        warp[~lacking] = given[~lacking]
        if mesh.texture_coordinates is not None and not lacking.any():
            return None
    for k in np.flatnonzero(lacking)[:1]:
        what = "the mesh has no texture coordinates"
        if not lacking.all():
            what = f"{lacking.sum()} triangles, the first of them {k}, have no area in their texture coordinates"
        axis = {0: "x", 1: "y"}.get(facing[lacking].mean(), "x, or along y where triangles face x")
        other = "Scene(…, warp=…) or, in a stage, warpcloth:warp sets another"
        warnings.warn(f"{what}; the warp of the fabric is there along {axis} of the rest shape; {other}", stacklevel=4)
    return warp if len(np.unique(warp, axis=0)) > 1 else warp[0]
