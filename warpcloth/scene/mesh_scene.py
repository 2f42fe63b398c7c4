"""Scenes of mesh files with a fabric."""

import warnings
from pathlib import Path

import numpy as np

from ..base.types import FilePath, UpAxis
from ..mesh.mesh import Mesh
from .scene import Scene

# A cloth above these [kg], [m] is probably in another unit: one in which it is no longer than its last number [m].
_HEAVY, _LARGE = 20.0, 20.0
_UNITS = (("centimetres", 0.01, 5.0), ("millimetres", 0.001, 20.0))


def mesh_scene(
    path: FilePath,
    prim: str | None = None,
    scale: float = 1.0,
    fabric: str = "cotton",
    warp: str | None = None,
    up_axis: UpAxis = "Y",
    duration: float = 2.0,
    fps: float = 60.0,
) -> Scene:
    """Reads a mesh file as a cloth of a fabric: geometry, metres per unit, fabric and its warp, up axis, duration, frame rate.

    Warns:
        UserWarning: The file is probably in another unit.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The mesh cannot be read, or a value is not allowed.
    """
    mesh = Mesh.load(path, prim, scale, up_axis)
    try:
        direction = None if warp is None else [float(number) for number in warp.split(",")]
    except ValueError:
        raise ValueError(f"warp is {warp!r}; it must be three numbers, such as 0,0,1") from None
    scene = Scene(mesh, fabric=fabric, warp=direction, duration=duration, fps=fps, name=Path(path).stem)
    warn_of_unit(path, scene, scale, "--scale {}")
    return scene


def warn_of_unit(path: FilePath, scene: Scene, metres: float, remedy: str) -> None:
    """Warns if a cloth is above 20 m or 20 kg, with a likely unit and the ``remedy``."""
    size, mass = float(np.ptp(scene.mesh.points, axis=0).max()), float(scene.vertex_masses.sum())
    if size <= _LARGE and mass <= _HEAVY:
        return
    likely = [
        f"if the file is in {name}, {remedy.format(unit)} makes it {unit * size / metres:.3g} m"
        for name, unit, longest in _UNITS
        if unit < metres and unit * size / metres <= longest
    ]
    if size <= _UNITS[0][2]:
        likely = ["its density must be in kg/m², of which cloth has 0.02 to 1"]
    hint = "".join(f"; {each}" for each in likely[:1])
    warnings.warn(f"{path}: the cloth is {size:.4g} m long and has {mass:.4g} kg{hint}", stacklevel=3)
