"""Quadratic energies as pairs of vertices, from the entries of their assembled matrix Q = kAGᵀG."""

from dataclasses import replace

import numpy as np
import warp as wp

from ..core.constant_matrix import constant_entries
from ..kernels.assemble import constant_blocks
from ..kernels.fast.quadratic_pair import QUADRATIC_PAIR
from ..model.host_values import host_values

CHUNK = 1 << 18  # number of elements whose blocks are summed at once
# Pairs are faster up to this number per element: a hinge takes 5 to 6 ns, a pair of vertices 1.2 ns (one core).
PAIRS = 4
# Weights up to this fraction of the largest one of an element count as 0, such as cotangents that cancel in double precision.
ZERO = 1e-12


def matrix_entries(model, elements):
    """The off-diagonal entries of Q, row by row; if the elements of a copy share one stiffness, without entries that cancel.

    Returns:
        (rows (m,), columns (m,), numbers (B, m) [N/m]) for the vertices of one copy.
    """
    from scipy.sparse import coo_matrix

    K, n = elements.term.vertices, model.per_copy
    stencil = host_values(elements.stencil)

    def off_diagonal(some):
        """Rows and columns of the off-diagonal entries, and a mask of these in the blocks."""
        rows, columns = np.repeat(some, K, axis=1), np.tile(some, K)
        apart = rows != columns
        return rows[apart], columns[apart], apart

    # Colours put elements of all copies in one order; all vertices of an element are in one copy.
    rows, columns, _apart = off_diagonal(stencil[stencil[:, 0] < n])
    pattern = coo_matrix((np.ones(len(rows), dtype=bool), (rows, columns)), shape=(n, n)).tocsr()
    rows, columns = np.repeat(np.arange(n, dtype=np.int64), np.diff(pattern.indptr)), pattern.indices.astype(np.int64)
    keys = rows * n + columns
    size, shape = min(CHUNK, elements.count), (model.copies, len(keys))
    numbers, sizes = np.zeros(shape), np.zeros(shape)
    blocks = wp.zeros((size, K * K), dtype=wp.float64, device=model.device)
    kernel = model.kernel(constant_blocks, elements.term, model.dtype)
    for first in range(0, elements.count, size):
        some = slice(first, min(first + size, elements.count))
        model.launch(kernel, some.stop - first, [array[some] for array in elements.arguments], [blocks])
        own_rows, own_columns, apart = off_diagonal(stencil[some].astype(np.int64))
        found = own_rows // n, np.searchsorted(keys, own_rows % n * n + own_columns % n)
        own = _without_zeros(blocks.numpy()[: len(apart)], K)[apart]
        np.add.at(numbers, found, own)
        np.add.at(sizes, found, np.abs(own))
    if elements.stiffness_of_copies(model) is None:
        return rows, columns, numbers  # an entry that cancels in a copy need not in others, on which no copy may depend
    # Entries of right angles cancel up to the rounding of their elements. An entry must not be compared with others at its
    # vertices: a few large elements may be the only connection between two parts with small ones.
    some = (np.abs(numbers) > 4.0 * np.finfo(model.numpy_dtype).eps * sizes).any(axis=0)
    return rows[some], columns[some], numbers[:, some]


def _without_zeros(blocks, K):
    """Blocks (E, K·K), set to 0 for weights that are 0 up to rounding, such as those of vertices on one line."""
    squares = blocks[:, :: K + 1]
    small = squares <= ZERO**2 * squares.max(axis=1, keepdims=True)
    return np.where((small[:, :, None] | small[:, None]).reshape(blocks.shape), 0.0, blocks)


def _entries_of_cells(model, elements):
    """As :func:`matrix_entries`, for cells with weights, with all entries of the sparsity pattern."""
    rows, columns, values = constant_entries(model, elements)
    keys, where = np.unique(rows * model.per_copy + columns, return_inverse=True)
    numbers = np.stack([np.bincount(where, each, len(keys)) for each in values])
    rows, columns = np.divmod(keys, model.per_copy)
    apart = rows != columns
    return rows[apart], columns[apart], numbers[:, apart]


def as_pairs(model, elements):
    """Pairs of vertices with the same forces as the elements of a quadratic energy, or the elements if pairs are not faster."""
    if not elements.term.whole.quadratic or elements.damping is not None:
        return elements
    if elements.term.cell:
        rows, columns, numbers = _entries_of_cells(model, elements)
    elif elements.refresh:
        return elements
    else:
        rows, columns, numbers = matrix_entries(model, elements)
    upper = rows < columns
    per_copy = int(upper.sum())
    if not 0 < per_copy <= PAIRS * elements.per_copy:
        return elements
    firsts = model.per_copy * np.arange(model.copies)[:, None, None]
    stencil = (np.column_stack([rows, columns])[upper] + firsts).reshape(-1, 2).astype(np.int32)
    return replace(
        elements,
        term=replace(QUADRATIC_PAIR, name=elements.term.name),
        per_copy=per_copy,
        stencil=wp.array(stencil, dtype=wp.int32, device=model.device),
        stiffness=model.array(-numbers[:, upper].ravel(), model.dtype),
        rest=wp.zeros(len(stencil), dtype=wp.types.vector(1, model.dtype), device=model.device),
        refresh=None,
        cells=None,
    )
