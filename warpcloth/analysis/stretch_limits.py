"""Limits of stretch, and elements that exceed them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..mesh.mesh import Mesh
from ..terms.limit import Limit

# Tolerance of lengths, in units of the rounding of a coordinate.
_ROUNDINGS = 4.0


@dataclass(frozen=True, eq=False)
class StretchLimit:
    """Bounds of stretches: l/L of pairs, or the singular values of F of triangles.

    Attributes:
        name: Name of the limit.
        stencil: Vertices of each element, (E, 2) or (E, 3).
        rest: Rest positions of all vertices (n, 3) [m].
        least, most: Bounds (E,); 0 and infinity are none.
    """

    name: str
    stencil: np.ndarray
    rest: np.ndarray
    least: np.ndarray
    most: np.ndarray

    @cached_property
    def _sides(self):
        """Rest length of the first side of each element; for triangles also the second side along and across it, (E,) [m]."""
        first, *others = self._edges(self.rest)
        with np.errstate(all="ignore"):
            length = np.linalg.norm(first, axis=1)
            along = [np.einsum("ei,ei->e", first, each) / length for each in others]
            across = [np.linalg.norm(np.cross(first, each), axis=1) / length for each in others]
        return length, *along, *across

    def _edges(self, points):
        return [points[vertices] - points[self.stencil[:, 0]] for vertices in self.stencil.T[1:]]

    def stretches(self, points: np.ndarray) -> np.ndarray:
        """Returns the smallest and largest stretch at points (n, 3) [m], (E, 2), or NaN."""
        length, *others = self._sides
        first, *second = self._edges(points)
        with np.errstate(all="ignore"):
            first = first / length[:, None]
            if not others:
                return np.linalg.norm(first, axis=1)[:, None].repeat(2, axis=1)
            (along, across) = others
            second = (second[0] - along[:, None] * first) / across[:, None]  # these two are the columns of F
            c, d, e = (np.einsum("ei,ei->e", *pair) for pair in ((first, first), (second, second), (first, second)))
            middle, apart = 0.5 * (c + d), np.hypot(0.5 * (c - d), e)
            return np.sqrt(np.maximum(np.stack([middle - apart, middle + apart], axis=1), 0.0))

    def exceeded(self, points: np.ndarray, rounding: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns elements beyond the limit by more than ``rounding`` [m], and their stretches, (k,) each."""
        low, high = self.stretches(points).T
        length, *others = self._sides
        with np.errstate(all="ignore"):
            size = length
            if others:  # the smallest length is the height on the longest side
                x, y = others
                size = length * y / np.maximum(length, np.maximum(np.hypot(x, y), np.hypot(x - length, y)))
            allowed = _ROUNDINGS * rounding / size
            over, under = high > self.most + allowed, low < self.least - allowed
        found = np.flatnonzero(over | under)
        return found, np.where(over, high, low)[found]


def edge_limit(mesh: Mesh, most: float) -> StretchLimit:
    """Returns the limit l/L ≤ ``most`` of all edges."""
    count = len(mesh.edges)
    return StretchLimit("edges", mesh.edges, mesh.points, np.zeros(count), np.full(count, float(most)))


def declared_limits(terms: list[Limit], mesh: Mesh, first: int = 0, where: str = "") -> list[StretchLimit]:
    """Returns the limits that terms declare on a mesh whose first vertex is ``first``, named ``where`` or ""."""
    found = []
    for term in terms:
        stencil = term.elements(mesh, mesh.points).stencil
        bounds = [
            np.broadcast_to(empty if given is None else term.of_elements(name, len(stencil)), len(stencil))
            for name, given, empty in (("least", term.least, 0.0), ("most", term.most, np.inf))
        ]
        points = np.concatenate([np.full((first, 3), np.nan), mesh.points])
        found.append(StretchLimit(" of ".join(filter(None, (term.label, where))), stencil + first, points, *bounds))
    return found
