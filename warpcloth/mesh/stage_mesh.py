"""The mesh of a cloth that :mod:`warpcloth.usd` reads from a stage."""

from dataclasses import dataclass

import numpy as np

from ..base.types import FilePath, UpAxis
from .mesh import Mesh


@dataclass(frozen=True, eq=False)
class StageMesh:
    """The mesh of one prim, with space and time settings of its stage.

    Attributes:
        mesh: Rest shape in world space [m]; vertex i is point i of a Mesh prim.
        path: The file.
        prim: Path of the prim.
        transform: (4, 4) float64, for row vectors: x = [p, 1]·transform from the prim's space and units to world space [m], at
            the first time code.
        meters_per_unit: Of the stage; USD's default is 0.01.
        up_axis: "Y" or "Z".
        fps: Frames per second, or None.
        time_codes_per_second: Of the stage; USD's default is 24.
        start: First time code, or None.
        pins: Sorted vertices (p,) int32 by name, of every GeomSubset of points.
        point_vertices: The vertex of each point of curves (P,); None for a Mesh prim.
        cloths: The `StageMesh` of each cloth if ``mesh`` joins several; else empty.
        rest: Whether the stage has default points; else the mesh is of one time code.
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
    rest: bool = True
    cloths: tuple["StageMesh", ...] = ()
