"""The results of an analysis: rows of measures, and the elements and frames that were left out."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from ..base.renamed import renamed
from ..mesh.mesh import Mesh
from .measures import Measure

_SHOWN = 8  # elements that a sentence names


@dataclass(frozen=True, eq=False)
class Exclusion:
    """Elements or a frame that could not be measured.

    Attributes:
        frame: Number of the frame; None for the rest shape.
        kind: "triangle", "vertex" or "frame", of which there are no elements.
        elements: Indices (k,).
        reason: Why, as the end of a sentence.
    """

    frame: float | None
    kind: str
    elements: np.ndarray
    reason: str

    def __str__(self) -> str:
        where = "rest shape" if self.frame is None else f"frame {self.frame:g}"
        if self.kind == "frame":
            return f"{where} {self.reason}"
        named = ", ".join(map(str, self.elements[:_SHOWN].tolist())) + (", …" if len(self.elements) > _SHOWN else "")
        kind = {"triangle": ("triangle", "triangles"), "vertex": ("vertex", "vertices")}[self.kind][len(self.elements) > 1]
        count = f"{len(self.elements)} " if len(self.elements) > 1 else ""
        return f"{where}, {count}{kind} {named}: {self.reason}"


@renamed(place="index")
@dataclass(frozen=True, eq=False)
class Sample:
    """One row of an analysis: a frame measured against its reference.

    Attributes:
        row: Its index among the rows.
        reference: Number of the reference frame; None for the rest shape.
        frame: Number of the frame.
        index: Index of the frame in its sequence.
        time: Of the frame [s]; NaN where the sequence has no times.
        points: (n, 3) [m], read-only.
        values: Arrays (E, *shape) by name of measure, NaN in what is excluded; the analyzer's next sample overwrites them.
        excluded: List of :class:`Exclusion` that this row is the first to meet.
    """

    row: int
    reference: float | None
    frame: float
    index: int
    time: float
    points: np.ndarray
    values: dict[str, np.ndarray]
    excluded: list[Exclusion]


@dataclass(frozen=True, eq=False)
class Analysis(Mapping[str, np.ndarray]):
    """Measures of all rows, arrays (rows, E, *shape) by name: ``analysis["stretch"]``.

    Attributes:
        mesh: The mesh, E of whose triangles or vertices were measured.
        on: "triangle" or "vertex".
        measures: What each is, :class:`warpcloth.analysis.measures.Measure` by name.
        references: Number of each row's reference frame; None for the rest shape.
        frames: Numbers of the frames (rows,).
        times: Of the frames (rows,) [s].
        excluded: What could not be measured, list of :class:`Exclusion`; the values there are NaN.
        arrays: The arrays.
    """

    mesh: Mesh
    on: str
    measures: dict[str, Measure]
    references: list[float | None]
    frames: np.ndarray
    times: np.ndarray
    excluded: list[Exclusion]
    arrays: dict[str, np.ndarray] = field(repr=False)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.arrays)

    def __len__(self) -> int:
        return len(self.arrays)

    @property
    def pairs(self) -> list[tuple[float | str, float]]:
        """(reference, frame) of each row, "rest" for the rest shape."""
        return [("rest" if start is None else start, frame) for start, frame in zip(self.references, self.frames, strict=True)]
