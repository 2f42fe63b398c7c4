"""Measurements to which :func:`warpcloth.fit` fits parameters: points on the cloth, captures, and numbers read from it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..analysis.compare import to_up_axis
from ..base.checks import array, keep_plain, number, numeric, refuse, shown, whole
from ..base.tables import number_in, read_table
from ..base.types import FilePath
from ..mesh.captures import Capture, solid_triangles
from ..mesh.selection import distinct_vertices
from ..scene.mesh_collider import nearest_points
from ..scene.scene import Scene

_SAME_TIME = 1e-6  # largest distance of a measured time from a frame of the scene, in frames
_FAR = 1e18  # largest coordinate in a file [m]; squares of residuals stay finite
_LARGER, _SMALLER = 5.0, 1.0 / 30.0  # largest and smallest size of a capture, relative to that of the cloth at its start
_BOUND = 1e-9  # largest distance of the sum of weights from 1


def frames_at(times: np.ndarray, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Returns the frames nearest to times (m,) [s], (m,), and whether each is at the time of a frame."""
    wanted = np.asarray(times) * scene.fps
    frames = np.rint(wanted).astype(int)
    return frames, (np.abs(wanted - frames) <= _SAME_TIME) & (frames >= 0) & (frames <= scene.frames)


@dataclass(frozen=True, eq=False, kw_only=True)
class Markers:
    """Positions of k markers in frames of a scene, or at rest.

    Markers are vertices, or points Σ wᵢxᵢ of triangles. Without ``vertices`` and ``triangles`` they are free points: each
    residual is the distance to the nearest point of the cloth, which is held while parameters are varied.

    Attributes:
        positions: At frames 1 … F (F, k, 3) [m], or of an equilibrium (k, 3); NaN where missing.
        vertices: The k vertices, indices or a selection.
        triangles: The triangle of each marker, (k,).
        weights: Barycentric coordinates there, (k, 3), with the sum 1.
        sigma: Standard deviation of the error along each axis, of free points along the normal [m]; None if unknown.

    Raises:
        ValueError: A value is not allowed.
    """

    positions: ArrayLike
    vertices: str | ArrayLike | None = None
    triangles: ArrayLike | None = None
    weights: ArrayLike | None = None
    sigma: float | None = None

    def __post_init__(self) -> None:
        keep_plain(self)
        if (self.triangles is None) != (self.weights is None):
            raise ValueError("one of markers.triangles and markers.weights is given; both or none must be")
        if self.vertices is not None and self.triangles is not None:
            raise ValueError("markers.vertices and markers.triangles are given; at most one of the two may be")
        if self.sigma is not None:
            number("markers.sigma", self.sigma, above=0.0)

    @staticmethod
    def read(path: FilePath, scene: Scene, sigma: float | None = None, resting: bool = False) -> Markers:
        """Reads markers from a CSV file with columns time [s], id, x, y, z [m] in any order; others are ignored.

        A row at time 0 binds a marker to the nearest point of the cloth at the start; rows at times of frames are used. Without
        a column id, rows are free points, and those at time 0 are ignored. NaN means not measured.

        Args:
            path: The file.
            scene: The scene to fit.
            sigma: See :class:`Markers`.
            resting: Whether rows after time 0, one per marker, show the cloth at rest.

        Raises:
            OSError: The file cannot be read.
            ValueError: Columns or rows are missing, a number is not allowed, a marker is not bound, occurs twice at a time or
                is farther from the cloth at time 0 than its longest edge, or the mesh has no triangles.
        """
        names, rows = read_table(path)
        for name in ("time", "x", "y", "z"):
            if name not in names:
                raise ValueError(f"{path}: has no column {name!r}; it must have time, x, y and z, and id for bound markers")
        found = np.array(
            [[number_in(path, line, n, row[names.index(n)]) for n in ("time", "x", "y", "z")] for line, row in rows]
        )
        for (line, _row), numbers in zip(rows, found, strict=True):
            if not np.isfinite(numbers[0]):
                raise ValueError(f"{path}, line {line}: time is {numbers[0]}; it must be finite")
            if numbers[0] * scene.fps < -_SAME_TIME:
                raise ValueError(f"{path}, line {line}: time is {numbers[0]} s; it must be 0, the start, or later")
            for name, value in zip("xyz", numbers[1:], strict=True):
                if abs(value) > _FAR:
                    raise ValueError(f"{path}, line {line}: {name} is {value}; it must be at most {_FAR:g} m, or NaN")
        if resting:
            frames, used = (found[:, 0] > 0.0).astype(int), np.ones(len(found), dtype=bool)
        else:
            frames, used = frames_at(found[:, 0], scene)
        if not (used & (frames > 0)).any():
            raise ValueError(
                f"{path}: has no row at the time of a frame after the start; it must have one at a multiple of "
                f"1/{scene.fps:g} s, up to {scene.frames / scene.fps:g} s"
            )
        _refuse_no_triangles(path, scene)
        if "id" in names:
            ids: list[Any] = [row[names.index("id")] for _line, row in rows]
            starts = _starts(path, scene, [(rows[k][0], ids[k], found[k, 1:]) for k in np.flatnonzero(used & (frames == 0))])
            own = {name: k for k, name in enumerate(starts)}
        else:  # a marker of its own for each row of a frame
            counts: dict[Any, int] = dict.fromkeys(frames, 0)
            ids = []
            for frame in frames:
                ids.append(counts[frame])
                counts[frame] += 1
            starts, own = {}, {k: k for k in range(max(counts.values()))}
        positions = np.full((frames[used].max(), len(own), 3), np.nan)
        for k in np.flatnonzero(used & (frames > 0)):
            line = rows[k][0]
            if ids[k] not in own:
                raise ValueError(
                    f"{path}, line {line}: marker {ids[k]!r} has no row at time 0; it must have one, which binds it"
                )
            if np.isfinite(positions[frames[k] - 1, own[ids[k]]]).any():
                raise ValueError(f"{path}, line {line}: marker {ids[k]!r} has a row at this time before; it must have one only")
            positions[frames[k] - 1, own[ids[k]]] = found[k, 1:]
        bound = {}
        if starts:
            triangles, weights = (np.array(each) for each in zip(*starts.values(), strict=True))
            bound = {"triangles": triangles, "weights": weights}
        return Markers(positions=positions, sigma=sigma, **bound)

    def bind(self, name: str, scene: Scene, most: int, resting: bool = False) -> _Seen:
        """Returns the residuals of these markers on a scene, in at most ``most`` frames, or at rest.

        Raises:
            ValueError: The markers do not fit the scene; the message begins with ``name``.
        """
        chosen: Any = None
        if self.vertices is not None:
            chosen = distinct_vertices(f"{name}.vertices", self.vertices, scene.mesh)
        elif self.triangles is not None:
            _refuse_no_triangles(name, scene)
            chosen = _bound(name, self.triangles, self.weights, scene.mesh.triangles)
        else:
            _refuse_no_triangles(name, scene)
        count = "k" if chosen is None else len(chosen if self.vertices is not None else chosen[0])
        seen = numeric(name, self.positions, f"have shape (F, {count}, 3)")
        seen = seen[None] if seen.ndim == 2 and most == 1 else seen
        if seen.ndim != 3 or seen.shape[2] != 3 or count not in ("k", seen.shape[1]) or not 0 < len(seen) <= most:
            raise ValueError(
                f"{name} has shape {seen.shape}; it must be (F, {count}, 3) with F from 1 to {most}, the frames of the scene"
            )
        return _Seen(seen, chosen, scene.mesh.triangles, self.sigma)


@dataclass(frozen=True, eq=False)
class CapturePoints:
    """Vertices of a capture as free points on the cloth; its triangles may change from frame to frame.

    A residual is the distance of a vertex from the nearest triangle, along its normal; that triangle is held while parameters
    are varied. Holes of the capture are not compared, and motion along the surface is not seen.

    Attributes:
        capture: The capture, turned to the up axis of the scene. Frames after the start at the times of frames of the scene are
            used; at rest the last one. Vertices that are not finite, or in no finite triangle, are ignored.
        points: Maximum number of vertices of a frame, taken at a stride; None takes all.
        sigma: Standard deviation of the error along the normal [m], independent for each vertex; None if unknown.

    Raises:
        ValueError: A value is not allowed.
    """

    capture: Capture
    points: int | None = None
    sigma: float | None = None

    def __post_init__(self) -> None:
        keep_plain(self)
        if not isinstance(self.capture, Capture):
            raise ValueError(
                f"capture_points.capture is {shown(self.capture)}; it must be a Capture, such as open_capture(path)"
            )
        if self.points is not None:
            whole("capture_points.points", self.points, least=1)
        if self.sigma is not None:
            number("capture_points.sigma", self.sigma, above=0.0)

    def bind(self, name: str, scene: Scene, _most: int, resting: bool = False) -> _OnSurface:
        """Returns the residuals of these points on a scene.

        Raises:
            ValueError: The mesh has no triangles, or the capture has no times, no common frame, or another size than the cloth.
                The message begins with its path, or ``name``.

        Warns:
            UserWarning: A frame has no finite triangle and is left out.
        """
        capture = to_up_axis(self.capture, scene.mesh.up_axis, self.capture.up_axis)
        where = name if capture.path is None else str(capture.path)
        _refuse_no_triangles(where, scene, "to compare a capture with; give markers on vertices")
        if resting:
            seen = {0: self._vertices(capture[len(capture) - 1])}
            _check_size(where, seen, scene)
            return _OnSurface(self._thinned(seen), scene.mesh.triangles, self.sigma)
        if capture.times is None:
            raise ValueError(
                f"{where}: has no times; open it with open_capture(path, fps=…), or give --fps on the command line"
            )
        frames, used = frames_at(capture.times, scene)
        used &= frames >= 1
        if not used.any():
            raise ValueError(no_common_frame(where, capture.times, scene))
        seen = {int(frames[k]) - 1: self._vertices(capture[int(k)]) for k in np.flatnonzero(used)}
        empty = [capture.labels[k] for k in np.flatnonzero(used) if not len(seen[int(frames[k]) - 1])]
        if empty:
            listed = ", ".join(f"{label:g}" for label in empty[:10]) + (", …" if len(empty) > 10 else "")
            said = f"{len(empty)} of {used.sum()} frames are left out, because no triangle has finite corners: {listed}"
            warnings.warn(f"{where}: {said}", stacklevel=4)
        _check_size(where, seen, scene)
        return _OnSurface(self._thinned(seen), scene.mesh.triangles, self.sigma)

    def _vertices(self, surface):
        return surface.points[np.unique(solid_triangles(surface))]

    def _thinned(self, seen):
        if self.points is None:
            return seen
        return {frame: points[:: max(1, -(-len(points) // self.points))] for frame, points in seen.items()}


@dataclass(frozen=True, eq=False)
class Reading:
    """Measured numbers, and the function that reads them from a run.

    Attributes:
        function: From an :class:`warpcloth.run.simulate.Animation` of one copy, or an
            :class:`warpcloth.run.equilibrium.Equilibrium`, to an array of the shape of ``value``; it must be smooth in the
            parameters.
        value: Measured numbers; NaN where missing.
        sigma: Standard deviation of the error, one number or one per value; None if unknown.

    Raises:
        ValueError: A value is not allowed.
    """

    function: Callable[[Any], Any]
    value: ArrayLike
    sigma: ArrayLike | None = None

    def __post_init__(self) -> None:
        keep_plain(self)
        if not callable(self.function):
            raise ValueError(
                f"reading.function is {shown(self.function)}; it must be a function of an animation or an equilibrium"
            )
        value = numeric("reading.value", self.value, "be a number or an array of numbers")
        if self.sigma is not None:
            sigma = numeric("reading.sigma", self.sigma, "be a number, or one for each value")
            if sigma.shape not in ((), value.shape):
                raise ValueError(f"reading.sigma has shape {sigma.shape}; it must be one number, or have shape {value.shape}")
            refuse("reading.sigma", sigma, ~((sigma > 0.0) & np.isfinite(sigma)), "must be a finite number above 0")

    def bind(self, name: str, _scene: Scene, _most: int, _resting: bool = False) -> _Read:
        """Returns the residuals of this reading; errors begin with ``name``."""
        return _Read(name, self)


class _Seen:
    """Residuals of markers.

    Attributes:
        last: The last frame that is needed.
        frames: The frame of each residual, counted from 0, (m,).
        sigma: Standard deviation, or None.
    """

    def __init__(self, seen, chosen, triangles, sigma):
        self._seen, self._chosen, self._triangles, self.sigma = seen, chosen, triangles, sigma
        self._known = np.isfinite(seen) if chosen is not None else np.isfinite(seen).all(axis=2)
        self.last, self.frames = len(seen), np.nonzero(self._known)[0]

    def residuals(self, runs):
        """Returns residuals (R, m) [m] of runs; the first has the parameters, the others vary them."""
        points = [np.asarray(run.points, dtype=np.float64) for run in runs]
        points = [each[None] if each.ndim == 2 else each[1 : self.last + 1] for each in points]
        if self._chosen is None:
            return self._distances(points)
        return np.array([(_at(self._chosen, self._triangles, each) - self._seen)[self._known] for each in points])

    def _distances(self, points):
        found = []
        for frame, known in enumerate(self._known):
            if not known.any():
                continue
            seen, triangles = self._seen[frame][known], self._triangles
            chosen = nearest_points(seen, points[0][frame], triangles)
            away = seen - _at(chosen, triangles, points[0][frame])
            size = np.linalg.norm(away, axis=1)
            corners = points[0][frame][triangles[chosen[0]]]
            normal = _normals(corners)
            # On the cloth itself, or above it by rounding, the direction to it is the normal.
            near = size <= 1e-12 * np.abs(corners).max()
            direction = np.where(near[:, None], normal, away / np.where(near, 1.0, size)[:, None])
            found.append([np.einsum("ki,ki->k", seen - _at(chosen, triangles, each[frame]), direction) for each in points])
        return np.concatenate(found, axis=1)


class _OnSurface:
    def __init__(self, seen, triangles, sigma):
        self._seen = {frame: points for frame, points in sorted(seen.items()) if len(points)}
        self._triangles, self.sigma = triangles, sigma
        self.last = max(self._seen, default=0) + 1
        numbers = [np.full(len(points), frame) for frame, points in self._seen.items()]
        self.frames = np.concatenate([np.empty(0, dtype=int), *numbers])

    def residuals(self, runs):
        triangles = self._triangles
        points = [np.asarray(run.points, dtype=np.float64) for run in runs]
        points = [each[None] if each.ndim == 2 else each[1:] for each in points]
        found = []
        for frame, seen in self._seen.items():
            chosen = nearest_points(seen, points[0][frame], triangles)
            normal = _normals(points[0][frame][triangles[chosen[0]]])
            found.append([np.einsum("ki,ki->k", seen - _at(chosen, triangles, each[frame]), normal) for each in points])
        return np.concatenate(found, axis=1)


class _Read:
    last = None

    def __init__(self, name, reading):
        self._name, self._function = name, reading.function
        self._value = numeric("value", reading.value, "be numbers")
        self._known = np.isfinite(self._value)
        self.frames = np.full(int(self._known.sum()), -1)  # of no frame
        self.sigma = None if reading.sigma is None else np.broadcast_to(reading.sigma, self._value.shape)[self._known]

    def residuals(self, runs):
        try:
            read = [self._function(run) for run in runs]
        except TypeError as error:
            if "NoneType" not in str(error) or not any(run.energies is None or run.reactions is None for run in runs):
                raise
            raise ValueError(
                f"{self._name}.function reads what a run has not ({error}); give record, such as record='reactions'"
            ) from error
        return np.array([array(f"{self._name}.function", each, self._value.shape) - self._value for each in read])[
            :, self._known
        ]


def no_common_frame(where: str, times: np.ndarray, scene: Scene) -> str:
    """Returns the sentence that an animation with these times has no frame in common with a scene."""
    return (
        f"{where}: has {len(times)} frames from {times[0]:g} to {times[-1]:g} s, none at the time of a frame of the scene; it "
        f"must have one at a multiple of 1/{scene.fps:g} s, up to {scene.frames / scene.fps:g} s"
    )


def _normals(corners):
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]


def _at(chosen, triangles, points):
    if isinstance(chosen, tuple):
        return np.einsum("kc,...kci->...ki", chosen[1], points[..., triangles[chosen[0]], :])
    return points[..., chosen, :]


def _bound(name, triangles, weights, of_mesh):
    given = numeric(f"{name}.triangles", triangles, "have shape (k,)")
    if given.ndim != 1:
        raise ValueError(f"{name}.triangles has shape {given.shape}; it must be (k,)")
    refuse(
        f"{name}.triangles",
        given,
        ~((given >= 0) & (given < len(of_mesh)) & (given == np.rint(given))),
        f"must be a whole number from 0 to {len(of_mesh) - 1}, the last triangle",
    )
    weights = array(f"{name}.weights", weights, (len(given), 3))
    sums = weights.sum(axis=1)
    refuse(f"the sum of {name}.weights", sums, np.abs(sums - 1.0) > _BOUND, "must be 1")
    return given.astype(int), weights


def _starts(path, scene, rows):
    if not rows:
        return {}
    lines, names, points = zip(*rows, strict=True)
    points = np.array(points)
    refuse(f"{path}: positions at time 0", points, ~np.isfinite(points), "must be finite")
    triangles, weights = nearest_points(points, scene.positions, scene.mesh.triangles)
    away = np.linalg.norm(_at((triangles, weights), scene.mesh.triangles, scene.positions) - points, axis=1)
    corners = scene.positions[scene.mesh.triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    found: dict[str, tuple[Any, Any]] = {}
    for line, name, distance, *nearest in zip(lines, names, away, triangles, weights, strict=True):
        if name in found:
            raise ValueError(f"{path}, line {line}: marker {name!r} has a row at time 0 before; it must have one only")
        if distance > longest:
            raise ValueError(
                f"{path}, line {line}: marker {name!r} is {distance:.3g} m from the cloth at time 0; it must be at most "
                f"{longest:.3g} m, the longest edge"
            )
        found[name] = nearest[0], nearest[1]
    return found


def _refuse_no_triangles(name, scene, purpose="for markers; give the vertices that were measured"):
    if not len(scene.mesh.triangles):
        raise ValueError(f"{name}: the mesh has no triangles {purpose}")


def _check_size(where, seen, scene):
    """Checks that a capture, points (k, 3) [m] by frame, is about as large as the cloth, without 5 % at each end."""
    sizes = [np.linalg.norm(np.ptp(np.percentile(each, [5.0, 95.0], axis=0), axis=0)) for each in seen.values() if len(each)]
    cloth = np.linalg.norm(np.ptp(scene.positions, axis=0))
    if sizes and not _SMALLER * cloth <= np.median(sizes) <= _LARGER * cloth:
        raise ValueError(
            f"{where}: is about {np.median(sizes):.3g} m across, and the cloth {cloth:.3g} m; lengths must be metres, or, "
            "of mesh files, of the unit that open_capture(path, scale=…), or --scale on the command line, gives"
        )
