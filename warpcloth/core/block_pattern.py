"""The pattern of a sparse matrix of blocks, a sum of element matrices, found on the device of a model."""

from typing import NamedTuple

import numpy as np
import warp as wp

from ..kernels import block_pattern as kernels
from ..model.elements import incidences_of


class BlockPattern(NamedTuple):
    """The pattern of all copies, all arrays int32 on the device.

    Attributes:
        offsets, columns: Block rows (N+1,) and the column of each block, ascending in a row.
        rows: The row of each block.
        diagonal: Index of each diagonal block (N,).
        sums: For each term, (offsets, sources): block s of the matrix is the sum of the blocks of the term from
            sources[offsets[s]] to sources[offsets[s+1] − 1], which ascend.
    """

    offsets: wp.array
    columns: wp.array
    rows: wp.array
    diagonal: wp.array
    sums: list


class TermCorners:
    """The vertices of the elements of one term in the first copy, see :mod:`warpcloth.kernels.block_pattern`.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        vertices: Vertices of all elements, in one row.
        K: Number of vertices of an element; 0 for cells.
        sizes: Number of vertices of each cell; None without cells.

    Attributes:
        data: The :class:`warpcloth.kernels.block_pattern.Corners`.
        most: How many blocks each vertex has in its row, pinned or not, (n,).
    """

    def __init__(self, model, vertices, K=0, sizes=None):
        offsets, codes = incidences_of(vertices, model.per_copy)
        given = {"vertices": vertices, "offsets": offsets, "codes": codes}
        self.most = K * np.diff(offsets)
        if sizes is not None:
            of_corners = np.repeat(sizes, sizes)
            starts, firsts = np.cumsum(of_corners) - of_corners, np.repeat(np.cumsum(sizes) - sizes, sizes)
            given |= {"firsts": firsts, "sizes": of_corners, "starts": starts}
            self.most = np.bincount(vertices, weights=of_corners, minlength=model.per_copy).astype(np.int64)
        self._arrays = {name: _put(model, values) for name, values in given.items()}  # structs hold no references
        self.data = kernels.Corners()
        self.data.K = K
        for name, array in self._arrays.items():
            setattr(self.data, name, array)


def find_pattern(model, terms, blocks):
    """Returns the :class:`BlockPattern` of a model.

    Rows and columns of pinned vertices have no blocks but on the diagonal. Copies have the same pattern: that of the first is
    found, and repeated.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        terms: The :class:`TermCorners` of each term.
        blocks: The number of blocks of each term in one copy.
    """
    n, device = model.per_copy, model.device

    def empty(count):
        return wp.empty(count, dtype=wp.int32, device=device)

    launch = model.launcher(((kernels.add_diagonal, kernels.add_columns, kernels.pack_columns, kernels.list_blocks),))
    fixed = _put(model, model.inverse_mass[:n].numpy() == 0.0)
    starts = _before(1 + sum(term.most for term in terms))
    firsts, found = _put(model, starts[:-1]), empty(int(starts[-1]))
    counts, of_terms = empty(n), [empty(n) for _ in terms]
    launch(kernels.add_diagonal, n, [firsts], [found, counts])
    for term, of_term in zip(terms, of_terms, strict=True):
        launch(kernels.add_columns, n, [fixed, term.data, firsts], [found, counts, of_term])
    starts = _before(counts.numpy())
    count = int(starts[-1])
    offsets, columns, rows, diagonal = _put(model, starts), empty(count), empty(count), empty(n)
    launch(kernels.pack_columns, n, [firsts, offsets, found], [columns, rows, diagonal])
    sums = []
    for term, of_term, each in zip(terms, of_terms, blocks, strict=True):
        starts = _before(of_term.numpy())
        ends, sources = empty(count), empty(int(starts[-1]))
        launch(kernels.list_blocks, n, [fixed, term.data, offsets, columns, _put(model, starts[:-1])], [ends, sources])
        sums.append((model.of_copies(ends, len(sources), start=0), model.of_copies(sources, each)))
    return BlockPattern(
        model.of_copies(offsets[1:], count, start=0),
        *(model.of_copies(columns, n), model.of_copies(rows, n), model.of_copies(diagonal, count)),
        sums,
    )


def _put(model, values):
    return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=wp.int32, device=model.device)


def _before(counts):
    """Returns the sums of the counts (n,) before each, and of all, (n+1,)."""
    return np.append(0, np.cumsum(counts))
