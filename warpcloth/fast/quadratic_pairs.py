"""Quadratic energies as pairs of vertices, from the entries of their assembled matrix Q = kAGᵀG."""

from dataclasses import replace

import numpy as np
import warp as wp

from ..core.block_pattern import TermCorners, find_pattern
from ..core.constant_matrix import constant_entries
from ..kernels.assemble import constant_blocks, sum_entries
from ..kernels.fast.quadratic_pair import QUADRATIC_PAIR
from ..model.host_values import host_values

CHUNK = 1 << 18  # number of elements, if a copy has fewer, whose blocks are summed at once
# Pairs are faster up to this number per element: a hinge takes 5 to 6 ns, a pair of vertices 1.2 ns (one core).
PAIRS = 4


def matrix_entries(model, elements):
    """The off-diagonal entries of Q, row by row; if the elements of a copy share one stiffness, without entries that cancel.

    Returns:
        (rows (m,), columns (m,), numbers (B, m) [N/m]) for the vertices of one copy. Copies that are alike share the numbers.
    """
    elements, n = elements.by_copies(model), model.per_copy
    stencil = host_values(elements.stencil)[: elements.per_copy]
    pattern = find_pattern(model, [TermCorners(model, stencil.ravel(), K=stencil.shape[1])], np.zeros(n, dtype=bool))
    rows, columns = (array.numpy().astype(np.int64) for array in (pattern.rows, pattern.columns))
    copies = 1 if elements.alike(model.copies) else model.copies
    numbers, sizes = _summed(model, elements, pattern.sums[0], (copies, len(rows)))
    some = rows != columns
    if elements.stiffness_of_copies(model) is not None:
        # Entries of right angles cancel up to the rounding of their elements. An entry must not be compared with others at its
        # vertices: a few large elements may be the only connection between two parts with small ones. Where stiffnesses
        # differ, an entry that cancels in a copy need not in others, on which no copy may depend.
        some &= (np.abs(numbers) > 4.0 * np.finfo(model.numpy_dtype).eps * sizes).any(axis=0)
    return rows[some], columns[some], np.broadcast_to(numbers[:, some], (model.copies, int(some.sum())))


def _summed(model, elements, sums, shape):
    """The entries of Q, and the sums of the sizes of their parts, for the first copies, both of a ``shape`` (copies, m)."""
    K, E = elements.term.vertices, elements.per_copy
    copies, some = shape[0], max(1, CHUNK // E)
    numbers, sizes = np.empty(shape), np.empty(shape)
    kernels = model.kernel(constant_blocks, elements.term, model.dtype), model.kernel(sum_entries)
    for first in range(0, copies, some):
        count = min(some, copies - first)
        blocks = wp.empty((count * E, K * K), dtype=wp.float64, device=model.device)
        found = [wp.empty((count, shape[1]), dtype=wp.float64, device=model.device) for _ in range(2)]
        chosen = slice(first * E, (first + count) * E)
        model.launch(kernels[0], count * E, [array[chosen] for array in elements.arguments], [blocks])
        model.launch(kernels[1], (count, shape[1]), [*sums, blocks.reshape((count, E, K * K)), K], found)
        for array, values in zip((numbers, sizes), found, strict=True):
            array[first : first + count] = values.numpy()
    return numbers, sizes


def _entries_of_cells(model, elements):
    """As :func:`matrix_entries`, for cells with weights, with all entries of the sparsity pattern."""
    rows, columns, values = constant_entries(model, elements)
    keys, where = np.unique(rows * model.per_copy + columns, return_inverse=True)
    numbers = np.stack([np.bincount(where, each, len(keys)) for each in values])
    rows, columns = np.divmod(keys, model.per_copy)
    apart = rows != columns
    return rows[apart], columns[apart], numbers[:, apart]


def as_pairs(model, elements):
    """Pairs of vertices with the same forces as undamped elements of a quadratic energy, or these if pairs are not faster."""
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
