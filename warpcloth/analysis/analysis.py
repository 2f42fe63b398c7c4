"""Measures of an animated cloth: deformation, strain, rotation and their rates."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from os import PathLike
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import choice, number
from ..base.types import FilePath, Precision
from ..mesh.mesh import Mesh, same_topology
from ..mesh.sequences import HasPoints, Sequence, as_sequence, open_sequence
from ..model.precision import DTYPES
from ..terms.membrane import Membrane
from .frame_pairs import pairs_of
from .measures import chosen
from .samples import Analysis, Exclusion, Sample
from .surfaces import RATES, Neighbourhoods, Triangles, check_material, material_directions

# The types of frames that `analyze` takes.
Frames = FilePath | Sequence | ArrayLike | HasPoints
_MAX_MESSAGES = 100  # missing frames that get a message each


def analyze(frames: Frames, mesh: Mesh | None = None, dt: float | None = None, **options: Any) -> Analysis:
    """Measures an animation: each vertex if a ``neighbourhood`` is given, else each triangle.

    docs/measuring.md lists the :data:`warpcloth.analysis.measures.MEASURES`. Results of all frames are in memory;
    :class:`Analyzer` gives one at a time.

    Args:
        frames: Points (F, n, 3) [m], an :class:`warpcloth.Animation`, or anything that :func:`warpcloth.open_sequence` opens or
            returns.
        mesh: The mesh at rest; by default that of the file.
        dt: Time between frames [s], for rates; by default that of the file or animation.
        options: Those of :class:`Analyzer`.

    Returns:
        :class:`Analysis`.

    Raises:
        ValueError: As for :class:`Analyzer`, or a frame is broken.

    Examples:
        >>> import warpcloth as wc
        >>> mesh = wc.Mesh.grid(3, 3)
        >>> measured = wc.analyze([mesh.points, 1.5 * mesh.points], mesh, measures=("stretch", "area_ratio"))
        >>> measured["stretch"].shape
        (2, 8, 2)
        >>> round(float(measured["area_ratio"][1, 0]), 6)
        2.25
    """
    analyzer = Analyzer(frames, mesh, dt, **options)
    values = {
        measure.name: np.empty((len(analyzer.pairs), analyzer.count, *measure.shape), analyzer.dtype)
        for measure in analyzer.measures
    }
    references, labels, times, excluded = [], [], [], []
    for sample in analyzer:
        for name, found in sample.values.items():
            values[name][sample.row] = found
        references.append(sample.reference)
        labels.append(sample.frame)
        times.append(sample.time)
        excluded += sample.excluded
    measures = {measure.name: measure for measure in analyzer.measures}
    return Analysis(analyzer.mesh, analyzer.on, measures, references, np.array(labels), np.array(times), excluded, values)


class Analyzer:
    """Measures an animation row by row: ``for sample in Analyzer(frames, mesh): …``.

    A row, a :class:`Sample`, compares a frame with its reference; three frames are in memory.

    Args:
        frames, mesh, dt: As for :func:`analyze`.
        measures: Names of those to compute, or "all" that the other arguments allow.
        reference: "rest", "first", "previous" or the number of a frame.
        pairs: Instead, pairs of reference and frame, such as "1:2,1:3".
        lag: Instead, the number of frames from reference to frame.
        every: Measure every k-th frame.
        neighbourhood: None for triangles; for vertices "1-ring", "2-ring", "nearest:k=12", "nearest:radius=0.05" [m],
            "nearest:2%" of all vertices, or a set of vertices for each, by the rest shape.
        rates: "midpoint", exact for rigid motion; "forward", whose D is wrong by (cos ωΔt − 1)/Δt there; or "logarithm", exact
            for a constant L. Frames must rotate by less than 180°; at θ, midpoint makes a strain 1/cos²(θ/2) times too large,
            logarithm up to θ/sin θ times. The first frame has none.
        directions: Warp and weft: "st" for texture coordinates, or a vector (3,) at rest.
        material: A membrane for energy and stress, such as :class:`warpcloth.NeoHookeanMembrane`.
        device: A Warp device.
        dtype: "float32" or "float64".

    Attributes:
        mesh, sequence: The measured mesh and sequence.
        on, count: "triangle" or "vertex", and their number.
        measures: List of :class:`warpcloth.analysis.measures.Measure`.
        pairs: List of :class:`warpcloth.analysis.frame_pairs.Pair`.

    Raises:
        ValueError: An option is not allowed, a measure needs an option that is not given, or the mesh has no triangles.
    """

    def __init__(
        self,
        frames: Frames,
        mesh: Mesh | None = None,
        dt: float | None = None,
        measures: str | Iterable[str] = ("stretch",),
        reference: str | float | None = None,
        pairs: str | Iterable[tuple[float, float]] | None = None,
        lag: int | None = None,
        every: int = 1,
        neighbourhood: str | Iterable[ArrayLike] | None = None,
        rates: Literal["midpoint", "forward", "logarithm"] = "midpoint",
        directions: str | ArrayLike | None = None,
        material: Membrane | None = None,
        device: str = "cpu",
        dtype: Precision = "float64",
    ) -> None:
        self._given = {name: value for name, value in locals().items() if name != "self"}
        choice("rates", rates, tuple(RATES))
        choice("dtype", dtype, tuple(DTYPES))
        self.sequence = _sequence(mesh, frames, dt)
        self.mesh = self.sequence.mesh if mesh is None else mesh
        if not len(self.mesh.triangles):
            raise ValueError("mesh: is of edges alone, must have triangles, for what is measured is a surface")
        self.on = "triangle" if neighbourhood is None else "vertex"
        self.measures = self._chosen(measures, directions, material)
        self.pairs, self._left_out = pairs_of(self.sequence.labels, reference, pairs, lag, every)
        self.rates, self.dtype = rates, DTYPES[dtype][1]
        self._check_times()
        self._elements: Triangles | Neighbourhoods
        if self.on == "triangle":
            if material is not None:
                check_material(material)
            threads = None if directions is None else material_directions(self.mesh, directions)
            self._elements = Triangles(self.mesh, self.measures, threads, material, device, dtype)
        else:
            for name, value in (("directions", directions), ("material", material)):
                if value is not None:
                    raise ValueError(f"{name}: is for measures of triangles, must be None with a neighbourhood")
            self._elements = Neighbourhoods(self.mesh, self.measures, neighbourhood, device, dtype)
        self.count = self._elements.count
        self._reference = self._without = None  # the reference frame of the elements, and which have no reference there

    def _chosen(self, names, directions, material):
        given = {"directions": directions is not None, "material": material is not None}
        given["rate"] = self.sequence.times is not None
        found = chosen(names, self.on, [need for need, there in given.items() if there])
        advice = {
            "directions": 'directions="st" or a vector',
            "material": "material=NeoHookeanMembrane(stiffness=1e3, poisson_ratio=0.3) or another membrane",
            "rate": "dt, the time between frames [s]",
        }
        for measure in found:
            for need in (measure.needs, "rate" if measure.rate else ""):
                if need and not given[need]:
                    raise ValueError(f"measures: {measure.name!r} needs {advice[need]}")
        return found

    def _check_times(self):
        if any(measure.rate for measure in self.measures):
            times, least = self.sequence.times, np.finfo(self.dtype).tiny
            rule = f"must be from {least:g} to {1.0 / least:g}, of which {np.dtype(self.dtype)} has the reciprocal"
            for pair in self.pairs:
                dt = 1.0 if pair.before is None else abs(times[pair.frame] - times[pair.before])
                if not least <= dt <= 1.0 / least:
                    raise ValueError(f"dt: {dt:g} s to frame {self._label(pair.frame):g}, {rule}")

    def of(self, *measures: str) -> "Analyzer":
        """Returns an analyzer of other measures with its options."""
        return Analyzer(**(self._given | {"frames": self.sequence, "dt": None, "measures": measures}))

    @property
    def areas(self) -> np.ndarray:
        """Rest areas of triangles, or lumped areas of vertices, (E,) [m²]."""
        return self.mesh.triangle_areas if self.on == "triangle" else self.mesh.vertex_areas

    def positions(self, points: np.ndarray) -> np.ndarray:
        """Returns the positions of elements, (E, 3) [m], centroids or vertices, of points (n, 3) [m]."""
        if self.on == "vertex":
            return points
        a, b, c = self.mesh.triangles.T
        return (points[a] + points[b] + points[c]) / 3.0

    def __len__(self) -> int:
        return len(self.pairs)

    def __iter__(self) -> Iterator[Sample]:
        elements, sequence = self._elements, self.sequence
        labels, times = sequence.labels, sequence.times
        excluded = _missing(sequence.missing)
        excluded += [_frame(label, reason) for label, reason in self._left_out]
        rates = ", ".join(measure.name for measure in self.measures if measure.rate)
        held: dict[int | None, _Held] = {}
        seen: set[int | None] = set()
        referred: set[int | None] = set()
        for row, pair in enumerate(self.pairs):
            indices = {pair.reference, pair.frame} | ({pair.before} if pair.before is not None else set())
            held = {index: held[index] if index in held else self._read(index) for index in indices}
            for index in indices - seen:
                vertices = np.flatnonzero(held[index].lost_vertices)
                if len(vertices):
                    excluded.append(Exclusion(self._label(index), "vertex", vertices, "has no finite position"))
            without = self._refer(held[pair.reference])
            if pair.reference not in referred:
                none = np.flatnonzero(without & ~held[pair.reference].lost)
                if len(none):
                    excluded.append(Exclusion(self._label(pair.reference), self.on, none, elements.without))
            seen |= indices
            referred.add(pair.reference)
            elements.measure(held[pair.frame].points)
            if rates and pair.before is None:
                excluded.append(_frame(labels[pair.frame], f"has none before it, and so no {rates}"))
            elif rates:
                elements.start(held[pair.before].points)
                rounding = max(held[index].rounding for index in indices)
                elements.rates(times[pair.frame] - times[pair.before], self.rates, rounding)
            values = elements.read()
            known = without | held[pair.reference].lost | held[pair.frame].lost
            undefined: dict[tuple[str, bytes], tuple[np.ndarray, list[str]]] = {}
            for measure in self.measures:
                lost = self._exclude(measure, pair, values[measure.name], known, held)
                if len(lost):
                    undefined.setdefault((measure.undefined, lost.tobytes()), (lost, []))[1].append(measure.name)
            for (reason, _), (lost, names) in undefined.items():
                reason = f"{reason}, so that {', '.join(names)} cannot be said"
                excluded.append(Exclusion(labels[pair.frame], self.on, lost, reason))
            time = np.nan if times is None else times[pair.frame]
            points = held[pair.frame].points
            yield Sample(row, self._label(pair.reference), labels[pair.frame], pair.frame, time, points, values, excluded)
            excluded = []

    def _refer(self, held):
        if self._reference is not held:
            self._without, self._reference = self._elements.refer(held.points, held.rounding), held
        return self._without

    def _exclude(self, measure, pair, values, known, held):
        """Sets elements that could not be measured to NaN; returns those not ``known`` yet."""
        if measure.rate:
            if pair.before is None:
                values[:] = np.nan
                return ()
            known = known | held[pair.before].lost
        lost = known | ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
        values[lost] = np.nan
        return np.flatnonzero(lost & ~known)

    def _read(self, index):
        points = self.mesh.points.view() if index is None else self.sequence[index]
        points.flags.writeable = False  # samples share it with the frames that follow
        lost = ~np.isfinite(points).all(axis=1)
        # The rounding of the input and that of the computation, which is relative to one of the points.
        rounding, found = self.sequence.rounding(points), points[~lost]
        if len(found):
            rounding += np.finfo(self.dtype).eps * np.ptp(found, axis=0).max()
        return _Held(points, rounding, lost, self._elements.touched(lost) if lost.any() else np.zeros(self.count, dtype=bool))

    def _label(self, index):
        return None if index is None else self.sequence.labels[index]


@dataclass(frozen=True, eq=False)
class _Held:
    """Points of a frame, rounding [m], infinite ones (n,), and elements that have these (E,)."""

    points: np.ndarray
    rounding: float
    lost_vertices: np.ndarray
    lost: np.ndarray


def _missing(labels):
    if len(labels) <= _MAX_MESSAGES:
        return [_frame(label, "is missing") for label in labels]
    return [_frame(labels[0], f"is missing, and so are {len(labels) - 1} more, the last of them {labels[-1]:g}")]


def _frame(label, reason):
    return Exclusion(label, "frame", np.empty(0, dtype=int), reason)


def _sequence(mesh, frames, dt):
    if isinstance(frames, (str, PathLike)):
        if dt is not None:
            number("dt", dt, above=0.0)
        frames = open_sequence(frames, fps=None if dt is None else 1.0 / dt, mesh=mesh)
    elif not isinstance(frames, Sequence):
        return as_sequence(mesh, frames, dt)
    elif dt is not None:
        raise ValueError("dt: is for arrays and files, must be None with a sequence, which has times or was opened without")
    if mesh is not None and not same_topology(mesh, frames.mesh):
        raise ValueError(
            f"mesh: {len(mesh.points)} vertices and {len(mesh.triangles)} triangles, must be those of the frames, "
            f"{len(frames.mesh.points)} and {len(frames.mesh.triangles)}, in their order"
        )
    return frames
