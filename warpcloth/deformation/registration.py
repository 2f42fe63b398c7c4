"""Resampling of captures: a template is moved onto each frame, as rigidly as possible."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import array, number, shown, whole
from ..base.types import FilePath, Progress
from ..mesh.captures import Capture, solid_triangles
from ..mesh.distances import Boundary, nearest_on_surface
from ..mesh.mesh import Mesh, Surface, areas_of
from ..scene.scene import Pins, checked_pins
from ..usd import AnimationWriter
from .arap import edge_weights, half_cotangents

_TURNED = np.cos(np.radians(60.0))  # cosine of the largest angle between the normals of a point and of the template
_FEW = 0.01  # `resample` warns if a smaller share of the capture counts, or of the template faces it
_BENDING = 0.12  # weight of the energy of cells, which resists bending too, relative to that of triangles, which resists strain
_KEPT = 0.9  # share of the last frame in the shape to which the energy of cells is relative; the rest shape has the other share
_REGULAR = 1e-12  # added to the diagonal, relative to its largest entry, so that the matrix has an inverse
_CORNERS = np.arange(3)


@dataclass(frozen=True, eq=False)
class Resampled:
    """A capture resampled to one topology, at each label from the first to the last.

    Attributes:
        mesh: The template at rest.
        points: Its vertices (F, n, 3) [m], interpolated linearly where the capture lacks frames.
        distances: Distances of vertices from the capture (F, n) [m]; NaN in such frames.
        observed: Whether a vertex faces the capture (F, n): its nearest point is within ``within`` and not on the boundary.
        rms: RMS distance of the points that count from the template (F,) [m]; NaN in such frames.
        used: Share of the capture's area that counts (F,) [1]; NaN in such frames.
        iterations: Numbers of iterations (F,); 0 in such frames.
        converged: Whether the last moved no vertex by more than the tolerance (F,).
        labels: Numbers of the frames (F,).
        times: (F,) [s].
        pins: Vertices of given positions (p,).
    """

    mesh: Mesh
    points: np.ndarray
    distances: np.ndarray
    observed: np.ndarray
    rms: np.ndarray
    used: np.ndarray
    iterations: np.ndarray
    converged: np.ndarray
    labels: np.ndarray
    times: np.ndarray
    pins: np.ndarray

    def write(self, output: FilePath, single_file: bool = False) -> None:
        """Writes the animation as USD, with the primvars ``captureDistance`` [m], −1 where it is NaN, and ``captureObserved``.

        Args:
            output: Path of a .usd, .usda, .usdc or .usdz file.
            single_file: Whether it is one file.
        """
        fps = (len(self.times) - 1) / (self.times[-1] - self.times[0]) if len(self.times) > 1 else 24.0
        primvars = {"captureDistance": "vertex", "captureObserved": "vertex"}
        writer = AnimationWriter(output, self.mesh, round(float(fps), 6), pins={"pins": self.pins}, primvars=primvars)
        velocities = np.diff(self.points, axis=0, prepend=self.points[:1]) * fps
        for points, v, distances, observed in zip(self.points, velocities, self.distances, self.observed, strict=True):
            known = {"captureDistance": np.where(np.isnan(distances), -1.0, distances), "captureObserved": observed * 1.0}
            writer.append(points, v, known)
        writer.close(single_file=single_file)


def resample(
    capture: Capture,
    template: Mesh,
    positions: ArrayLike | None = None,
    pins: Pins | None = None,
    stiffness: float = 1e-3,
    within: float | None = None,
    iterations: int = 60,
    tolerance: float = 1e-5,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Resampled:
    """Moves a template onto each frame of a capture, for one topology, as :func:`warpcloth.analyze` needs.

    Minimises α·E(x, R) + Σ aₚ dₚ²/Σ aₚ over the vertices p of the capture (after Amberg, Romdhani & Vetter 2007, non-rigid
    iterative closest points), aₚ a third of the area of triangles at p. E is 2 Σ area ‖∇x − R‖² over triangles, with a rotation
    each (Liu, Zhang, Xu, Gotsman & Gortler 2008), plus 0.12 times that of :class:`warpcloth.Arap` with clamped weights, against
    bending. The latter compares with 0.9 times the edges of the last frame, or ``positions``, plus 0.1 times those at rest. dₚ
    is the distance of p from the tangent plane of the nearest point, on the boundary from that point. Points count within a
    distance and, unless beyond the outline, if the planes enclose less than 60°. Frames start from the last one, moved on by
    its motion.

    Args:
        capture: The capture, with times.
        template: The mesh at rest.
        positions: Positions near the first frame (n, 3) [m], with its folds; by default at rest.
        pins: :class:`warpcloth.Pins` of known positions: at ``positions``, or keyframes, one per label.
        stiffness: α [1]: less follows noise and slides, more cuts across folds.
        within: Maximum distance of points that count [m]; by default 10 % of the template's diagonal.
        iterations: Maximum per frame.
        tolerance: Share of the diagonal; iterations end when none of the vertices moves more.
        device: A Warp device, for nearest points.
        progress: Function called with (frame, frames), ``frames`` being those after the first.

    Returns:
        :class:`Resampled`.

    Raises:
        ValueError: An argument is not allowed, there are no times, or no point of a frame counts.

    Warns:
        UserWarning: Less than 1 % of the capture counts or of the template faces it, as with a wrong unit.

    Examples:
        >>> import warpcloth as wc
        >>> template, seen = wc.Mesh.grid(5, 5), wc.Mesh.grid(8, 7)
        >>> moved = wc.Mesh(seen.points + [0.05, 0.05, 0.0], seen.triangles)
        >>> found = wc.resample(wc.as_capture([moved], dt=1.0), template)
        >>> (found.points[0] - template.points).mean(axis=0).round(3).tolist()
        [0.05, 0.05, 0.0]
    """
    if not isinstance(capture, Capture):
        raise ValueError(f"capture is {shown(capture)}; it must be a Capture, such as open_capture(path, fps=24)")
    if not isinstance(template, Mesh) or not len(template.triangles):
        raise ValueError(f"template is {shown(template)}; it must be a Mesh with triangles, such as Mesh.load(path)")
    where = "capture" if capture.path is None else str(capture.path)
    if capture.times is None:
        raise ValueError(f"{where}: has no times; open it with open_capture(path, fps=…), or give --fps on the command line")
    diagonal = float(np.linalg.norm(np.ptp(template.points, axis=0)))
    within = 0.1 * diagonal if within is None else within
    for name, value in (("stiffness", stiffness), ("within", within), ("tolerance", tolerance)):
        number(name, value, above=0.0)
    whole("iterations", iterations, least=1)
    x = array("positions", template.points if positions is None else positions, template.points.shape)
    pins = None if pins is None else checked_pins(pins, template)
    if pins is not None and not pins.held.all():
        raise ValueError("pins.axes leaves some axes of a pin free; resample takes pins that hold all three")
    held = np.empty(0, dtype=int) if pins is None else pins.vertices
    labels = np.sort(np.concatenate([capture.labels, np.asarray(capture.missing, dtype=capture.labels.dtype)]))
    frames = np.searchsorted(labels, capture.labels)
    registration = Registration(template, held, stiffness, within, device)
    found = []
    for index, frame in enumerate(frames.tolist()):
        registration.keep(x)
        start = x.copy()
        if index > 1:
            start += (x - found[-2][0]) * ((frame - frames[index - 1]) / (frames[index - 1] - frames[index - 2]))
        start[held] = x[held]
        if pins is not None and pins.keyframes is not None:
            start[held] = pins.keyframes[min(frame, len(pins.keyframes) - 1)]
        try:
            found.append(registration.solve(capture[index], start, iterations, tolerance * diagonal))
        except ValueError as error:
            raise ValueError(f"{where}: frame {capture.labels[index]} {error}") from error
        x = found[-1][0]
        if progress is not None:
            progress(frame, len(labels) - 1)
    points, *rest = (np.array(column) for column in zip(*found, strict=True))
    times = np.interp(np.arange(len(labels)), frames, capture.times)
    observed, used = (float(np.mean(rest[k])) for k in (1, 3))
    if min(observed, used) < _FEW:
        near = f"{100.0 * used:.2g} % of its area is within {within:.3g} m of the template"
        faced = f"{100.0 * observed:.2g} % of the template faces it"
        wrong = "the unit of the capture (scale) or the start of the template may be wrong"
        warnings.warn(f"{where}: {near}, and {faced}; {wrong}", stacklevel=2)
    return Resampled(
        template,
        _filled(points, frames, len(labels)),
        *(_spread(each, frames, len(labels)) for each in rest),
        labels,
        times,
        held,
    )


def _filled(points, frames, count):
    after = np.searchsorted(frames, np.arange(count)).clip(min=min(1, len(frames) - 1))
    before = np.maximum(after - 1, 0)
    share = (np.arange(count) - frames[before]) / np.maximum(frames[after] - frames[before], 1)
    return points[before] + share[:, None, None] * (points[after] - points[before])


def _spread(values, frames, count):
    result = (
        np.full((count, *values.shape[1:]), np.nan)
        if values.dtype.kind == "f"
        else np.zeros((count, *values.shape[1:]), values.dtype)
    )
    result[frames] = values
    return result


class Registration:
    """Moves a template onto one surface after another (:func:`resample`).

    Args:
        held: Vertices that stay where a solve starts (p,).
        within: Maximum distance of points that count [m].
    """

    def __init__(self, mesh: Mesh, held: np.ndarray, stiffness: float, within: float, device: str) -> None:
        self._mesh, self._within, self._device = mesh, within, device
        self._triangles, n = mesh.triangles.astype(np.int64), len(mesh.points)
        pairs, w = edge_weights(mesh, "clamped")
        sides = np.stack([np.roll(self._triangles, -1, axis=1), np.roll(self._triangles, -2, axis=1)], axis=2).reshape(-1, 2)
        # Rotations are those of cells, numbered by their vertices, and then of triangles.
        cells, of_triangle = np.r_[pairs[:, 0], pairs[:, 1]], n + np.repeat(np.arange(len(self._triangles)), 3)
        cell_weights, triangle_weights = stiffness * _BENDING * w, 2.0 * stiffness * half_cotangents(mesh).ravel()
        # An edge is in the cells of both its ends.
        self._ends = np.concatenate([pairs, pairs, sides]).T
        self._numbers = np.concatenate([cells, of_triangle])
        self._weights = np.concatenate([cell_weights, cell_weights, triangle_weights])
        self._of_cells = slice(len(cells))
        self._rest = mesh.points[self._ends[0]] - mesh.points[self._ends[1]]
        self._edges = self._rest
        free = np.setdiff1d(np.arange(n), held)
        self._free = (3 * free[:, None] + _CORNERS).ravel()
        # α E is Σ w ‖·‖² over the entries, so that half of its gradient is L x − b.
        (i, j), w = self._ends, self._weights
        rows, columns = np.r_[i, j, i, j], np.r_[i, j, j, i]
        values = np.r_[w, w, -w, -w]
        corners = (3 * self._triangles[:, :, None] + _CORNERS).reshape(-1, 9)
        self._corners = corners
        self._pattern = (
            np.concatenate([(3 * rows[:, None] + _CORNERS).ravel(), np.repeat(corners, 9, axis=1).ravel()]),
            np.concatenate([(3 * columns[:, None] + _CORNERS).ravel(), np.tile(corners, (1, 9)).ravel()]),
        )
        self._rigid = np.repeat(values, 3)

    def keep(self, x: np.ndarray) -> None:
        """Makes the energy of cells relative to x (n, 3) [m], with a share of the rest shape."""
        (i, j), cells = self._ends, self._of_cells
        turned = self._turned(x, self._rest)[cells]
        self._edges = self._rest.copy()
        self._edges[cells] = turned + _KEPT * ((x[i] - x[j])[cells] - turned)

    def solve(self, surface: Surface, start: np.ndarray, iterations: int, tolerance: float) -> tuple:
        """Moves the template from ``start`` (n, 3) [m] onto a surface.

        Returns points (n, 3) [m], distances (n,) [m], observed (n,), RMS [m], share of the area that counts, iterations, and
        whether the last moved no vertex by more than ``tolerance`` [m]. Raises ValueError with the end of a sentence if no
        point counts.
        """
        triangles = solid_triangles(surface)
        used, corners = np.unique(triangles, return_inverse=True)
        points, triangles = surface.points[used], corners.reshape(-1, 3)
        if not areas_of(points, triangles).sum() > 0.0:
            raise ValueError("has no area")
        areas = np.bincount(triangles.ravel(), np.repeat(areas_of(points, triangles) / 3.0, 3), len(points))
        areas, normals = areas / areas.sum(), _vertex_normals(points, triangles)
        x, moved, count = start.copy(), np.inf, 0
        while count < iterations and moved > tolerance:
            step = self._step(x, points, normals, areas)
            x.reshape(-1)[self._free] += step
            moved, count = np.abs(step).max(initial=0.0), count + 1
        away, _faces, _weights, _tangent, counts = self._pairs(x, points, normals)
        share = areas[counts].sum()
        distances, faces, weights = nearest_on_surface(x, points, triangles, self._device)
        observed = (distances <= self._within) & ~Boundary(points, triangles).has(faces, weights)
        rms = np.sqrt(areas[counts] @ away[counts] ** 2 / share)
        return x, distances, observed, rms, share, count, bool(moved <= tolerance)

    def _pairs(self, x, points, normals):
        distances, faces, weights = nearest_on_surface(points, x, self._triangles, self._device)
        normal = _normals(x, self._triangles)[faces]
        beyond = Boundary(x, self._triangles).has(faces, weights)
        counts = (distances <= self._within) & (beyond | (np.abs(np.einsum("ki,ki->k", normals, normal)) > _TURNED))
        if not counts.any():
            raise ValueError(
                f"has no point within {self._within:.3g} m of the template whose normal is near that of the template"
            )
        projection = np.einsum("ki,kj->kij", normal, normal)
        projection[beyond] = np.eye(3)
        return distances, faces, weights, projection, counts

    def _step(self, x, points, normals, areas):
        from scipy.sparse import coo_matrix, identity
        from scipy.sparse.linalg import splu

        _, faces, weights, projection, counts = self._pairs(x, points, normals)
        areas = areas * counts
        i, j = self._ends
        # The residual is a sum of differences, whose rounding is that of the differences, not of positions.
        forces = self._weights[:, None] * (self._turned(x, self._edges) - (x[i] - x[j]))
        sums = [np.bincount(i, column, len(x)) - np.bincount(j, column, len(x)) for column in forces.T]
        residual = np.stack(sums, axis=1).ravel()
        blocks = np.einsum("k,kc,kij,kd->kcidj", areas, weights, projection, weights).reshape(-1, 81)
        order = np.argsort(faces, kind="stable")
        firsts = np.flatnonzero(np.diff(faces[order], prepend=-1))
        of_triangles = np.zeros((len(self._triangles), 81))
        of_triangles[faces[order][firsts]] = np.add.reduceat(blocks[order], firsts, axis=0)
        apart = points - np.einsum("kc,kci->ki", weights, x[self._triangles[faces]])
        pulls = np.einsum("k,kc,kij,kj->kci", areas, weights, projection, apart).reshape(-1, 9)
        residual += np.bincount(self._corners[faces].ravel(), pulls.ravel(), len(residual))
        entries = np.concatenate([self._rigid, of_triangles.ravel()])
        matrix = coo_matrix((entries, self._pattern), shape=(x.size, x.size)).tocsc()[self._free][:, self._free]
        matrix = matrix + _REGULAR * matrix.diagonal().max(initial=0.0) * identity(len(self._free), format="csc")
        options = {"SymmetricMode": True, "DiagPivotThresh": 0.0}
        return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options=options).solve(residual[self._free])

    def _turned(self, x, edges):
        """Returns edges (k, 3) rotated with their cells and triangles as minimises E for x."""
        i, j = self._ends
        moments = self._weights[:, None, None] * np.einsum("ka,kb->kab", x[i] - x[j], edges)
        count = len(x) + len(self._triangles)
        sums = [np.bincount(self._numbers, column, count) for column in moments.reshape(-1, 9).T]
        left, _, right = np.linalg.svd(np.stack(sums, axis=1).reshape(-1, 3, 3))
        left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
        return np.einsum("kab,kb->ka", (left @ right)[self._numbers], edges)


def _normals(x, triangles):
    a, b, c = x[triangles].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    return normal / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]


def _vertex_normals(x, triangles):
    a, b, c = x[triangles].transpose(1, 0, 2)
    normal = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    sums = np.stack([np.bincount(triangles.ravel(), column, len(x)) for column in normal.T], axis=1)
    return sums / np.maximum(np.linalg.norm(sums, axis=1), 1e-300)[:, None]
