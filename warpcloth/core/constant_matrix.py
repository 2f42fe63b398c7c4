"""The constant matrix s·M + Σ k A GᵀG of a model, y = Gx, which projective dynamics and ADMM factorise."""

import numpy as np
import warp as wp

from ..kernels import assemble, sparse
from ..model.host_values import host_values


def constant_blocks(model, elements):
    """Returns k A GᵀG of each element, y = Gx, (E, K, K) [N/m]."""
    K = elements.term.vertices
    blocks = wp.zeros((elements.count, K * K), dtype=wp.float64, device=model.device)
    kernel = model.kernel(assemble.constant_blocks, elements.term, model.dtype)
    model.launch(kernel, elements.count, elements.arguments, [blocks])
    return blocks.numpy().reshape(-1, K, K)


def constant_entries(model, elements):
    """Returns the rows and columns (m,) of the entries of Σ k A GᵀG of one copy, and the values of all copies (B, m) [N/m]."""
    if elements.term.cell is None:
        stencil = host_values(elements.stencil)[: elements.per_copy]
        K = stencil.shape[1]
        blocks = constant_blocks(model, elements)
        return np.repeat(stencil, K, axis=1).ravel(), np.tile(stencil, K).ravel(), blocks.reshape(model.copies, -1)
    cells = elements.cells
    starts, count = cells.blocks()
    blocks = wp.zeros(count, dtype=wp.float64, device=model.device)
    given = [cells.offsets, starts, cells.weights, elements.stiffness, cells.rest]
    model.launch(model.kernel(sparse.constant_blocks, cells.term, model.dtype), cells.count, given, [blocks])
    rows, columns = cells.pairs(elements)
    one = count // model.copies
    return rows[:one], columns[:one], blocks.numpy().reshape(model.copies, one)


def constant_matrices(model, s):
    """Returns s·M + Σ k A GᵀG of each copy, y = Gx, as scipy matrices (n, n) [N/m]. Rows of pins are the identity."""
    from scipy.sparse import coo_matrix

    n, B = model.per_copy, model.copies
    free = model.inverse_mass.numpy() > 0.0
    diagonal = np.where(free, s * model.mass.numpy().astype(np.float64), 1.0).reshape(B, n)
    vertices = np.arange(n)
    rows, columns, values = [vertices], [vertices], [diagonal]
    for elements in model.terms:
        for found, more in zip((rows, columns, values), constant_entries(model, elements), strict=True):
            found.append(more)
    rows, columns, values = np.concatenate(rows), np.concatenate(columns), np.concatenate(values, axis=1)
    free = free[:n]  # all copies have the same pins
    keep = (free[rows] & free[columns]) | (np.arange(len(rows)) < n)
    return [coo_matrix((each[keep], (rows[keep], columns[keep])), shape=(n, n)).tocsc() for each in values]
