"""Compares the surfaces of two animations, whose triangles may change, by samples of their areas."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import number, shown, whole
from ..base.types import FilePath, Progress, UpAxis
from ..mesh.captures import Capture, as_capture, open_capture, solid_triangles
from ..mesh.distances import Boundary, nearest_on_surface, surface_samples
from ..mesh.mesh import Mesh, areas_of
from ..mesh.sequences import HasPoints, Sequence, as_sequence
from .compare import ComparedFrames, in_one_axis, longest_side, measured_frames, whole_frame
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


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfaceComparison(ComparedFrames):
    """The comparison of two captures, a and b; triangles that are not finite are holes.

    Attributes:
        up_axes, times, frames, labels, unmatched, excluded, sizes, hausdorff, hausdorff_bound: See
            :class:`warpcloth.analysis.compare.ComparedFrames`.
        vertices: Numbers of vertices (F, 2).
        all: Distances of all points; those that face a hole are as far as its rim.
        inner: Distances of points whose nearest point is not on the boundary of the other.
        inner_area: Share of the area that these stand for (F, 2) [1].
    """

    vertices: np.ndarray
    all: SurfaceDistances
    inner: SurfaceDistances
    inner_area: np.ndarray


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
    one, other, up_axes = in_one_axis(one, other, up_axis_a or up_axis, up_axis_b or up_axis)
    excluded = tuple([whole_frame(label, "is missing") for label in each.missing] for each in (one, other))

    def measure(i, j):
        return _measured(one[i], other[j], (one.labels[i], other.labels[j]), excluded, samples, device)

    found = measured_frames(one, other, measure, excluded, frames, progress)
    all_points, inner = (SurfaceDistances(*np.moveaxis(found.pop(kind), 2, 0)) for kind in ("all", "inner"))
    return SurfaceComparison(up_axes=up_axes, all=all_points, inner=inner, **found)


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
