"""Mesh sequences: frames of one mesh with constant triangles, read one at a time from files or arrays.

`open_sequence` takes

- a USD stage with a Mesh prim whose points are sampled: each time code is a frame;
- a folder of .obj, .ply or .off files, or a pattern such as "frames/cloth_*.obj": the last number in a name is the frame
  (`frame_names.frames_of_names`), which takes 1/fps s;
- an .npz file: `points` (F, n, 3) [m], `triangles` (T, 3), and `times` (F,) [s] unless fps is given;
- an .npy file, (F, n, 3) [m], with a mesh;
- a point cache, .pc2 or .mdd, with a mesh, by default an .obj file of the same name.

Lengths are metres unless a file says otherwise.
"""

import glob
import operator
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable
from collections.abc import Sequence as List
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike

from ..base import checks
from ..base.notebooks import ShownInNotebooks
from ..base.types import FilePath, UpAxis
from .caches import CACHES, open_mdd, open_pc2
from .frame_names import frames_of_names
from .loading import ENDINGS, WELDED, read_faces
from .mesh import Mesh, Surface
from .parts import Part
from .stage_mesh import StageMesh

# Functions that open a sequence, by file ending: (path, prim, fps) → :class:`Sequence`. `usd` registers that of stages.
OPENERS: dict[str, Callable[[FilePath, str | None, float | None], Any]] = {}
_MAX_MISSING = 1_000_000
_LATEST = 1e15  # latest time of a frame [s]
_CHANGES = (
    "meshes that change from frame to frame are captures: 'compare --by surface' and 'fit --capture' take them, "
    "'resample' gives them fixed triangles"
)
FRAME_ENDINGS = [ending for ending in ENDINGS if ending not in WELDED]


class HasPoints(Protocol):
    """A result with its frames in ``points``, such as an `Animation` or a `Deformation`."""

    @property
    def points(self) -> Any:
        """(F, n, 3) [m]."""


@dataclass(frozen=True, eq=False)
class Sequence(ShownInNotebooks):
    """Frames of one mesh. Indexing reads a frame and keeps nothing.

    `sequence[i]` is a copy of the points of frame i, (n, 3) [m], float64, with the infinities and NaN of the input. A frame
    that does not fit or cannot be read raises ValueError.

    Attributes:
        mesh: The rest shape; a `Surface` if read from a file.
        labels: Frame numbers (F,): time codes or numbers of files; int64 if whole, else float64.
        times: (F,) [s], increasing, or None.
        read: Function (0 … F − 1) → points of a frame.
        path: The file, folder or pattern, or None.
        stage: `usd.StageMesh` of a stage, at the first frame if its space moves, or None.
        precision: Floating-point type of the input.
        declared: Whether the input has a rest shape; else `mesh` has that of the first frame.
        files: Paths of the files of frames.
        up_axis: "Y" or "Z", or None.

    Raises:
        ValueError: The mesh has no triangles, or times are not within 1e15 s.
    """

    mesh: Mesh
    labels: np.ndarray
    times: np.ndarray | None
    read: Callable[[int], np.ndarray]
    path: FilePath | None = None
    stage: StageMesh | None = None
    declared: bool = True
    precision: type = np.float64
    files: tuple[Any, ...] = ()
    up_axis: UpAxis | None = None

    def __post_init__(self) -> None:
        where = "mesh" if self.path is None else self.path
        if self.path is not None and self.times is not None and not np.abs(self.times).max(initial=0.0) <= _LATEST:
            raise ValueError(
                f"{where}: times are from {self.times[0]:g} to {self.times[-1]:g} s; they must be within {_LATEST:g} s"
            )
        if not len(self.mesh.triangles):
            raise ValueError(f"{where}: has edges and no triangles; a sequence must have triangles")

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, frame: SupportsIndex) -> np.ndarray:
        return np.array(self.read(range(len(self))[operator.index(frame)]), dtype=np.float64)

    def rounding(self, points: np.ndarray) -> float:
        """Returns the rounding [m] of points (n, 3) [m]: machine epsilon of the input times the largest coordinate."""
        return np.finfo(self.precision).eps * np.abs(points).max(initial=0.0, where=np.isfinite(points))

    @cached_property
    def missing(self) -> list[float]:
        """Labels that are missing.

        Raises:
            ValueError: More than a million are missing.
        """
        return missing_labels(self.labels, self.path)


def missing_labels(labels: np.ndarray, path: FilePath | None = None) -> list[float]:
    """Returns the labels that are missing between ascending labels (F,).

    The spacing is the smallest interval; if another is not a multiple of it, nothing is missing. Nor if labels are fractional
    and more than a third of their intervals, and more than one, would be gaps (shutter samples).

    Raises:
        ValueError: More than a million are missing; the message begins with ``path``.
    """
    intervals = np.diff(labels)
    spacing = intervals.min() if len(intervals) else 1
    multiples = np.rint(intervals / spacing)
    gaps = np.flatnonzero(multiples > 1)
    uneven = np.abs(intervals / spacing - multiples) > 1e-6  # time codes have fewer than 10 digits, float64 has 16
    if uneven.any() or (labels.dtype.kind == "f" and 3 * len(gaps) > max(3, len(intervals))):
        return []
    if (multiples[gaps] - 1.0).sum() > _MAX_MISSING:
        first, last = labels[[gaps[0], gaps[0] + 1]].tolist()
        where = "" if path is None else f"{path}: "
        raise ValueError(f"{where}more than {_MAX_MISSING:,} frames are missing, from {first} to {last} and on")
    return [(labels[gap] + k * spacing).item() for gap in gaps for k in range(1, int(multiples[gap]))]


def open_sequence(path: FilePath, prim: str | None = None, fps: float | None = None, mesh: Mesh | None = None) -> Sequence:
    """Opens a mesh sequence from a file, a folder or a pattern; this module's docstring lists the formats.

    Polygons are cut as by `usd.read_stage_mesh` and `loading.read_file`. A moving prim is transformed to world space at each
    time code, its rest shape as at the first.

    Args:
        path: A stage, a folder, a pattern, an .npz or an .npy file.
        prim: Prim, or geometry in each file, if there are several.
        fps: Frames per second of file names, or time codes per second.
        mesh: The `Mesh` of an .npy, .pc2 or .mdd file.

    Returns:
        Sequence: Only its first frame has been read.

    Raises:
        FileNotFoundError: There is no such file or folder.
        ValueError: The format is unknown, there are no frames, or parts do not fit together; the message begins with the path.
    """
    path = os.fspath(path)
    if fps is not None:
        checks.number("fps", fps, above=0.0)
    if open_file := OPENERS.get(Path(path).suffix.lower()):
        return open_file(path, prim, fps)
    if files := numbered_files(path):
        return _open_files(path, *files, prim, fps)
    if not os.path.exists(path):
        raise FileNotFoundError(f"{path}: no such file or folder")
    if prim is not None and Path(path).suffix.lower() in (".npz", ".npy", *CACHES):
        raise ValueError(f"{path}: prim is {prim!r}, and arrays have no prims; leave it out")
    try:
        if path.lower().endswith(".npz"):
            return _open_npz(path, fps)
        if path.lower().endswith(".npy"):
            return _open_npy(path, fps, mesh)
        if Path(path).suffix.lower() in CACHES:
            return _open_cache(path, fps, mesh)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if (ending := Path(path).suffix.lower()) in ENDINGS:
        pattern = Path(path).parent / f"*{ending if ending in FRAME_ENDINGS else '.obj'}"
        raise ValueError(f'{path}: is one mesh; it must be a folder of them, or a pattern such as "{pattern}"')
    raise ValueError(f"{path}: must be a folder or pattern of mesh files, or end with {' '.join(OPENERS)} .npz .npy .pc2 .mdd")


def as_sequence(mesh: Mesh, frames: ArrayLike | HasPoints, dt: float | None = None, times: ArrayLike | None = None) -> Sequence:
    """Makes a `Sequence` of frames in memory.

    Args:
        mesh: The `Mesh` at rest.
        frames: An array (F, n, 3) [m], F arrays (n, 3), `usd.FrameSequence`, `Animation` or `Deformation`.
        dt: Time between frames [s].
        times: (F,) [s], increasing, instead of ``dt``; by default those of ``frames``, if any.

    Returns:
        Sequence: It keeps a reference to `frames`.

    Raises:
        ValueError: A frame does not fit the mesh; times do not increase; both ``dt`` and ``times`` are given; or `mesh` has no
            triangles.
    """
    if not isinstance(mesh, Mesh):
        raise ValueError(f"mesh is {checks.shown(mesh)}; it must be a Mesh")
    if dt is not None and times is not None:
        raise ValueError("dt, times: both are given; give one of the two")
    if dt is not None:
        checks.number("dt", dt, above=0.0)
    elif times is None:
        times = getattr(frames, "times", None)
    count, read, precision = _array("frames", getattr(frames, "points", frames), mesh)
    given = dt * np.arange(count) if dt is not None else None if times is None else increasing(times, count)
    return Sequence(mesh, np.arange(count), given, read, precision=precision, up_axis=mesh.up_axis)


def numbered_files(path: FilePath, endings: List[str] = FRAME_ENDINGS) -> tuple[np.ndarray, list[Path]] | None:
    """Returns the numbers (F,), ascending, and paths of the mesh files of a folder or pattern, of one of the ``endings``; None
    if it is neither.
    """
    path = os.fspath(path)
    if os.path.isdir(path):
        found = sorted(Path(path).iterdir())
    elif not os.path.exists(path) and glob.has_magic(path):
        found = [Path(name) for name in sorted(glob.glob(path))]
    else:
        return None
    paths = [file for file in found if file.suffix.lower() in ENDINGS and file.is_file() and file.name[0] != "."]
    allowed = " ".join(endings)
    kinds = sorted({file.suffix.lower() for file in paths})
    if not paths:
        raise ValueError(f"{path}: no mesh files there; they must end with {allowed}")
    if len(kinds) > 1:
        raise ValueError(f'{path}: has files of several kinds, {" ".join(kinds)}; give a pattern of one, such as "*{kinds[0]}"')
    if kinds[0] not in endings:
        raise ValueError(
            f"{path}: {kinds[0]} files repeat vertices, and which of them are one may change between frames; "
            f"the files must end with {allowed}"
        )
    frames = frames_of_names(paths)
    labels = np.array(list(frames))
    return labels.astype(np.int64) if (labels % 1 == 0).all() else labels, list(frames.values())


def _open_files(path, labels, paths, prim, fps):
    faces = read_faces(paths[0], prim)
    try:
        points, triangles, st = faces.triangles()
        mesh = Surface(points, triangles, texture_coordinates=st)
    except ValueError as error:
        raise ValueError(f"{paths[0]}: {error}") from error
    read = partial(_read_file, paths, prim, faces.counts, faces.corners, len(points))
    times = None if fps is None else (labels - labels[0]) / fps
    return Sequence(mesh, labels, times, read, path, declared=False, files=tuple(paths))


def _read_file(paths, prim, counts, corners, count, frame):
    path = paths[frame]
    found = read_faces(path, prim)
    for name, here, there in (("vertices", len(found.points), count), ("faces", len(found.counts), len(counts))):
        if here != there:
            raise ValueError(f"{path}: {here} {name}, must be {there} as in {paths[0]}; {_CHANGES}")
    ends = np.cumsum(counts)
    differ = found.counts != counts
    if not differ.any():
        differ = np.logical_or.reduceat(found.corners != corners, ends - counts)
    for face in np.flatnonzero(differ)[:1]:
        here = np.split(found.corners, np.cumsum(found.counts))[face].tolist()
        there = corners[ends[face] - counts[face] : ends[face]].tolist()
        raise ValueError(f"{path}: face {face} has vertices {here}, must be {there} as in {paths[0]}; {_CHANGES}")
    return found.points


def _open_npz(path, fps):
    if not zipfile.is_zipfile(path):
        raise ValueError("is no .npz file, as np.savez writes it")
    with _numpy_reads(), np.load(path, allow_pickle=False) as archive:
        lacking = sorted({"points", "triangles"} - set(archive.files))
        if lacking:
            raise ValueError(f"has no array {lacking[0]!r}, only {', '.join(archive.files) or 'none'}")
        triangles = archive["triangles"]
        times = archive["times"] if "times" in archive.files and fps is None else None
        named = (archive["parts"], archive["first"]) if {"parts", "first"} <= set(archive.files) else None
    with _numpy_reads():
        points = _mapped(path, "points.npy")
    if points.ndim != 3 or not len(points):
        raise ValueError(f"points has shape {points.shape}; it must be (frames, vertices, 3), of one frame or more")
    parts = None
    if named is not None:
        names, first = named[0].ravel().astype(str).tolist(), np.append(named[1].ravel().astype(np.int64), points.shape[1])
        parts = {name: Part(int(a), int(b - a)) for name, a, b in zip(names, first[:-1], first[1:], strict=True)}
    mesh = Surface(points[0], triangles, parts=parts)
    count, read, precision = _array("points", points, mesh)
    times = _even(count, fps) if times is None else increasing(times, count)
    return Sequence(mesh, np.arange(count), times, read, path, declared=False, precision=precision, files=(path,))


@contextmanager
def _numpy_reads():
    """Turns NumPy's errors for a broken file into ValueError."""
    try:
        yield
    except ValueError:
        raise
    except (
        *(OSError, EOFError, MemoryError, OverflowError, TypeError, KeyError, SyntaxError, RuntimeError, RecursionError),
        *(NotImplementedError, tokenize.TokenError, struct.error, zlib.error, zipfile.BadZipFile),
    ) as error:
        raise ValueError(f"cannot be read, its header or data are broken ({error})") from error


def _mapped(path, member):
    """Maps an array of an .npz file, which `np.load` would read whole."""
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo(member)
    if info.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{member} is compressed, so that no frame can be read by itself; write it by np.savez")
    with open(path, "rb") as file:
        file.seek(info.header_offset + 26)  # here the local header has the lengths of its name and of its extra field
        file.seek(sum(np.frombuffer(file.read(4), "<u2").tolist()), os.SEEK_CUR)
        version = np.lib.format.read_magic(file)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, by_columns, dtype = header(file)
        if dtype.kind not in "iuf":
            raise ValueError(f"{member} has type {dtype}, must be real numbers")
        return np.memmap(path, dtype, "r", file.tell(), shape, "F" if by_columns else "C")


def _open_npy(path, fps, mesh):
    with open(path, "rb") as file:
        if file.read(6) != b"\x93NUMPY":
            raise ValueError("is no .npy file, as np.save writes it")
    with _numpy_reads():
        try:
            points = np.lib.format.open_memmap(path, mode="r")
        except ValueError as error:  # such as Python objects in place of numbers
            raise ValueError(f"cannot be read as .npy: {error}") from error
    if mesh is None:
        join = f"'warpcloth convert {Path(path).name} {Path(path).stem}.npz --rest MESH'"
        raise ValueError(f"has no triangles; give a rest mesh that has them (--rest), or an .npz file, as of {join}")
    count, read, precision = _array("points", points, mesh)
    times = _even(count, fps)
    return Sequence(mesh, np.arange(count), times, read, path, precision=precision, files=(path,), up_axis=mesh.up_axis)


def _open_cache(path, fps, mesh):
    beside, declared, times = Path(path).with_suffix(".obj"), mesh is not None, None
    if path.lower().endswith(".pc2"):
        labels, points = open_pc2(path)
        labels = labels.astype(np.int64) if np.array_equal(labels, np.rint(labels)) else labels
    else:
        times, points = open_mdd(path)
        labels = np.arange(len(points))
    if mesh is None:
        if not beside.is_file():
            raise ValueError(f"has no triangles; give a rest mesh that has them (--rest), or put it beside as {beside.name}")
        mesh = Surface.load(beside)
    count, read, precision = _array("points", points, mesh)
    if fps is not None:
        times = (labels - labels[0]) / fps
    elif times is not None:
        times = increasing(times, count)
    return Sequence(
        mesh, labels, times, read, path, declared=declared, precision=precision, files=(path,), up_axis=mesh.up_axis
    )


def _array(name, frames, mesh):
    shape = mesh.points.shape
    if isinstance(frames, (list, tuple)):
        for index, frame in enumerate(frames):
            found = checks.numeric(f"{name}[{index}]", frame, f"have shape {shape}").shape
            if found != shape:
                raise ValueError(f"{name}[{index}] has shape {found}; it must be {shape}")
        found, dtype = (len(frames), *shape), _coarsest(frames)
    else:
        if np.ma.isMaskedArray(frames) and np.ma.is_masked(frames):
            raise ValueError(f"{name} is partly masked; it must have all points, or NaN where one is not known")
        frames = frames if hasattr(frames, "exact") else np.asarray(frames)
        found, dtype = frames.shape, frames.dtype
        if frames.dtype.kind not in "iuf":
            raise ValueError(f"{name} has type {frames.dtype}; it must be real numbers")
    if found[1:] != shape or not found[0]:
        copies = f"; of several copies give one, as in {name}[:, 0]" if len(found) == 4 else ""
        raise ValueError(f"{name} has shape {found}; it must be (frames, {shape[0]}, 3) for the points of the mesh{copies}")
    precision = dtype.type if np.issubdtype(dtype, np.floating) else np.float64
    return found[0], frames.exact if hasattr(frames, "exact") else frames.__getitem__, precision


def _coarsest(frames):
    types = [np.asarray(frame).dtype for frame in frames]
    return max((kind for kind in types if kind.kind == "f"), key=lambda kind: np.finfo(kind).eps, default=np.dtype(np.float64))


def _even(count, fps):
    return None if fps is None else np.arange(count) / fps


def increasing(times, count):
    times = checks.array("times", times, (count,))
    checks.refuse("times", times, np.diff(times, prepend=-np.inf) <= 0.0, "must be later than the one before")
    return times
