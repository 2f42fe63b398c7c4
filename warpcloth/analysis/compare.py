"""Compares two animated cloths: distances of positions and surfaces, and differences of stretches."""

from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import choice, number, shown, whole
from ..base.types import FilePath, Progress, UpAxis
from ..mesh.distances import surface_distances
from ..mesh.mesh import UP_AXES, Mesh, Surface, areas_of, same_topology
from ..mesh.sequences import HasPoints, Sequence, as_sequence, open_sequence
from .measures import MEASURES
from .samples import Exclusion
from .surfaces import Triangles

Compared = FilePath | Sequence | tuple[Mesh, FilePath | ArrayLike | HasPoints]
_SAME_TIME = 1e-6  # tolerance of times, relative to the shortest frame


@dataclass(frozen=True, eq=False, kw_only=True)
class ComparedFrames:
    """The frames of two animations, a and b, that were compared, in this order on axes of length 2.

    A frame is a pair at one time, or NaN where ``excluded`` says why it could not be compared.

    Attributes:
        up_axes: "Y" or "Z" of a and b, or None; b was turned to a's.
        times: Times of the frames (F,) [s].
        frames: Indices in a and in b (F, 2).
        labels: Numbers in the files (F, 2).
        unmatched: Indices of frames of a, and of b, without a partner.
        excluded: Two lists of `analysis.Exclusion`, of a and b, with the frame numbers of the files.
        sizes: Diagonal of the bounding box of a (F,) [m].
        hausdorff: The largest distance of a sampled point of either surface to the other (F,) [m], a lower bound, but for
            rounding, of that of the surfaces.
        hausdorff_bound: Upper bound of the Hausdorff distance of the surfaces (F,) [m]: hausdorff + l/√3 with the longest side
            l.
    """

    up_axes: tuple[UpAxis | None, UpAxis | None]
    times: np.ndarray
    frames: np.ndarray
    labels: np.ndarray
    unmatched: tuple[np.ndarray, ...]
    excluded: tuple[list[Exclusion], ...]
    sizes: np.ndarray
    hausdorff: np.ndarray
    hausdorff_bound: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Comparison(ComparedFrames):
    """The comparison of two sequences, a and b.

    With different topologies arrays of vertices and triangles are None. Triangles without area at rest do not count for
    stretches.

    Attributes:
        up_axes, times, frames, labels, unmatched, excluded, sizes, hausdorff, hausdorff_bound: See :class:`ComparedFrames`.
        same_topology: Whether both have equally many vertices and the same triangles.
        rms: Root mean square of ‖aᵢ − bᵢ‖ over vertices (F,) [m], or None.
        largest: The largest of these (F,) [m], or None; ``hausdorff_bound`` is no more.
        largest_vertex: Its vertex (F,), −1 in excluded frames, or None.
        surface_mean: Mean distance of a's vertices to the surface of b, and vice versa (F, 2) [m], weighted by thirds of
            triangle areas in the frame.
        surface_rms: Root mean square of these (F, 2) [m].
        surface_largest: The largest of these (F, 2) [m]; ``hausdorff`` is the larger of the two.
        stretch_rms: Root mean square over triangles of the differences of principal stretches λ₁ ≥ λ₂ from each rest shape (F,
            2) [1], or None.
        stretch_largest: The largest of these differences (F, 2) [1], or None.
    """

    same_topology: bool
    surface_mean: np.ndarray
    surface_rms: np.ndarray
    surface_largest: np.ndarray
    rms: np.ndarray | None = None
    largest: np.ndarray | None = None
    largest_vertex: np.ndarray | None = None
    stretch_rms: np.ndarray | None = None
    stretch_largest: np.ndarray | None = None

    @property
    def relative_rms(self) -> np.ndarray | None:
        """``rms`` over ``sizes`` (F,), NaN if a is a point; None if ``rms`` is None."""
        if self.rms is None:
            return None
        return np.divide(self.rms, self.sizes, out=np.full(len(self.rms), np.nan), where=self.sizes > 0.0)


def compare(
    a: Compared,
    b: Compared,
    prim_a: str | None = None,
    prim_b: str | None = None,
    fps: float | None = None,
    fps_a: float | None = None,
    fps_b: float | None = None,
    frames: int | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
    up_axis: UpAxis | None = None,
    up_axis_a: UpAxis | None = None,
    up_axis_b: UpAxis | None = None,
) -> Comparison:
    """Compares two animations at the times that both have.

    Times match within 1e-6 of the shortest frame; one frame of each is in memory. Identical frames of the same triangles have
    distance 0.

    Args:
        a: Anything that `open_sequence` takes or returns, or (mesh, frames): a rest shape, and a path or anything that
            `as_sequence` takes.
        b: As a.
        prim_a: Prim of a stage with several.
        prim_b: That of b.
        fps: Frames per second of both, instead of their own.
        fps_a: That of a.
        fps_b: That of b.
        frames: Number of frames to compare after the first common one.
        device: A Warp device.
        progress: Function called with (frame, frames), ``frames`` being those after the first.
        up_axis: "Y" or "Z", instead of their own, an unknown one being the other's; b is rotated to the axis of a: (x, y, z) of
            Z up is (x, z, −y) of Y up.
        up_axis_a: That of a.
        up_axis_b: That of b.

    Returns:
        :class:`Comparison`.

    Raises:
        ValueError: An input is not allowed or has no times, a frame cannot be read, or no frames match or can be compared.

    Examples:
        >>> import warpcloth as wc
        >>> mesh = wc.Mesh.grid(3, 3)
        >>> apart = wc.compare((mesh, [mesh.points]), (mesh, [mesh.points + [0, 0.1, 0]]), fps=24)
        >>> apart.rms.round(6).tolist(), apart.stretch_largest.round(6).tolist()
        ([0.1], [[0.0, 0.0]])
    """
    if frames is not None:
        whole("frames", frames, least=0)
    one = opened("a", a, prim_a, fps if fps_a is None else fps_a)
    other = opened("b", b, prim_b, fps if fps_b is None else fps_b)
    one, other, up_axes = in_one_axis(one, other, up_axis_a or up_axis, up_axis_b or up_axis)
    pair = _Pair(one, other, device)
    found = measured_frames(one, other, pair.measure, pair.excluded, frames, progress)
    return Comparison(same_topology=pair.same, up_axes=up_axes, **found)


def opened(name: str, source: Any, prim: str | None = None, fps: float | None = None) -> Sequence:
    """Returns the `Sequence` of an input, called ``name`` in messages."""
    if isinstance(source, Sequence):
        return source
    if isinstance(source, (str, PathLike)):
        return open_sequence(source, prim, fps)
    if not isinstance(source, tuple) or len(source) != 2:
        raise ValueError(f"{name} is {shown(source)}; it must be a path, a Sequence, or (mesh, frames)")
    mesh, frames = source
    if not isinstance(frames, (str, PathLike)):
        if fps is not None:
            number("fps", fps, above=0.0)
        return as_sequence(mesh, frames, dt=None if fps is None else 1.0 / fps)
    sequence = open_sequence(frames, prim, fps, mesh)
    if not same_topology(mesh, sequence.mesh):
        raise ValueError(f"{name}: its mesh is {mesh}, and {frames} has other triangles; it must be the rest shape of these")
    return replace(sequence, mesh=mesh, declared=True, up_axis=sequence.up_axis or mesh.up_axis)


def in_one_axis(a, b, up_axis_a, up_axis_b):
    """Returns a, b rotated to the up axis of a, and the two axes, given or their own."""
    for name, given in (("up_axis_a", up_axis_a), ("up_axis_b", up_axis_b)):
        if given is not None:
            choice(name, given, UP_AXES)
    axes = up_axis_a or a.up_axis, up_axis_b or b.up_axis
    return a, to_up_axis(b, *axes), axes


def to_up_axis(b: Any, axis_a: UpAxis | None, axis_b: UpAxis | None) -> Any:
    """Returns a sequence or capture rotated to the up axis of a, without rounding; b itself if they agree or one is unknown."""
    if axis_a is None or axis_b is None or axis_a == axis_b:
        return b

    def read(frame):
        found = b[frame]
        if isinstance(found, Surface):
            return Surface(turned_up(found.points, axis_a), found.triangles)
        return turned_up(found, axis_a)

    return replace(b, read=read)


def turned_up(points: np.ndarray, axis: UpAxis) -> np.ndarray:
    """Returns points (n, 3) rotated to this up axis from the other, without rounding."""
    return points[:, [0, 2, 1]] * ([1.0, 1.0, -1.0] if axis == "Y" else [1.0, -1.0, 1.0])


def measured_frames(a, b, measure, excluded, frames, progress):
    """Measures the frames of two sequences or captures, a and b, at one time.

    Args:
        a: Read by index.
        b: The same.
        measure: (i, j) of a frame of a and of b → its numbers by name, or {} once ``excluded`` has the reason.
        excluded: Two lists of `Exclusion`, of a and b.
        frames: Number of frames after the first; None for all.
        progress: (frame, frames) → None, or None.

    Returns:
        dict: Fields of `ComparedFrames` but ``up_axes``, and arrays of the other numbers.

    Raises:
        ValueError: One has no times, no frames match, or none can be compared.
    """
    for name, each in (("a", a), ("b", b)):
        if each.times is None:
            where = name if each.path is None else each.path
            raise ValueError(f"{where}: has no times, by which frames belong together; give fps (--fps or --fps-{name})")
    pairs = _at_one_time(a, b)
    unmatched = tuple(np.setdiff1d(np.arange(len(s)), partners) for s, partners in zip((a, b), pairs.T, strict=True))
    pairs = pairs if frames is None else pairs[: frames + 1]
    labels = np.column_stack([a.labels[pairs[:, 0]], b.labels[pairs[:, 1]]])
    rows = []
    for frame, (i, j) in enumerate(pairs):
        rows.append(measure(i, j))
        if progress is not None:
            progress(frame, len(pairs) - 1)
    if not any(rows):
        reasons = [one for k in (0, 1) for one in excluded[k] if one.kind != "triangle" and one.frame in labels[:, k]]
        why = next((one for one in reasons if one.kind == "frame"), reasons[0])
        raise ValueError(f"none of the {len(pairs)} frames that a and b both have can be compared: {why}")
    times = np.asarray(a.times)[pairs[:, 0]]
    about = {"times": times, "frames": pairs, "labels": labels, "unmatched": unmatched, "excluded": tuple(excluded)}
    return about | _columns(rows)


def _at_one_time(a, b):
    steps = np.concatenate([np.diff(a.times), np.diff(b.times)])
    near = _SAME_TIME * (steps.min() if len(steps) else 1.0)
    after = np.searchsorted(b.times, a.times - near).clip(max=len(b) - 1)
    found = np.abs(b.times[after] - a.times) <= near
    if not found.any():
        spans = " and ".join(f"{len(s)} from {s.times[0]:g} to {s.times[-1]:g} s" for s in (a, b))
        raise ValueError(f"no frame of a has the time of a frame of b; they have {spans}")
    return np.column_stack([np.flatnonzero(found), after[found]])


def _columns(rows):
    first = next(row for row in rows if row)
    missing = {name: -1 if name == "largest_vertex" else np.full(np.shape(value), np.nan) for name, value in first.items()}
    return {name: np.array([row.get(name, missing[name]) for row in rows]) for name in first}


class _Pair:
    def __init__(self, a, b, device):
        self.sequences, self.device = (a, b), device
        self.triangles = a.mesh.triangles, b.mesh.triangles
        self.used = [np.unique(triangles) for triangles in self.triangles]
        self.same = same_topology(a.mesh, b.mesh)
        self.excluded = [[whole_frame(label, "is missing") for label in s.missing] for s in (a, b)]
        if self.same:
            stretch = [MEASURES["triangle"]["stretch"]]
            self.elements = [Triangles(s.mesh, stretch, None, None, device, "float64") for s in (a, b)]
            without = [
                one.refer(s.mesh.points, s.rounding(s.mesh.points)) for one, s in zip(self.elements, (a, b), strict=True)
            ]
            for excluded, lost in zip(self.excluded, without, strict=True):
                if lost.any():
                    reason = "no area, so that stretches are not compared"
                    excluded.append(Exclusion(None, "triangle", np.flatnonzero(lost), reason))
            self.kept = ~(without[0] | without[1])

    def measure(self, i, j):
        points = [sequence[index] for sequence, index in zip(self.sequences, (i, j), strict=True)]
        labels = [sequence.labels[index] for sequence, index in zip(self.sequences, (i, j), strict=True)]
        lost = [np.flatnonzero(~np.isfinite(x).all(axis=1)) for x in points]
        for excluded, label, vertices in zip(self.excluded, labels, lost, strict=True):
            if len(vertices):
                excluded.append(
                    Exclusion(label, "vertex", vertices, "has no finite position, so that the frame is not compared")
                )
        if any(map(len, lost)):
            return {}
        row, apart = {"sizes": np.linalg.norm(np.ptp(points[0], axis=0))}, None
        if self.same:
            apart = np.linalg.norm(points[0] - points[1], axis=1)
            row |= {"rms": _rms(apart), "largest": apart.max(), "largest_vertex": apart.argmax()} | self._stretches(points)
        return row | self._surfaces(points, labels, apart)

    def _stretches(self, points):
        if not self.kept.any():
            return {"stretch_rms": np.full(2, np.nan), "stretch_largest": np.full(2, np.nan)}
        for elements, x in zip(self.elements, points, strict=True):
            elements.measure(x)
        one, other = (elements.read()["stretch"][self.kept] for elements in self.elements)
        apart = np.abs(one - other)
        return {"stretch_rms": _rms(apart), "stretch_largest": apart.max(axis=0)}

    def _surfaces(self, points, labels, apart):
        mean, rms, largest = np.full((3, 2), np.nan)
        for k, used in enumerate(self.used):
            found = surface_distances(points[k][used], points[1 - k], self.triangles[1 - k], self.device)
            if apart is not None:  # the corresponding vertex is a point of the other surface
                found = np.minimum(found, apart[used])
            largest[k] = found.max()
            thirds = np.repeat(areas_of(points[k], self.triangles[k]) / 3.0, 3)
            areas = np.bincount(self.triangles[k].ravel(), thirds)[used]
            if areas.sum() > 0.0:
                weights = areas / areas.sum()
                mean[k], rms[k] = weights @ found, np.sqrt(weights @ found**2)
            else:
                self.excluded[k].append(whole_frame(labels[k], "has no area, so that there is no mean over its surface"))
        hausdorff = largest.max()
        longest = max(longest_side(x, triangles) for x, triangles in zip(points, self.triangles, strict=True))
        bound = hausdorff + longest / np.sqrt(3.0)
        return {
            "surface_mean": mean,
            "surface_rms": rms,
            "surface_largest": largest,
            "hausdorff": hausdorff,
            "hausdorff_bound": bound if apart is None else min(bound, apart[self.used[0]].max()),
        }


def whole_frame(label: float, reason: str) -> Exclusion:
    """Returns the `Exclusion` of a whole frame."""
    return Exclusion(label, "frame", np.empty(0, dtype=int), reason)


def _rms(values):
    return np.sqrt(np.mean(values**2, axis=0))


def longest_side(x: np.ndarray, triangles: np.ndarray) -> float:
    """Returns the longest side [m] of triangles (T, 3) of x (n, 3)."""
    return np.linalg.norm(x[triangles] - x[np.roll(triangles, 1, axis=1)], axis=2).max()
