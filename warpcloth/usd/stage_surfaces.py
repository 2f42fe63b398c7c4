"""The meshes of a stage that may intersect, with colliders and strain limits."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..mesh.mesh import Mesh, Surface
from ..mesh.stage_mesh import StageMesh
from ..scene.colliders import Collider
from ..terms.limit import Limit
from .colliders import collides, errors_at, read_colliders
from .drawn import read_drawn
from .layers import files_of_stage
from .modules import UsdGeom
from .scene import read_limits
from .stage import find_prim, read_stage_mesh, triangles_of_faces
from .values import sentences


@dataclass(frozen=True, eq=False)
class StageSurface:
    """A mesh of a stage.

    Attributes:
        stage: The `StageMesh` with the rest shape, a `Surface`.
        points: Function (time code) → points (n, 3) [m] in world space.
        faces: The face of the prim of each triangle (T,).
        limits: The declared strain limits, and their mesh.
    """

    stage: StageMesh
    points: Callable[[float], np.ndarray]
    faces: np.ndarray
    limits: tuple[list[Limit], Mesh]


@dataclass(frozen=True, eq=False)
class StageSurfaces:
    """The meshes of a stage, read by `read_surfaces`.

    Attributes:
        codes: Time codes of the frames (F,) of all meshes.
        colliders: The colliders, with a keyframe at each frame.
        others: Paths of other visible meshes.
        files: Real paths of the files of the stage.
        stage: The stage, which keeps its prims valid.
    """

    surfaces: list[StageSurface]
    codes: np.ndarray
    rate: float
    colliders: list[Collider]
    others: tuple[str, ...]
    files: tuple[str, ...]
    stage: object


def read_surfaces(path, prims=None):
    """Reads the named meshes of a stage, or those that `read_drawn` takes for cloth, without colliders, at the first frame.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not a stage, or a mesh is missing, invisible or invalid.
    """
    drawn = read_drawn(path)
    with sentences(path):
        shown = {each.path: each for each in drawn.prims}
        found = {name: drawn.stage.GetPrimAtPath(name) for name in shown}
        found = {name: prim for name, prim in found.items() if prim.IsA(UsdGeom.Mesh)}
        free = [name for name, prim in found.items() if not collides(prim)]
        if prims is None:
            found = {name: found[name] for name in free if shown[name].cloth}
            if not found:
                raise ValueError(f"{path}: shows no Mesh prim that is cloth and no collider; name those to be checked as prim")
        else:
            named = {str(prim.GetPath()): prim for prim in (find_prim(drawn.stage, path, each) for each in prims)}
            for name in named:
                if name not in found:
                    raise ValueError(f"{path}, prim {name}: is no mesh that a viewer shows, must be one to be checked")
            found = named
        codes = sorted({code for name in found for code in shown[name].codes}) or [0.0]
        surfaces = []
        for name, prim in found.items():
            stage = read_stage_mesh(path, name, Surface, codes[0])
            counts = triangles_of_faces(prim)
            with errors_at(f"{path}, prim {name}"):
                if shown[name].count != len(stage.mesh.points):
                    count = len(stage.mesh.points)
                    raise ValueError(f"{shown[name].count} points at time code {codes[0]:g}, must be {count} as at rest")
            faces = np.repeat(np.arange(len(counts)), counts)
            surfaces.append(StageSurface(stage, shown[name].points, faces, read_limits(drawn.stage, prim, stage)))

        def frames(samples):
            return codes if samples else codes[:1]

        colliders = read_colliders(drawn.stage, list(found.values()), surfaces[0].stage, frames)
        others = tuple(name for name in free if name not in found)
        files = tuple(sorted(files_of_stage(drawn.stage)))
        return StageSurfaces(surfaces, np.array(codes), drawn.rate, colliders, others, files, drawn.stage)
