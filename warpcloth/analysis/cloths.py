"""All meshes of a source that may intersect, with its colliders and limits."""

import os
from collections.abc import Callable, Iterable
from collections.abc import Sequence as Several
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import as_array, number, shown
from ..base.outputs import STAGE_ENDINGS
from ..base.types import FilePath, UpAxis
from ..mesh.loading import ENDINGS
from ..mesh.mesh import Mesh, Surface, same_topology
from ..mesh.sequences import HasPoints, Sequence, as_sequence, open_sequence
from ..mesh.stage_mesh import StageMesh
from ..scene.colliders import Collider
from ..scene.scene import Scene
from ..terms.limit import Limit
from ..usd.stage_surfaces import read_surfaces
from .stretch_limits import StretchLimit, declared_limits


@dataclass(frozen=True, eq=False)
class Cloths:
    """The meshes of a source, one after another.

    Attributes:
        names: Paths of prims or parts of a mesh; "" if there is one.
        mesh: All meshes as one `Surface`, at rest.
        first: First vertex of each mesh (M,).
        owner: Index of the mesh of each triangle (T,).
        faces: Face of each triangle in its mesh (T,).
        labels: Frame numbers of the source (F,).
        times: (F,) [s], or None.
        read: Function (index) → points (n, 3) [m], which may be infinite or NaN.
        missing: Numbers of missing frames.
        others: Paths of other meshes of a stage.
        stages: The `StageMesh` of each, or empty.
    """

    names: tuple[str, ...]
    mesh: Surface
    first: np.ndarray
    owner: np.ndarray
    faces: np.ndarray
    labels: np.ndarray
    times: np.ndarray | None
    read: Callable[[int], np.ndarray]
    precision: type = np.float64
    missing: Several[float] = ()
    colliders: Several[Collider] = ()
    limits: Several[StretchLimit] = ()
    others: Several[str] = ()
    stages: Several[StageMesh] = ()
    files: Several[Any] = ()
    up_axis: UpAxis | None = None

    def face(self, triangle: int) -> tuple[str, int]:
        """Returns the mesh of a triangle, and its face there."""
        return self.names[self.owner[triangle]], int(self.faces[triangle])

    def vertex(self, vertex: int) -> tuple[str, int]:
        """Returns the mesh of a vertex, and its index there."""
        owner = int(np.searchsorted(self.first, vertex, side="right")) - 1
        return self.names[owner], int(vertex - self.first[owner])


def cloths_of(
    source: FilePath | Sequence | ArrayLike | HasPoints,
    mesh: Mesh | ArrayLike | None = None,
    prim: str | Iterable[str] | None = None,
    fps: float | None = None,
) -> Cloths:
    """Returns the :class:`Cloths` of a source, by the arguments of :func:`warpcloth.intersections`."""
    if fps is not None:
        number("fps", fps, above=0.0)
    prims = [prim] if isinstance(prim, str) else prim if prim is None else list(prim) if isinstance(prim, Iterable) else []
    if prims is not None and not (prims and all(isinstance(each, str) for each in prims)):
        raise ValueError(f"prim is {shown(prim)}; it must be a path or name, or several, or None")
    if isinstance(source, (str, os.PathLike)):
        found = _of_path(os.fspath(source), mesh, prims, fps)
    elif prims is not None:
        raise ValueError(f"prim is {shown(prim)}; of a source that is no path it must be None")
    elif isinstance(source, Sequence) and source.stage is not None and source.path is not None:
        found = _of_stage(os.fspath(source.path), [source.stage.prim], fps)
    elif isinstance(source, Sequence):
        found = _of_sequence(source)
    else:
        found = _of_points(source, mesh)
    if isinstance(mesh, Mesh):
        if not same_topology(mesh, found.mesh):
            count, own = len(mesh.triangles), len(found.mesh.triangles)
            raise ValueError(f"mesh has {count} triangles; it must have those of the frames, {own}, in their order")
        found = replace(found, mesh=Surface(mesh.points, mesh.triangles))
    return found


def _of_path(path, mesh, prims, fps):
    ending = Path(path).suffix.lower()
    if ending in STAGE_ENDINGS and os.path.exists(path):
        return _of_stage(path, prims, fps)
    if prims is not None and len(prims) > 1:
        raise ValueError(f"prim is {shown(prims)}; of files that are no stage it must be one name, or None")
    name = prims[0] if prims else None
    if ending in ENDINGS and os.path.isfile(path):
        one = Surface.load(path, name)
        return _of_sequence(as_sequence(one, one.points[None]), (path,))
    return _of_sequence(open_sequence(path, name, fps, mesh if isinstance(mesh, Mesh) else None))


def _of_points(source, mesh):
    scene = source if isinstance(source, Scene) else getattr(source, "scene", None)
    points = source.positions if isinstance(source, Scene) else getattr(source, "points", source)
    if mesh is None:
        mesh = source if isinstance(source, Mesh) else getattr(source, "mesh", None) if scene is None else scene.mesh
    if mesh is None:
        raise ValueError(
            f"mesh is not given; {type(source).__name__} has no triangles, so that it must be a Mesh or its triangles"
        )
    if not hasattr(points, "shape"):
        points = as_array(points)
    if points.ndim == 2:
        points = points[None]
    if points.ndim != 3 and points.size:
        raise ValueError(f"frames is {shown(source)}; it must be points (n, 3) or (F, n, 3), or what has some")
    if not isinstance(mesh, Mesh):
        if not len(points):
            raise ValueError("frames is empty; there must be one at least")
        mesh = Surface(points[0], mesh)
    found = _of_sequence(as_sequence(mesh, points, times=getattr(source, "times", None)))
    if scene is None:
        return found
    limits = declared_limits([term for term in scene.terms if isinstance(term, Limit)], scene.mesh)
    return replace(found, colliders=tuple(scene.colliders), limits=limits, up_axis=scene.up_axis)


def _of_sequence(sequence, files=None):
    mesh = sequence.mesh
    parts = mesh.parts or {"": None}
    first = np.array([0 if part is None else part.first for part in parts.values()])
    owner = np.searchsorted(first, mesh.triangles[:, 0], side="right") - 1
    counts = np.bincount(owner, minlength=len(first))
    faces = np.arange(len(owner)) - (np.cumsum(counts) - counts)[owner]
    return Cloths(
        tuple(parts),
        Surface(mesh.points, mesh.triangles),
        first,
        owner,
        faces,
        sequence.labels,
        sequence.times,
        sequence.__getitem__,
        sequence.precision,
        sequence.missing,
        files=tuple(sequence.files) if files is None else files,
        up_axis=sequence.up_axis or mesh.up_axis,
    )


def _of_stage(path, prims, fps):
    stage = read_surfaces(path, prims)
    surfaces = stage.surfaces
    rests = [each.stage.mesh for each in surfaces]
    sizes = [len(rest.points) for rest in rests]
    first = np.cumsum([0, *sizes[:-1]])
    triangles = np.concatenate([rest.triangles + start for rest, start in zip(rests, first, strict=True)])
    owner = np.repeat(np.arange(len(rests)), [len(rest.triangles) for rest in rests])
    limits = [
        limit
        for each, start in zip(surfaces, first, strict=True)
        for limit in declared_limits(*each.limits, start, str(each.stage.prim) if len(surfaces) > 1 else "")
    ]
    codes = stage.codes
    return Cloths(
        tuple(str(each.stage.prim) for each in surfaces),
        Surface(np.concatenate([rest.points for rest in rests]), triangles),
        first,
        owner,
        np.concatenate([each.faces for each in surfaces]),
        codes.astype(np.int64) if np.array_equal(codes, np.rint(codes)) else codes,
        (codes - codes[0]) / (stage.rate if fps is None else fps),
        lambda frame: np.concatenate([each.points(codes[frame]) for each in stage.surfaces]),
        np.float32,
        colliders=tuple(stage.colliders),
        limits=tuple(limits),
        others=stage.others,
        stages=tuple(each.stage for each in surfaces),
        files=stage.files,
        up_axis=surfaces[0].stage.up_axis,
    )
