"""The pattern of a sparse matrix of blocks, a sum of element matrices or a product, found on the device of a model."""

from typing import NamedTuple

import numpy as np
import warp as wp

from ..kernels import block_pattern as kernels
from ..model.elements import incidences_of

# Made together, because a module that gets another kernel is loaded again.
_KERNELS = (
    *(kernels.add_diagonal, kernels.add_columns, kernels.pack_columns, kernels.list_blocks),
    *(kernels.add_product_columns, kernels.set_slots),
)


class BlockPattern(NamedTuple):
    """The pattern of one copy with n vertices, or of all copies, arrays of int32 on the device.

    Attributes:
        offsets, columns: Block rows (n+1,) and the column of each block, ascending in a row.
        rows: The row of each block.
        diagonal: Index of each diagonal block (n,).
        sums: For each term, (offsets, sources): block s of the matrix is the sum of the blocks of the term from
            sources[offsets[s]] to sources[offsets[s+1] − 1], which ascend.
    """

    offsets: wp.array
    columns: wp.array
    rows: wp.array
    diagonal: wp.array
    sums: list

    def of_copies(self, model, blocks):
        """Returns the pattern of all copies of a model from that of one; ``blocks`` has the number of blocks of each term."""
        if model.copies == 1:
            return self
        n, count = len(self.diagonal), len(self.columns)

        def offsets(array, step):
            return model.of_copies(array[1:], step, start=0)

        return BlockPattern(
            offsets(self.offsets, count),
            *(model.of_copies(array, step) for array, step in ((self.columns, n), (self.rows, n), (self.diagonal, count))),
            [(offsets(one, len(s)), model.of_copies(s, each)) for (one, s), each in zip(self.sums, blocks, strict=True)],
        )


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
        self._arrays = {name: to_device(model, values) for name, values in given.items()}  # structs hold no references
        self.data = kernels.Corners()
        self.data.K = K
        for name, array in self._arrays.items():
            setattr(self.data, name, array)


def find_pattern(model, terms, fixed):
    """Returns the :class:`BlockPattern` of the first copy of a model.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        terms: The :class:`TermCorners` of each term.
        fixed: Vertices whose rows and columns have no blocks but on the diagonal, (n,) booleans.
    """
    n, device = model.per_copy, model.device

    def empty(count):
        return wp.empty(count, dtype=wp.int32, device=device)

    launch = model.launcher((_KERNELS,))
    fixed, starts = to_device(model, fixed), _before(sum((term.most for term in terms), start=np.ones(n, dtype=np.int64)))
    firsts, found = to_device(model, starts[:-1]), empty(int(starts[-1]))
    counts, of_terms = empty(n), [empty(n) for _ in terms]
    launch(kernels.add_diagonal, n, [firsts], [found, counts])
    for term, of_term in zip(terms, of_terms, strict=True):
        launch(kernels.add_columns, n, [fixed, term.data, firsts], [found, counts, of_term])
    starts = _before(counts.numpy())
    count = int(starts[-1])
    offsets, columns, rows, diagonal = to_device(model, starts), empty(count), empty(count), empty(n)
    launch(kernels.pack_columns, n, [firsts, offsets, found], [columns, rows, diagonal])
    sums = []
    for term, of_term in zip(terms, of_terms, strict=True):
        starts = _before(of_term.numpy())
        ends, sources = empty(count + 1), empty(int(starts[-1]))
        ends[:1].zero_()
        given = [fixed, term.data, offsets, columns, to_device(model, starts[:-1])]
        launch(kernels.list_blocks, n, given, [ends[1:], sources])
        sums.append((ends, sources))
    return BlockPattern(offsets, columns, rows, diagonal, sums)


def pattern_of_product(model, left, right):
    """Returns the pattern of a product of sparse matrices, of one copy, as :class:`BlockPattern` without sums.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        left: (offsets, columns) of the rows of the left matrix, on the device.
        right: Those of the right one.
    """
    host = [array.numpy() for array in (*left, right[0])]
    most = np.append(0, np.cumsum(np.diff(host[2])[host[1]]))[host[0]]
    n, firsts = len(most) - 1, to_device(model, most[:-1])
    found, counts = (wp.empty(int(size), dtype=wp.int32, device=model.device) for size in (most[-1], n))
    launch = model.launcher((_KERNELS,))
    launch(kernels.add_product_columns, n, [*left, *right, firsts], [found, counts])
    starts = _before(counts.numpy())
    offsets = to_device(model, starts)
    columns, rows, diagonal = (wp.empty(int(size), dtype=wp.int32, device=model.device) for size in (starts[-1], starts[-1], n))
    launch(kernels.pack_columns, n, [firsts, offsets, found], [columns, rows, diagonal])
    return BlockPattern(offsets, columns, rows, diagonal, [])


def dense_pattern(model, n):
    """Returns the :class:`BlockPattern` of n rows with all blocks."""
    every = np.arange(n)
    arrays = np.arange(n + 1) * n, np.tile(every, n), np.repeat(every, n), every * (n + 1)
    offsets, columns, rows, diagonal = (to_device(model, values) for values in arrays)
    return BlockPattern(offsets, columns, rows, diagonal, [])


def slots_of(model, sums, count):
    """Returns the index of the block of the matrix to which each of the ``count`` blocks of a term is added, or −1.

    ``sums`` are those of the term, see :class:`BlockPattern`.
    """
    offsets, sources = sums
    slots = wp.full(count, -1, dtype=wp.int32, device=model.device)
    model.launcher((_KERNELS,))(kernels.set_slots, len(offsets) - 1, [offsets, sources], [slots])
    return slots


def to_device(model, values):
    """Returns indices as an array of int32 on the device of a model."""
    return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=wp.int32, device=model.device)


def _before(counts):
    """Returns the sums of the counts (n,) before each, and of all, (n+1,)."""
    return np.append(0, np.cumsum(counts))
