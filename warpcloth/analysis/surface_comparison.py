"""Compares the surfaces of two animations, whose triangles may change, by samples of their areas."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import number, shown, whole
from ..base.types import FilePath, Progress, UpAxis
from ..mesh.captures import Capture, as_capture, open_capture, solid_triangles
from ..mesh.distances import Boundary, nearest_on_surface, surface_samples
from ..mesh.mesh import Mesh, Surface, areas_of
from ..mesh.sequences import HasPoints, Sequence, as_sequence
from .compare import longest_side, matching, turned_up, up_axis_of, whole_frame
from .samples import Exclusion

Captured = FilePath | Capture | Sequence | tuple[Mesh, ArrayLike | HasPoints] | Iterable[Mesh]
_FAR = 1e60  # largest coordinate [m]: up to it, squares of areas are finite
SHARE = 0.95  # the share of the area that is nearer than ``percentile``


@dataclass(frozen=True, eq=False)
class SurfaceDistances:
    """Distances of points of a to b, and of b to a, (F, 2) [m]; NaN without points.

    Attributes:
        mean: Mean over the area.
        rms: Root mean square over the area.
        percentile: 95 % of the area are no farther.
        largest: The largest distance of a sample or vertex.
    """

    mean: np.ndarray
    rms: np.ndarray
    percentile: np.ndarray
    largest: np.ndarray


@dataclass(frozen=True, eq=False)
class SurfaceComparison:
    """The comparison of two captures, a and b, in this order on axes of length 2.

    A frame is a pair at one time, or NaN where ``excluded`` says why it could not be compared.

    Attributes:
        up_axes: "Y" or "Z" of a and b, or None; b was turned to a's.
        times: Times of the frames (F,) [s].
        frames: Indices in a and in b (F, 2).
        labels: Numbers in the files (F, 2).
        unmatched: Indices of frames of a, and of b, without a partner.
        excluded: Two lists of `analysis.Exclusion`, of a and b; triangles that are not finite are holes.
        sizes: Diagonal of the bounding box of a (F,) [m].
        vertices: Numbers of vertices (F, 2).
        all: Distances of all points; those that face a hole are as far as its rim.
        inner: Distances of points whose nearest point is not on the boundary of the other.
        inner_area: Share of the area that these stand for (F, 2) [1].
        hausdorff: The larger of the two largest distances (F,) [m], a lower bound, but for rounding, of that of the surfaces.
        hausdorff_bound: Upper bound of the Hausdorff distance (F,) [m]: hausdorff + l/√3 with the longest side l.
    """

    up_axes: tuple[UpAxis | None, UpAxis | None]
    times: np.ndarray
    frames: np.ndarray
    labels: np.ndarray
    unmatched: tuple[np.ndarray, ...]
    excluded: tuple[list[Exclusion], ...]
    sizes: np.ndarray
    vertices: np.ndarray
    all: SurfaceDistances
    inner: SurfaceDistances
    inner_area: np.ndarray
    hausdorff: np.ndarray
    hausdorff_bound: np.ndarray


def compare_surfaces(
    a: Captured,
    b: Captured,
    prim_a: str | None = None,
    prim_b: str | None = None,
    fps: float | None = None,
    fps_a: float | None = None,
    fps_b: float | None = None,
    scale_a: float = 1.0,
    scale_b: float = 1.0,
    samples: int = 10_000,
    frames: int | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
    up_axis: UpAxis | None = None,
    up_axis_a: UpAxis | None = None,
    up_axis_b: UpAxis | None = None,
) -> SurfaceComparison:
    """Compares the surfaces of two animations at the times that both have; triangles may change.

    Means are over area. If the vertices of a have independent errors of standard deviation σ along the normal, the RMS from a
    is σ/√2.

    Args:
        a: A path for `open_capture`, a :class:`warpcloth.Capture`, a :class:`warpcloth.Sequence`, (mesh, frames) for
            `as_sequence`, or a list of meshes.
        b: As a.
        prim_a: Prim of a stage with several.
        prim_b: That of b.
        fps: Frames per second of both, instead of their own.
        fps_a: That of a.
        fps_b: That of b.
        scale_a: Unit of the mesh files of a [m].
        scale_b: That of b.
        samples: Minimum number of samples of each; a triangle has three or more.
        frames: Number of frames to compare after the first common one.
        device: A Warp device.
        progress: Function called with (frame, frames), ``frames`` being those after the first.
        up_axis: "Y" or "Z", as in :func:`warpcloth.compare`.
        up_axis_a: That of a.
        up_axis_b: That of b.

    Returns:
        :class:`SurfaceComparison`.

    Raises:
        ValueError: An input is not allowed or has no times, a frame cannot be read, or no frames match or can be compared.

    Examples:
        >>> import warpcloth as wc
        >>> fine, coarse = wc.Mesh.grid(9, 9), wc.Mesh.grid(3, 3)
        >>> raised = wc.Mesh(coarse.points + [0, 0.1, 0], coarse.triangles)
        >>> wc.compare_surfaces([fine], [raised], fps=24).all.rms.round(6).tolist()
        [[0.1, 0.1]]
    """
    whole("samples", samples, least=1)
    if frames is not None:
        whole("frames", frames, least=0)
    one = opened_capture("a", a, prim_a, fps if fps_a is None else fps_a, scale_a)
    other = opened_capture("b", b, prim_b, fps if fps_b is None else fps_b, scale_b)
    up_axes = up_axis_of("up_axis_a", one, up_axis_a or up_axis), up_axis_of("up_axis_b", other, up_axis_b or up_axis)
    other = capture_to_up_axis(other, *up_axes)
    pairs, unmatched = matching(one, other, frames)
    excluded = tuple([whole_frame(label, "is missing") for label in each.missing] for each in (one, other))
    rows = []
    for frame, (i, j) in enumerate(pairs):
        rows.append(_measured(one[i], other[j], (one.labels[i], other.labels[j]), excluded, samples, device))
        if progress is not None:
            progress(frame, len(pairs) - 1)
    first = next(filter(None, rows), None)
    if first is None:
        why = next(last for each in excluded for last in reversed(each))
        raise ValueError(f"none of the {len(pairs)} frames that a and b both have can be compared: {why}")
    columns: dict[str, Any] = {
        name: np.array([row.get(name, np.full(np.shape(value), np.nan)) for row in rows]) for name, value in first.items()
    }
    both: dict[str, Any] = {kind: SurfaceDistances(*np.moveaxis(columns.pop(kind), 2, 0)) for kind in ("all", "inner")}
    labels = np.column_stack([one.labels[pairs[:, 0]], other.labels[pairs[:, 1]]])
    times = np.asarray(one.times)[pairs[:, 0]]
    return SurfaceComparison(up_axes, times, pairs, labels, unmatched, excluded, **columns, **both)


def opened_capture(
    name: str, source: Captured, prim: str | None = None, fps: float | None = None, scale: float = 1.0
) -> Capture:
    """Returns the `Capture` of an input, called ``name`` in messages."""
    if isinstance(source, (str, PathLike)):
        return open_capture(source, prim, fps, scale)
    if fps is not None:
        number("fps", fps, above=0.0)
    dt = None if fps is None else 1.0 / fps
    if isinstance(source, Capture):
        return source
    if isinstance(source, Sequence):
        return as_capture(source)
    if isinstance(source, tuple) and len(source) == 2 and isinstance(source[0], Mesh) and not isinstance(source[1], Mesh):
        return as_capture(as_sequence(source[0], source[1], dt=dt))
    if not isinstance(source, (list, tuple)):
        raise ValueError(f"{name} is {shown(source)}; it must be a path, a Capture, a Sequence, (mesh, frames) or meshes")
    return as_capture(source, dt=dt)


def capture_to_up_axis(b: Capture, axis_a: UpAxis | None, axis_b: UpAxis | None) -> Capture:
    """Returns b rotated to the up axis of a; b itself if they agree or one is unknown."""
    if axis_a is None or axis_b is None or axis_a == axis_b:
        return b

    def read(frame):
        surface = b[frame]
        return Surface(turned_up(surface.points, axis_a), surface.triangles)

    return replace(b, read=read)


def _measured(a, b, labels, excluded, samples, device):
    surfaces, lost = [], False
    for surface, label, notes in zip((a, b), labels, excluded, strict=True):
        bad = np.flatnonzero(~np.isfinite(surface.points).all(axis=1))
        if len(bad):
            notes.append(Exclusion(label, "vertex", bad, "no finite position, so that the triangles there count as holes"))
        triangles = solid_triangles(surface)
        used, corners = np.unique(triangles, return_inverse=True)
        points, triangles = surface.points[used], corners.reshape(-1, 3)
        if not areas_of(points, triangles).sum() > 0.0:
            notes.append(whole_frame(label, "has no area, so that it is not compared"))
            lost = True
        elif np.abs(points).max() > _FAR:
            notes.append(whole_frame(label, f"has a coordinate above {_FAR:g} m, so that it is not compared"))
            lost = True
        surfaces.append((points, triangles))
    if lost:
        return {}
    found, shares = [], []
    for k in range(2):
        all_of, inner_of, share = _distances(*surfaces[k], *surfaces[1 - k], samples, device)
        if not share:
            excluded[k].append(
                whole_frame(labels[k], "faces nothing but the boundary of the other, so that no inner points are left")
            )
        found.append((all_of, inner_of))
        shares.append(share)
    hausdorff = max(each[0][3] for each in found)
    return {
        "sizes": np.linalg.norm(np.ptp(surfaces[0][0], axis=0)),
        "vertices": np.array([len(a.points), len(b.points)]),
        "all": np.array([each[0] for each in found]),
        "inner": np.array([each[1] for each in found]),
        "inner_area": np.array(shares),
        "hausdorff": hausdorff,
        "hausdorff_bound": hausdorff + max(longest_side(*each) for each in surfaces) / np.sqrt(3.0),
    }


def _distances(x, triangles, y, others, samples, device):
    faces, weights, areas = surface_samples(x, triangles, samples)
    points = np.concatenate([np.einsum("kc,kci->ki", weights, x[triangles[faces]]), x])
    areas = np.concatenate([areas, np.zeros(len(x))])  # vertices count for the largest distance alone
    found, at, weights = nearest_on_surface(points, y, others, device)
    inner = ~Boundary(y, others).has(at, weights)
    share = areas[inner].sum() / areas.sum()
    return _numbers(found, areas), _numbers(found[inner], areas[inner]), share


def _numbers(distances, areas):
    if not areas.sum() > 0.0:
        return np.full(4, np.nan)
    shares = areas / areas.sum()
    order = np.argsort(distances)
    at = np.searchsorted(np.cumsum(shares[order]), SHARE).clip(max=len(order) - 1)
    return np.array([shares @ distances, np.sqrt(shares @ distances**2), distances[order[at]], distances.max()])
