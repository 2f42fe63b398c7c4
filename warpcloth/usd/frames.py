"""The frames of an animation, read from its file one at a time."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ..base.types import FilePath
from ..mesh.mesh import Mesh, Surface
from ..mesh.sequences import Sequence
from .layers import files_of_stage
from .modules import Sdf, UsdGeom
from .stage import (
    animated_prims,
    carried,
    curve_vertices,
    find_prim,
    first_points,
    followed,
    identity,
    local_to_metres,
    moving_space,
    open_stage,
    placed,
    read_stage_mesh,
    refuse_change,
    topology,
)
from .values import array_of, check_composed, sentences, time_codes_of

_VECTORS = ("points", "velocities")


def open_sequence(path, prim, fps):
    """Opens the frames of a stage for :func:`warpcloth.open_sequence`; of several animated cloths all."""
    prims = [] if prim is not None else [str(each.GetPath()) for each in animated_prims(open_stage(path))]
    if len(prims) > 1:
        return _sequence_of_cloths(path, prims, fps)
    frames = FrameSequence(path, prim)
    codes = frames.time_codes
    stage = read_stage_mesh(path, prim, Surface, codes[0])
    if frames.shape[1:] != stage.mesh.points.shape:
        raise ValueError(
            f"{path}, prim {stage.prim}: {frames.shape[1]} points at time code {codes[0]:g}, "
            f"must be {len(stage.mesh.points)} as at rest"
        )
    labels = codes.astype(np.int64) if np.array_equal(codes, np.rint(codes)) else codes
    times = frames.times if fps is None else (codes - codes[0]) / fps
    return Sequence(stage.mesh, labels, times, frames.exact, path, stage, stage.rest, np.float32, frames.files, stage.up_axis)


def _sequence_of_cloths(path, prims, fps):
    frames = JoinedFrames(path, prims)
    each = [read_stage_mesh(path, prim, Surface, frames.time_codes[0]) for prim in prims]
    joined = Mesh.join({prim.rsplit("/", 1)[1]: stage.mesh for prim, stage in zip(prims, each, strict=True)})
    mesh = Surface(joined.points, joined.triangles, up_axis=joined.up_axis, parts=joined.parts)
    codes = frames.time_codes
    labels = codes.astype(np.int64) if np.array_equal(codes, np.rint(codes)) else codes
    times = frames.times if fps is None else (codes - codes[0]) / fps
    rest = all(stage.rest for stage in each)
    return Sequence(mesh, labels, times, frames.exact, path, None, rest, np.float32, frames.files, each[0].up_axis)


class FrameSequence:
    """Sampled points, velocities or numbers of a prim, as an array that reads frames on demand.

    Indexing reads a frame and keeps nothing; `np.asarray` reads all. If the file is written again meanwhile, reading raises
    RuntimeError. A frame with another number of values, or other faces, raises ValueError.

    Points follow an animated transform at their time codes; its velocity since the previous frame is added to the velocities.

    Attributes:
        shape: (frames, n, 3); for a primvar (frames, n), or if it is uniform (frames, faces of the prim).
        dtype: float32.
        time_codes: Time code of each frame (frames,).
        times: Seconds since the first frame (frames,).
    """

    dtype = np.dtype(np.float32)

    def __init__(self, path: FilePath, prim: str | None = None, attribute: str = "points", scale: float = 1.0) -> None:
        """Opens the file.

        Args:
            path: A .usd, .usda, .usdc or .usdz file.
            prim: Path or name of the prim, or None.
            attribute: "points", in world space [m], "velocities" [m/s], or "primvars:<name>" of single numbers.
            scale: Factor on a primvar.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is no stage, the prim is ambiguous, or the attribute is not animated or of another type.
        """
        if attribute not in _VECTORS and not str(attribute).startswith("primvars:"):
            raise ValueError(f'attribute is {attribute!r}; it must be "points", "velocities" or a primvar, "primvars:<name>"')
        path = followed(path)  # USD would look for the frames beside a link, not beside the file behind it
        self._file = os.path.abspath(path)
        self._identity = identity(self._file)  # before opening it, so that no change is missed
        with sentences(path):
            self._open(path, prim, attribute, scale)

    def _open(self, path, prim, attribute, scale):
        self._stage = open_stage(path)
        found = find_prim(self._stage, path, prim)
        check_composed(found, path)
        self._where = where = f"{path}, prim {found.GetPath()}"
        self._attribute = found.GetAttribute(attribute)
        with self._located():
            self.time_codes = np.array(time_codes_of(self._attribute) if self._attribute else [])
        if not len(self.time_codes):
            raise ValueError(f"{where}: {attribute} have no time samples, the prim is not animated")
        vectors = attribute in _VECTORS
        if not vectors and self._attribute.GetTypeName() != Sdf.ValueTypeNames.FloatArray:
            raise ValueError(f"{where}: {attribute} has type {self._attribute.GetTypeName()}, must be float[]")
        self.times = (self.time_codes - self.time_codes[0]) / self._stage.GetTimeCodesPerSecond()
        self._moving = found if vectors and moving_space(found) else None
        self._transform = np.eye(4) if self._moving or not vectors else local_to_metres(found, where)
        self._is_velocity = attribute == "velocities"
        if self._is_velocity:
            self._transform[3, :3] = 0.0
        self._scale = 1.0 if vectors else scale
        self._faces = []  # sampled attributes of the faces, which must not change
        if attribute == "points" and found.IsA(UsdGeom.Mesh):
            mesh = UsdGeom.Mesh(found)
            faces = (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr(), mesh.GetHoleIndicesAttr())
            with self._located():
                self._faces = [(sampled, topology(sampled)) for sampled in faces if sampled.GetNumTimeSamples()]
        # Where curves meet, a vertex has several points; the first is read.
        self._points = None
        self._components = (3,) if vectors else ()
        with self._located():
            first = array_of(self._attribute, self._components, time=self.time_codes[0])
            self._count = count = 0 if first is None else len(first)
            if not found.IsA(UsdGeom.Mesh) and (vectors or UsdGeom.Primvar(self._attribute).GetInterpolation() == "vertex"):
                self._points = first_points(curve_vertices(found, count))
                count = len(self._points)
        self.shape = (len(self.time_codes), count, 3)[: 3 if vectors else 2]

    @property
    def files(self) -> tuple[str, ...]:
        """Real paths of the files of the stage."""
        return tuple(sorted(files_of_stage(self._stage)))

    @property
    def ndim(self) -> int:
        """3, or 2 for a primvar."""
        return len(self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __repr__(self) -> str:
        return f"FrameSequence(shape={self.shape}, {self._attribute.GetPath()})"

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self._read(frame) for frame in range(len(self)))

    def __getitem__(self, key: Any) -> np.ndarray:
        """Returns frames, indexed as in NumPy: an integer gives (n, 3), a slice or list (k, n, 3), further indices a part."""
        frames, rest = (key[0], key[1:]) if isinstance(key, tuple) and key else (key, ())
        if frames is Ellipsis or isinstance(frames, tuple):
            return np.asarray(self)[key]
        numbers = np.arange(len(self))[frames]
        if np.ndim(numbers) == 0:
            return self._read(int(numbers))[rest]
        result = np.empty((len(numbers), *self.shape[1:]), np.float32)
        for row, frame in enumerate(numbers):
            result[row] = self._read(int(frame))
        return result[(slice(None), *rest)]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if copy is False:
            raise ValueError("copy = False: the frames are in a file, so an array of them is always a copy")
        result = self[:]
        return result if dtype is None else result.astype(dtype, copy=False)

    def exact(self, frame: int) -> np.ndarray:
        """Returns a frame of points [m] or velocities [m/s] (n, 3) in float64, without rounding of transforms to float32."""
        values = self._values(frame).astype(np.float64)
        if not self._moving:
            return placed(values, self._transform)
        now = self._space(frame)
        if not self._is_velocity:
            return placed(values, now)
        return values @ now[:3, :3] + self._velocities_of_space(frame, now)

    def _space(self, frame):
        code = self.time_codes[frame]
        return local_to_metres(self._moving, f"{self._where}, time code {code:g}", code)

    def _velocities_of_space(self, frame, now):
        if frame == 0:
            return 0.0
        with self._located():
            points = array_of(UsdGeom.PointBased(self._moving).GetPointsAttr(), (3,), time=self.time_codes[frame])
        points = points if self._points is None else points[self._points]
        return carried(points, self._space(frame - 1), now) / (self.times[frame] - self.times[frame - 1])

    def _read(self, frame):
        if self.ndim == 3:
            return self.exact(frame).astype(np.float32)
        return (self._values(frame) * self._scale).astype(np.float32, copy=False)

    def _values(self, frame):
        if identity(self._file) not in (None, self._identity):
            raise RuntimeError(
                f"{self._file}: has been written again since these frames were opened; open it again, "
                "and give runs that are to be compared an output each"
            )
        code = self.time_codes[frame]
        with self._located():
            values = array_of(self._attribute, self._components, time=code)
            found = 0 if values is None else len(values)
            if found != self._count:
                name = self._attribute.GetName()
                raise ValueError(f"{found} {name} at time code {code:g}, must be {self._count} as at the first")
            for sampled, fixed in self._faces:
                refuse_change(sampled.GetName(), topology(sampled, code), fixed, code)
        values = values.astype(np.float32, copy=False)
        return values if self._points is None else values[self._points]

    @contextmanager
    def _located(self):
        try:
            yield
        except ValueError as error:
            raise ValueError(f"{self._where}: {error}") from None


class JoinedFrames(FrameSequence):
    """Points or velocities of several prims of one file, one after another.

    Args:
        attribute: "points" or "velocities".
    """

    def __init__(self, path: FilePath, prims: Iterable[str], attribute: str = "points") -> None:
        self._each = [FrameSequence(path, prim, attribute) for prim in prims]
        first = self._each[0]
        for other in self._each[1:]:
            if not np.array_equal(other.time_codes, first.time_codes):
                raise ValueError(f"{path}: {other} has other time codes than {first}, must have the same")
        self.time_codes, self.times = first.time_codes, first.times
        self.shape = (len(first), sum(each.shape[1] for each in self._each), 3)

    @property
    def files(self) -> tuple[str, ...]:
        return self._each[0].files

    def __repr__(self) -> str:
        return f"JoinedFrames(shape={self.shape}, {len(self._each)} cloths)"

    def exact(self, frame: int) -> np.ndarray:
        return np.concatenate([each.exact(frame) for each in self._each])

    def _read(self, frame):
        return np.concatenate([each[frame] for each in self._each])
