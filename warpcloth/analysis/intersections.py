"""Finds intersections in an animation, exactly, vertices in colliders, and exceeded limits of stretch."""

from collections.abc import Iterable, Iterator
from collections.abc import Sequence as Several
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import number, whole
from ..base.texts import numbered
from ..base.types import FilePath, Progress
from ..mesh.mesh import Mesh
from ..mesh.sequences import HasPoints, Sequence
from ..scene.colliders import Collider, checked_colliders
from .cloths import Cloths, cloths_of
from .crossings import Crossings, have_area
from .samples import Exclusion
from .stretch_limits import edge_limit

# Beyond these coordinates [m], determinants overflow.
_FARTHEST = 1e90


@dataclass(frozen=True, eq=False)
class FrameCheck:
    """The result for one frame.

    Attributes:
        index: Index of the frame in the source.
        frame: Its number in the source.
        time: Its time [s], or NaN.
        pairs: Triangles that intersect (P, 2), the smaller index first.
        inside: Vertices (k,) in colliders, by name.
        exceeded: Elements (k,) beyond a limit of stretch and their stretches (k,), by its name.
        excluded: List of :class:`warpcloth.analysis.samples.Exclusion`.
    """

    index: int
    frame: float
    time: float
    pairs: np.ndarray
    inside: dict[str, np.ndarray]
    exceeded: dict[str, tuple[np.ndarray, np.ndarray]]
    excluded: list[Exclusion]

    @property
    def clean(self) -> bool:
        """Whether all elements could be judged and nothing was found."""
        return not (len(self.pairs) or self.inside or self.exceeded or self.excluded)

    @property
    def vertices_inside(self) -> int:
        """Number of vertices in colliders, once for each."""
        return sum(map(len, self.inside.values()))


@dataclass(frozen=True, eq=False)
class Intersections:
    """The result of :func:`intersections`.

    Attributes:
        cloths: The :class:`warpcloth.analysis.cloths.Cloths`.
        frames: List of :class:`FrameCheck`.
    """

    cloths: Cloths
    frames: list[FrameCheck]

    @property
    def clean(self) -> bool:
        """Whether all frames are clean."""
        return all(each.clean for each in self.frames)

    @property
    def counts(self) -> np.ndarray:
        """Numbers of pairs that intersect (F,)."""
        return np.array([len(each.pairs) for each in self.frames])

    @property
    def pairs(self) -> list[np.ndarray]:
        """The pairs of triangles (P, 2) of each frame."""
        return [each.pairs for each in self.frames]


def intersections(
    frames: FilePath | Sequence | ArrayLike | HasPoints,
    mesh: Mesh | ArrayLike | None = None,
    *,
    prim: str | Iterable[str] | None = None,
    fps: float | None = None,
    colliders: Several[Collider] | None = None,
    stretch: float | None = None,
    every: int = 1,
    progress: Progress | None = None,
) -> Intersections:
    """Finds triangles that intersect in each frame of one or several cloths, by exact predicates, vertices in colliders, and
    exceeded limits of stretch.

    Triangles intersect if they touch, or, with a common vertex or edge, if they have more in common. Boundary vertices at one
    position in all frames count as one, as in sewn panels.

    Args:
        frames: Points (n, 3) or (F, n, 3) [m]; an :class:`warpcloth.Animation`, or a :class:`warpcloth.Scene` at its start,
            with colliders and limits; a :class:`warpcloth.Mesh` or :class:`warpcloth.Sequence`; or a path to a mesh, a sequence
            or a stage. In a stage of warpcloth, the cloth is checked; in others all meshes whose points move, else all meshes,
            but no colliders.
        mesh: The rest shape, or triangles (T, 3), if the frames have none.
        prim: Meshes of a stage to check, or the geometry of other files.
        fps: Frames per second, instead of that of the source.
        colliders: Colliders in place of those of the source; meshes must be closed.
        stretch: Maximum l/L of edges, beside the limits of the source.
        every: Check every k-th frame.
        progress: Function called with (frames checked, frames), or None.

    Returns:
        :class:`Intersections`.

    Raises:
        FileNotFoundError: There is no such file.
        ImportError: libigl is not installed.
        ValueError: An argument is not allowed, or the source cannot be read.

    Examples:
        >>> import warpcloth as wc
        >>> points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, -1], [0.2, 0.2, 1], [0.9, 0.9, 1]]
        >>> wc.intersections(points, [[0, 1, 2], [3, 4, 5]]).pairs[0].tolist()
        [[0, 1]]
    """
    checker = Checker(cloths_of(frames, mesh, prim, fps), colliders, stretch, every)
    found = []
    for each in checker:
        found.append(each)
        if progress is not None:
            progress(len(found), len(checker))
    return Intersections(checker.cloths, found)


class Checker:
    """Checks frames of :func:`intersections` in constant memory.

    Args:
        cloths, colliders, stretch, every: As there.

    Attributes:
        indices: Indices of the checked frames.
        limits: The :class:`warpcloth.analysis.stretch_limits.StretchLimit` of each limit.
        colliders: The colliders by name.
        sewn: Number of vertices merged with others.
    """

    def __init__(
        self, cloths: Cloths, colliders: Several[Collider] | None = None, stretch: float | None = None, every: int = 1
    ) -> None:
        whole("every", every, 1)
        if stretch is not None:
            number("stretch", stretch, above=0.0)
        self.cloths, self.indices = cloths, range(0, len(cloths.labels), every)
        self.limits = [*cloths.limits, *([] if stretch is None else [edge_limit(cloths.mesh, stretch)])]
        colliders = cloths.colliders if colliders is None else checked_colliders(colliders)
        self.colliders = dict(zip(numbered(each.label for each in colliders), colliders, strict=True))
        self._crossings = Crossings(self._index[cloths.mesh.triangles])

    @property
    def sewn(self) -> int:
        return len(self._index) - len(np.unique(self._index))

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[FrameCheck]:
        cloths = self.cloths
        waiting = [Exclusion(label, "frame", np.empty(0, int), "is missing") for label in cloths.missing]
        for index in self.indices:
            points, frame = cloths.read(index), cloths.labels[index].item()
            known = (np.abs(points) < _FARTHEST).all(axis=1)
            if not known.all():
                reason = f"has no position that is finite, and below {_FARTHEST:g} m"
                waiting.append(Exclusion(frame, "vertex", np.flatnonzero(~known), reason))
            triangles = cloths.mesh.triangles
            placed = np.where(known[:, None], points, 0.0)
            whole_ones = known[triangles].all(axis=1)
            judged = whole_ones & have_area(placed, triangles)
            flat = np.flatnonzero(whole_ones & ~judged)
            if len(flat):
                waiting.append(Exclusion(frame, "triangle", flat, "has no area"))
            found = FrameCheck(
                index,
                frame,
                float("nan") if cloths.times is None else float(cloths.times[index]),
                self._crossings.pairs(placed, judged),
                self._inside(placed, known, index),
                self._exceeded(points),
                waiting,
            )
            waiting = []
            yield found

    def _inside(self, points, known, index):
        found = {}
        for name, collider in self.colliders.items():
            vertices = np.flatnonzero(known & (collider.distances(points, index) < 0.0))
            found |= {name: vertices} if len(vertices) else {}
        return found

    def _exceeded(self, points):
        found, finite = {}, points[np.isfinite(points).all(axis=1)]
        rounding = np.finfo(self.cloths.precision).eps * np.abs(finite).max(initial=0.0)
        for limit in self.limits:
            elements, stretches = limit.exceeded(points, rounding)
            found |= {limit.name: (elements, stretches)} if len(elements) else {}
        return found

    @cached_property
    def _index(self):
        """The first boundary vertex at the position of each boundary vertex in all frames, (n,).

        Vertices not finite in a frame with finite points are not merged.
        """
        cloths = self.cloths
        found, own, together = np.arange(len(cloths.mesh.points)), cloths.mesh.boundary, None
        for index in range(len(cloths.labels)):
            if not len(own):
                break
            points = cloths.read(index)[own]
            finite = np.isfinite(points).all(axis=1)
            if not finite.any():
                continue
            rows = points if together is None else np.column_stack([together, points])
            own = own[finite]
            _, together, counts = np.unique(rows[finite], axis=0, return_inverse=True, return_counts=True)
            several = counts[together.ravel()] > 1
            own, together = own[several], together.ravel()[several]
        if together is not None and len(own):
            _, first, group = np.unique(together, return_index=True, return_inverse=True)
            found[own] = own[first[group.ravel()]]
        return found
