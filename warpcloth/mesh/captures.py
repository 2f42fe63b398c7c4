"""Captures: measured surfaces whose triangles may change from frame to frame, with noise and holes.

`open_capture` takes all that `open_sequence` takes. A folder or pattern of mesh files may have another mesh in each file, and
the files may end with .stl, .glb and .gltf too. `as_capture` takes meshes in memory.
"""

import operator
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike

from ..base import checks
from ..base.types import FilePath, UpAxis
from .loading import ENDINGS, read_faces
from .mesh import Mesh, Surface
from .polygons import loose_triangles_of
from .sequences import Sequence, increasing, missing_labels, numbered_files, open_sequence


@dataclass(frozen=True, eq=False)
class Capture:
    """Frames that each have a mesh of their own. Indexing reads a frame and keeps nothing, so that memory stays constant.

    `capture[i]` is the mesh of frame i, a `Surface` with points [m] as the input has them, NaN included. Triangles with a
    corner that is not finite count as holes.

    Attributes:
        labels: Frame numbers of the input (F,).
        times: (F,) [s], increasing; None if the input gives none.
        read: Function that returns the mesh of a frame from its index, 0 to F − 1.
        path: The file, folder or pattern, or None.
        files: Paths of the files that frames are read from.
        up_axis: "Y" or "Z"; None if the input does not say.
    """

    labels: np.ndarray
    times: np.ndarray | None
    read: Callable[[int], Surface]
    path: FilePath | None = None
    files: tuple[Any, ...] = ()
    up_axis: UpAxis | None = None

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, frame: SupportsIndex) -> Surface:
        return self.read(range(len(self))[operator.index(frame)])

    @cached_property
    def missing(self) -> list[float]:
        """Labels that are missing between the first and the last; see `missing_labels`."""
        return missing_labels(self.labels, self.path)


def open_capture(path: FilePath, prim: str | None = None, fps: float | None = None, scale: float = 1.0) -> Capture:
    """Opens a capture from a file, a folder or a pattern.

    Args:
        path: A folder or pattern of mesh files, the last number in a name being that of the frame; or a stage or an .npz file,
            see `open_sequence`.
        prim: Path or name of the prim, or name of the geometry in each file, if there are several.
        fps: Frames per second: of numbers in file names, or of time codes in place of the stage's rate.
        scale: Length of a unit of mesh files [m], such as 1e-3 for millimetres. Stages and arrays say theirs or are in metres.

    Returns:
        Capture: Of files, none has been read.

    Raises:
        FileNotFoundError: There is no such file or folder.
        ValueError: The format is none of these, or there are no frames. The message begins with the path. A file that cannot be
            read raises when its frame is read.
    """
    if fps is not None:
        checks.number("fps", fps, above=0.0)
    checks.number("scale", scale, above=0.0)
    files = numbered_files(path, tuple(ENDINGS))
    if files is None:
        if scale != 1.0:
            raise ValueError(
                f"{os.fspath(path)}: scale is {scale:g}; it is for folders and patterns of mesh files, leave it out"
            )
        return as_capture(open_sequence(path, prim, fps))
    labels, paths = files

    def read(frame):
        faces = read_faces(paths[frame], prim)
        try:
            points, triangles, _ = faces.triangles(loose_triangles_of)
            return Surface(points * scale, triangles)
        except ValueError as error:
            raise ValueError(f"{paths[frame]}: {error}") from error

    return Capture(labels, None if fps is None else (labels - labels[0]) / fps, read, path, tuple(paths))


def as_capture(frames: Sequence | Iterable[Mesh], dt: float | None = None, times: ArrayLike | None = None) -> Capture:
    """Makes a `Capture` of a `Sequence`, or of meshes in memory.

    Args:
        frames: A `Sequence`, which has times of its own; or a `Mesh` of each frame, its points those of the frame.
        dt: Time from each mesh to the next [s].
        times: (F,) [s], increasing. Give one of ``dt`` and ``times``, or neither.

    Raises:
        ValueError: There are no frames, one of them is no mesh with triangles, times do not increase, or both ``dt`` and
            ``times`` are given, or one of them for a sequence.
    """
    if dt is not None and times is not None:
        raise ValueError("dt, times: both are given; give one of the two")
    if dt is not None:
        checks.number("dt", dt, above=0.0)
    if isinstance(frames, Sequence):
        if dt is not None or times is not None:
            raise ValueError(f"{'times' if dt is None else 'dt'} is given, and a sequence has times of its own; leave it out")
        sequence = frames
        triangles = sequence.mesh.triangles

        def read(frame):
            return Surface(sequence[frame], triangles)

        return Capture(sequence.labels, sequence.times, read, sequence.path, sequence.files, sequence.up_axis)
    meshes = list(frames)
    for index, mesh in enumerate(meshes):
        if not isinstance(mesh, Mesh) or not len(mesh.triangles):
            raise ValueError(f"frames[{index}] is {checks.shown(mesh)}; it must be a Mesh with triangles")
    if not meshes:
        raise ValueError("frames has 0 meshes; it must have at least 1")
    given = None if times is None else increasing(times, len(meshes))
    given = dt * np.arange(len(meshes)) if dt is not None else given
    surfaces = [Surface(mesh.points, mesh.triangles) for mesh in meshes]
    return Capture(np.arange(len(meshes)), given, surfaces.__getitem__, up_axis=meshes[0].up_axis)


def solid_triangles(surface: Surface) -> np.ndarray:
    """Returns the triangles (T, 3) of a surface whose corners are all finite."""
    return surface.triangles[np.isfinite(surface.points).all(axis=1)[surface.triangles].all(axis=1)]
