"""Cells, which have any number of vertices, in compressed rows (CSR)."""

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from ..kernels.term import Term
from .host_values import host_values, keep, part, reordered

_PINNED = 1e3  # mass of a pinned vertex in the fit, relative to the rest of its cell, so that the cell moves to the vertex


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of rigid clusters: elements offsets[c] to offsets[c+1] − 1 are the vertices of cell c.

    Attributes:
        offsets: (B·C + 1,) int32.
        per_copy: Number of cells of one copy, C.
        shape: Rest position of each element about the centre of mass of its cell, (B·E,) vectors [m].
    """

    offsets: wp.array
    per_copy: int
    shape: wp.array

    weights = None

    @property
    def arrays(self):
        """All arrays."""
        return [self.offsets, self.shape]

    @property
    def count(self):
        """Cells of all copies, B·C."""
        return len(self.offsets) - 1

    def part(self, first, count, elements):
        """The cells of ``count`` of the copies from ``first`` on, whose elements are those of the slice ``elements``."""
        return replace(self, offsets=part(self.offsets, slice(count * self.per_copy + 1)), shape=part(self.shape, elements))

    def reordered(self, order):
        """The cells with those of index ``order`` in that order, and that of their elements."""
        offsets, of_elements = _reordered(self, order)
        return replace(self, offsets=offsets, shape=reordered(self.shape, of_elements)), of_elements

    @property
    def sizes(self):
        """Elements of each cell, (B·C,)."""
        return np.diff(host_values(self.offsets))


@dataclass(frozen=True, eq=False)
class SparseCells:
    """Cells of a sparse energy, each vertex of a cell an element by itself, see :mod:`..kernels.sparse`.

    Attributes:
        term: The energy of a cell.
        offsets: (B·C + 1,) int32.
        per_copy: Number of cells of one copy, C.
        weights: (B·E,) vectors of M.
        rest: Rest state of each cell, (B·C,) vectors of P.
    """

    term: Term
    offsets: wp.array
    per_copy: int
    weights: wp.array
    rest: wp.array

    @property
    def arrays(self):
        """All arrays."""
        return [self.offsets, self.weights, self.rest]

    @property
    def count(self):
        """Cells of all copies, B·C."""
        return len(self.offsets) - 1

    def part(self, first, count, elements):
        """The cells of ``count`` of the copies from ``first`` on, whose elements are those of the slice ``elements``."""
        C = self.per_copy
        rest = part(self.rest, slice(first * C, (first + count) * C))
        return replace(self, offsets=part(self.offsets, slice(count * C + 1)), weights=part(self.weights, elements), rest=rest)

    def reordered(self, order):
        """The cells with those of index ``order`` in that order, and that of their elements."""
        offsets, of_elements = _reordered(self, order)
        rest, weights = reordered(self.rest, order), reordered(self.weights, of_elements)
        return replace(self, offsets=offsets, rest=rest, weights=weights), of_elements

    @property
    def sizes(self):
        """Elements of each cell, (B·C,)."""
        return np.diff(host_values(self.offsets))

    def blocks(self):
        """Returns the first of the n² blocks of each cell of n vertices, (B·C,) int32 on the device, and their total number."""
        ends = np.cumsum(self.sizes.astype(np.int64) ** 2)
        starts = np.append(0, ends[:-1]).astype(np.int32)
        return wp.array(starts, dtype=wp.int32, device=self.offsets.device), int(ends[-1])

    def pairs(self, elements):
        """Returns the row and the column of each of these blocks; ``elements`` are those of the cells."""
        vertices = np.split(host_values(elements.stencil)[:, 0].astype(np.int64), host_values(self.offsets)[1:-1])
        rows = [np.repeat(cell, len(cell)) for cell in vertices]
        return np.concatenate(rows), np.concatenate([np.tile(cell, len(cell)) for cell in vertices])


def _reordered(cells, order):
    """Returns the offsets of cells in another ``order``, and the order of their elements."""
    firsts, sizes = host_values(cells.offsets)[order], cells.sizes[order]
    ends = np.cumsum(sizes)
    of_elements = np.arange(ends[-1]) + np.repeat(firsts - (ends - sizes), sizes)
    return keep(np.append(0, ends).astype(np.int32), wp.int32, cells.offsets.device), of_elements


def rigid_cells(model, elements):
    """Returns :class:`Cells` of :class:`warpcloth.terms.declared.Elements`, and rest states with the masses, (B, E, P)."""
    vertices, firsts = elements.stencil[:, 0], elements.cells[:-1]
    sizes = np.diff(elements.cells)
    shape = (model.copies, model.per_copy)
    mass, inverse = (array.numpy().astype(np.float64).reshape(shape) for array in (model.mass, model.inverse_mass))
    indices = model.in_model(vertices)
    weight = np.where(inverse > 0.0, mass, 0.0)[:, indices]
    body = np.repeat(np.add.reduceat(weight, firsts, axis=1), sizes, axis=1)
    weight = np.where(inverse[:, indices] > 0.0, weight, np.where(body > 0.0, _PINNED * body, 1.0))
    points = np.broadcast_to(model.scene.mesh.points[vertices], (model.copies, len(vertices), 3))
    points = points - np.repeat(points[:, firsts], sizes, axis=1)
    total = np.add.reduceat(weight, firsts, axis=1)
    centre = np.add.reduceat(weight[..., None] * points, firsts, axis=1) / total[..., None]
    cells = Cells(
        _offsets(model, elements),
        len(sizes),
        model.keep(f"{elements.label}: shape", "m", points - np.repeat(centre, sizes, axis=1), model.vec3, "element"),
    )
    rest = np.zeros((*weight.shape, elements.term.parameters))
    rest[..., -1] = weight
    return cells, rest


def sparse_cells(model, elements, rest):
    """Returns :class:`SparseCells` with rest states (B, C, P), and zero rest states of their elements, (B, E, 4)."""
    (E, M), P = elements.weights.shape[-2:], elements.term.parameters
    weights = np.broadcast_to(elements.weights, (model.copies, E, M))
    cells = SparseCells(
        elements.term,
        _offsets(model, elements),
        len(elements.cells) - 1,
        model.keep(f"{elements.label}: weight", "", weights, wp.types.vector(M, model.dtype), "element"),
        model.keep(f"{elements.label}: rest state", "", rest, wp.types.vector(P, model.dtype), "cell"),
    )
    return cells, np.zeros((model.copies, E, 4))


def _offsets(model, elements):
    """Returns the offsets of the cells of all copies, (B·C + 1,) int32."""
    E = elements.cells[-1]
    offsets = np.append((elements.cells[:-1] + np.arange(model.copies)[:, None] * E).ravel(), model.copies * E)
    return keep(offsets.astype(np.int32), wp.int32, model.device)
