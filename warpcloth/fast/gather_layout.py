"""The elements of each vertex, in the layout of kernels that take all terms in one pass."""

import numpy as np
import warp as wp

from ..kernels.fast.gather_corrections import slot_rows
from ..kernels.fast.term_facts import TermFacts
from ..model.elements import incidences_of
from ..model.host_values import host_values
from .quadratic_pairs import matrix_entries
from .structs import int32_array

SLOTS = 16  # maximum number of slots of pairs, each of which is compiled
# On CUDA, LANES threads take a vertex of meshes with at most LANED vertices. A step of springs then takes 2.0 µs instead of 3.0
# with 64² vertices, and 2.2 instead of 3.1 with 128². With 256² it takes the same time, with more it takes longer.
LANES, LANED = 4, 50_000


def gathered(model, elements, damped=False, rows=True):
    """The :class:`warpcloth.kernels.fast.term_facts.TermFacts` of elements, and the arrays of their struct by name.

    Incidences are padded to the same number for each vertex, so that neighbouring threads read neighbouring memory, unless this
    more than doubles their number. Padded pairs store the other vertex and the data of the element, unless elements are
    refreshed. A stiffness shared by all pairs of a copy is stored per vertex, so that a copy is bitwise equal to its own model.
    For an undamped quadratic energy, the incidences are the rows of its matrix if ``rows`` is True. Rows take a third of the
    time, but their rounding errors do not cancel between vertices. In float32 this noise bends a strip of 40 elements by 1e-4
    of its length, 30 times as much as with elements.
    """
    part = TermFacts(elements.term, damped, shared=0 in elements.stiffness.strides)
    arrays = {"stencil": elements.stencil, "stiffness": elements.stiffness, "rest": elements.rest}
    if damped:
        arrays["damping"] = elements.damping
    if found := _pairs(elements, model.count):
        slots, codes, source = found
        codes = np.where(codes < 0, np.arange(model.count), codes)
        others = {name: _of_incidences(array, source.ravel()) for name, array in arrays.items() if name != "stencil"}
        own = None if damped or part.shared else elements.stiffness_of_copies(model)
        if own is not None:
            part = part._replace(shared=True)
            others["stiffness"] = model.array(np.repeat(own, model.per_copy), model.dtype)
        return part._replace(pairs=slots), {**others, "codes": int32_array(codes.ravel(), elements.stencil.device)}
    if rows and elements.term.quadratic and not (damped or elements.refresh) and (found := _of_matrix(model, elements)):
        slots, numbers = found
        return part._replace(rows=slots), numbers
    return _by_element(elements, model.count, part, arrays)


def gathered_in_rows(elements, count, pairs, **others):
    """As :func:`gathered`, for Jacobi sweeps, with the incidences of pairs in rows.

    See :func:`warpcloth.kernels.fast.gather_corrections.slot_rows` for rows.

    Args:
        elements: :class:`warpcloth.model.elements.DeviceElements`.
        count: Number of vertices N.
        pairs: Whether incidences may store the other vertex instead of the element.
        others: Further numbers (B·E,) of the elements, by name.
    """
    part = TermFacts(elements.term, shared=0 in elements.stiffness.strides)
    arrays = {"stiffness": elements.stiffness, "rest": elements.rest, **others}
    if not pairs or not (found := _pairs(elements, count)):
        return _by_element(elements, count, part, {"stencil": elements.stencil, **arrays})
    slots, codes, source = found
    rows, width = slot_rows(sum(slots))
    empty = ((0, rows * width - sum(slots)), (0, 0))
    codes, source = np.pad(codes, empty, constant_values=-1), np.pad(source, empty)

    def in_rows(values):
        """Values (slots, N) or (slots, N, P) in storage order: row by row, P times the slots of each vertex."""
        parts = values.reshape(rows, width, count, -1).transpose(0, 3, 2, 1)
        return np.ascontiguousarray(parts).reshape(-1, *values.shape[2:])

    found = {"codes": int32_array(in_rows(codes), elements.stencil.device)}
    for name, array in arrays.items():
        shared = 0 in array.strides
        found[name] = array if shared else wp.array(in_rows(host_values(array)[source]), dtype=array.dtype, device=array.device)
    return part._replace(pairs=slots), found


def _by_element(elements, count, part, arrays):
    """The part and the arrays of incidences that store elements."""
    stencil = host_values(elements.stencil).ravel()
    offsets, codes = incidences_of(stencil, count)
    codes, padded = _slots(codes, stencil[codes], offsets, count)
    arrays |= {"offsets": int32_array(offsets, elements.stencil.device), "codes": int32_array(codes, elements.stencil.device)}
    return part._replace(padded=padded), arrays


def _pairs(elements, count):
    """Numbers of slots of a vertex as first and as second of a pair; other vertex and element for each slot and vertex.

    An empty slot has −1 and 0. The result is None if elements are not pairs, if their rest states change in each step, or if
    there would be too many slots.
    """
    stencil = host_values(elements.stencil)
    if stencil.shape[1] != 2 or elements.refresh is not None:
        return None
    columns = [incidences_of(stencil[:, corner], count) for corner in range(2)]
    slots = tuple(int(np.diff(offsets).max(initial=0)) for offsets, _codes in columns)
    if sum(slots) > SLOTS or sum(slots) * count > 2 * stencil.size:
        return None
    codes, source = np.full((sum(slots), count), -1), np.zeros((sum(slots), count), dtype=np.int64)
    for corner, (offsets, order) in enumerate(columns):
        vertices = stencil[order, corner]
        slot = corner * slots[0] + np.arange(len(order)) - offsets[vertices], vertices
        codes[slot], source[slot] = stencil[order, 1 - corner], order
    return slots, codes, source


def _slots(values, vertices, offsets, count):
    """Values of incidences, slot by slot if padding at most doubles their number, else by vertex; and which of the two."""
    slots = int(np.diff(offsets).max(initial=0))
    if slots * count > 2 * len(values):
        return values, False
    padded = np.full(slots * count, -1, dtype=values.dtype)
    padded[(np.arange(len(values)) - offsets[vertices]) * count + vertices] = values
    return padded, True


def _of_matrix(model, elements):
    """The largest number of off-diagonal entries in a row of kAGᵀG, and its rows, padded with 0 for the vertex itself.

    None if padding more than doubles their number, or if there are none.
    """
    n, count = model.per_copy, model.count
    rows, columns, entries_of_copies = matrix_entries(model, elements)
    firsts = np.searchsorted(rows, np.arange(n + 1))
    slots = int(np.diff(firsts).max())
    if slots * n > 2 * len(rows) or not slots:
        return None
    slot = np.arange(len(rows)) - firsts[rows]
    codes, numbers = np.tile(np.arange(count), (slots, 1)), np.zeros((slots, count))
    for copy, own in enumerate(entries_of_copies):
        codes[slot, copy * n + rows], numbers[slot, copy * n + rows] = copy * n + columns, own
    return slots, {
        "codes": int32_array(codes.ravel(), elements.stencil.device),
        "stiffness": model.array(numbers.ravel(), model.dtype),
    }


def _of_incidences(array, source):
    """The values of the elements ``source``, unless elements share one."""
    if 0 in array.strides:
        return array
    return wp.array(host_values(array)[source], dtype=array.dtype, device=array.device)


def lanes_of(model):
    """The number of threads per vertex."""
    return LANES if model.device.is_cuda and model.count <= LANED else 1
