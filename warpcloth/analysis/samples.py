"""The results of an analysis: rows of measures, and excluded elements and frames."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from ..mesh.mesh import Mesh
from .measures import Measure

_SHOWN = 8  # elements that a message names


@dataclass(frozen=True, eq=False)
class Exclusion:
    """Elements or a frame that could not be measured.

    Attributes:
        frame: Frame number, or None for the rest shape.
        kind: "triangle", "vertex", or "frame" without elements.
        elements: Indices (k,).
        reason: The end of a sentence.
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


@dataclass(frozen=True, eq=False)
class Sample:
    """One row of an analysis: a frame measured against its reference.

    Attributes:
        row: Index of the row.
        reference: Reference frame, or None for the rest shape.
        frame: Frame number.
        index: Its index in the sequence.
        time: Its time [s], or NaN.
        points: (n, 3) [m], read-only.
        values: Arrays (E, *shape) by measure, NaN where excluded, overwritten by the next sample.
        excluded: :class:`Exclusion` that occur first here.
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
    """Measures of all rows, arrays (rows, E, …) by name: ``analysis["stretch"]``.

    Attributes:
        mesh: The mesh, with E triangles or vertices.
        on: "triangle" or "vertex".
        measures: :class:`warpcloth.analysis.measures.Measure` by name.
        references: Reference frame of each row, or None for the rest shape.
        frames: Frame numbers (rows,).
        times: (rows,) [s].
        excluded: List of :class:`Exclusion`, whose values are NaN.
        arrays: The arrays by name.
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
