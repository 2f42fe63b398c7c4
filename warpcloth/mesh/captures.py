"""Captures: measured surfaces with noise and holes, whose triangles may change from frame to frame.

`open_capture` takes what `open_sequence` takes, and numbered files with a mesh each, .stl, .glb and .gltf too.
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
    """Frames with a mesh each, read on demand by index.

    `capture[i]` is a `Surface` with points [m] as in the input, NaN included. Triangles with a corner that is not finite are
    holes.

    Attributes:
        labels: Frame numbers of the input (F,).
        times: (F,) [s], increasing, or None.
        read: Function (0 … F − 1) → mesh of a frame.
        path: The file, folder or pattern, or None.
        files: Paths of the files of frames.
        up_axis: "Y" or "Z", or None.
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
        """Labels missing between the first and the last."""
        return missing_labels(self.labels, self.path)


def open_capture(path: FilePath, prim: str | None = None, fps: float | None = None, scale: float = 1.0) -> Capture:
    """Opens a capture from a file, a folder or a pattern.

    Args:
        path: A folder or pattern of mesh files, the last number in a name being the frame; or a stage or an .npz file.
        prim: Prim, or geometry in each file, if there are several.
        fps: Frames per second of file names, or time codes per second.
        scale: Unit of mesh files [m], such as 1e-3 for millimetres.

    Returns:
        Capture: No file has been read.

    Raises:
        FileNotFoundError: There is no such file or folder.
        ValueError: The format is another, or there are no frames; a broken file raises when its frame is read.
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
        frames: A `Sequence`, with its times; or a `Mesh` of each frame.
        dt: Time between meshes [s].
        times: (F,) [s], increasing, instead of ``dt``.

    Raises:
        ValueError: There are no frames or a frame has no triangles, times do not increase, or too many of ``dt`` and ``times``
            are given.
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
