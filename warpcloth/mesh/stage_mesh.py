"""The record of a cloth that was read from a stage; reading itself is in :mod:`warpcloth.usd`."""

from dataclasses import dataclass

import numpy as np

from ..base.types import FilePath, UpAxis
from .mesh import Mesh


@dataclass(frozen=True, eq=False)
class StageMesh:
    """The mesh of one prim, with what its stage says about space and time.

    Attributes:
        mesh: Rest shape in the stage's world space [m]; vertex i is point i of a Mesh prim.
        path: The file.
        prim: Path of the prim.
        transform: (4, 4) float64; row vectors: x = [p, 1]·transform, from the prim's own space and units to world space [m],
            at the first time code where it is animated.
        meters_per_unit: Metres in one unit of the stage; USD says 0.01 where the stage does not.
        up_axis: "Y" or "Z".
        fps: Frames per second, None where the stage does not say.
        time_codes_per_second: Time codes in a second; USD says 24 where the stage does not.
        start: First time code, None where the stage does not say.
        pins: Sorted vertex indices (p,) int32 by name, of every GeomSubset of points.
        point_vertices: Curves: the vertex of each point of the prim (P,); None for a Mesh prim, where they are the same.
        corner_coordinates: Texture coordinates of the corners of each triangle (T, 3, 2), where vertices on seams have several
            and the mesh has none; else None.
        cloths: Of several cloths, whose meshes ``mesh`` joins, the `StageMesh` of each; else none.
        rest: Whether the stage says a rest shape, the default points; else the mesh is that of one time code.
    """

    mesh: Mesh
    path: FilePath
    prim: str
    transform: np.ndarray
    meters_per_unit: float
    up_axis: UpAxis
    fps: float | None
    time_codes_per_second: float
    start: float | None
    pins: dict[str, np.ndarray]
    point_vertices: np.ndarray | None = None
    corner_coordinates: np.ndarray | None = None
    rest: bool = True
    cloths: tuple["StageMesh", ...] = ()
