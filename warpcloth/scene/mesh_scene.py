"""Scenes of mesh files, which have no physics: the cloth is made of a fabric."""

import warnings
from pathlib import Path

import numpy as np

from ..base.types import FilePath, UpAxis
from ..mesh.mesh import Mesh
from .scene import Scene

# A cloth above these is probably in another unit [kg], [m]; in the unit that is meant it is at most _COMMON [m].
_HEAVY, _LARGE, _COMMON = 20.0, 20.0, 5.0
_UNITS = {0.01: "centimetres", 0.001: "millimetres"}


def mesh_scene(
    path: FilePath,
    prim: str | None = None,
    scale: float = 1.0,
    fabric: str = "cotton",
    up_axis: UpAxis = "Y",
    duration: float = 2.0,
    fps: float = 60.0,
) -> Scene:
    """Reads a mesh file as a cloth of a fabric: geometry, metres per unit, fabric, up axis, duration [s], frames per second.

    Args:
        path: A file of :meth:`warpcloth.Mesh.load` that is not a stage.
        prim: Name of the geometry, if the file has several.
        scale: Metres per unit of the file, such as 0.01 for centimetres.
        fabric: Name of a fabric.
        up_axis: "Y" or "Z".
        duration: Duration [s].
        fps: Frames per second.

    Warns:
        UserWarning: See :func:`warn_of_unit`.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The mesh cannot be read, or a value is not allowed.
    """
    mesh = Mesh.load(path, prim, scale, up_axis)
    scene = Scene(mesh, fabric=fabric, duration=duration, fps=fps, name=Path(path).stem)
    warn_of_unit(path, scene, scale, "--scale {}")
    return scene


def warn_of_unit(path: FilePath, scene: Scene, metres: float, remedy: str) -> None:
    """Warns if a cloth is so large or heavy that its file is probably in another unit.

    Args:
        path: The file.
        scene: Its scene.
        metres: Metres per unit of the file as it was read.
        remedy: How a user sets them, with {} for their number.

    Warns:
        UserWarning: The cloth is above 20 m or 20 kg.
    """
    size, mass = float(np.ptp(scene.mesh.points, axis=0).max()), float(scene.vertex_masses.sum())
    if size > _LARGE or mass > _HEAVY:
        unit = next((unit for unit in _UNITS if unit < metres and unit * size / metres <= _COMMON), min(_UNITS))
        likely = f"if the file is in {_UNITS[unit]}, {remedy.format(unit)} makes it {unit * size / metres:.3g} m"
        if size <= _COMMON:
            likely = "its density must be in kg/m², of which cloth has 0.02 to 1"
        warnings.warn(f"{path}: the cloth is {size:.4g} m long and has {mass:.4g} kg; {likely}", stacklevel=3)
