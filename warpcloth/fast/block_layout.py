"""Blocks of consecutive vertices, with the elements of each term in the block of their lowest vertex, in pieces.

See :mod:`warpcloth.kernels.fast.block_forces` for the forces of a block.
"""

import numpy as np

from ..model.host_values import host_values
from .structs import int32_array

NUMBERS = 6144  # numbers of scratch, if no vertex needs more: 2048 springs, which fit into the first-level cache
RUN = 8  # number of elements from which a run is faster than reading stencils


def block_layout(terms, per_copy, copies):
    """Divides the vertices and the elements of all terms into blocks.

    A block has at least one vertex. It ends before the local coordinates of a term exceed :data:`NUMBERS`.

    Args:
        terms: :class:`warpcloth.model.elements.DeviceElements` of each term; all copies have the same.
        per_copy: Number of vertices per copy.
        copies: Number of copies.

    Returns:
        (vertices (blocks + 1,), terms, the arrays of each term by the names of
        :func:`warpcloth.kernels.fast.term_facts.elements_struct`, the largest count of numbers of a term in a block)
    """
    totals = [_numbers_before(elements, per_copy) for elements in terms]
    vertices = [0]
    while vertices[-1] < per_copy:
        ends = [int(np.searchsorted(total, total[vertices[-1]] + NUMBERS, side="right")) - 1 for total in totals]
        vertices.append(max(min(ends, default=per_copy), vertices[-1] + 1))
    blocks = np.array(vertices)
    most = max((int(np.diff(total[blocks]).max()) for total in totals), default=0)
    firsts = (blocks[:-1] + per_copy * np.arange(copies)[:, None]).ravel()
    found = [_in_pieces(elements, blocks, copies) for elements in terms]
    return np.append(firsts, per_copy * copies), [each for each, _ in found], [arrays for _, arrays in found], most


def _one(elements):
    """The stencil (E, K) of one copy."""
    return host_values(elements.stencil)[: elements.per_copy]


def _numbers_before(elements, per_copy):
    """Count of numbers in the local coordinates of the elements whose lowest vertex is before each vertex, (per_copy + 1,)."""
    counts = np.bincount(_one(elements).min(axis=1), minlength=per_copy)
    return 3 * elements.term.rows * np.append(0, np.cumsum(counts))


def _in_pieces(elements, blocks, copies):
    """The elements by block, runs first, and their arrays for a kernel."""
    stencil = _one(elements)
    lowest = stencil.min(axis=1)
    block = np.searchsorted(blocks, lowest, side="right") - 1
    first, *others = stencil.T
    order = np.lexsort((first, *(other - first for other in others[::-1]), block))
    new = _changes(block[order]) | _changes(stencil[order] - np.arange(len(order))[:, None])
    run = np.cumsum(new) - 1
    loose = np.bincount(run)[run] < RUN
    again = np.lexsort((np.where(loose, lowest[order], run), loose, block[order]))
    order, run, loose = order[again], np.where(loose, -1, run)[again], loose[again]
    firsts = np.flatnonzero(_changes(block[order]) | _changes(run))
    counts = np.diff(np.append(firsts, len(order))) * np.where(loose[firsts], -1, 1)
    offsets = np.searchsorted(block[order][firsts], np.arange(len(blocks)))
    if copies > 1:
        copy = np.arange(copies)[:, None]
        offsets = np.append((offsets[:-1] + len(firsts) * copy).ravel(), len(firsts) * copies)
        order, firsts = ((each + elements.per_copy * copy).ravel() for each in (order, firsts))
        counts = np.tile(counts, copies)
    if (np.diff(order) < 0).any():
        elements = elements.reordered(order)
    device = elements.stencil.device
    arrays = {"offsets": int32_array(offsets, device), "codes": int32_array(np.column_stack([firsts, counts]).ravel(), device)}
    arrays |= {"stencil": elements.stencil, "stiffness": elements.stiffness, "rest": elements.rest}
    return elements, arrays if elements.damping is None else arrays | {"damping": elements.damping}


def _changes(values):
    """Whether each row differs from the one before; True for the first."""
    values = values.reshape(len(values), -1)
    return np.append(np.full(min(len(values), 1), True), (values[1:] != values[:-1]).any(axis=1))
