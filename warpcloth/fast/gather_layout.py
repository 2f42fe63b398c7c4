"""The elements of each vertex, in the layout of kernels that take all terms in one pass."""

import numpy as np
import warp as wp

from ..kernels.fast.gather_copies import codes_of_copies, values_of_copies
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
    copies = _Copies(model, elements)
    if found := _pairs(elements, copies):
        slots, codes, source = found
        others = {name: copies.values(array, source) for name, array in arrays.items() if name != "stencil"}
        own = None if damped or part.shared else elements.stiffness_of_copies(model)
        if own is not None:
            part = part._replace(shared=True)
            others["stiffness"] = model.array(np.repeat(own, model.per_copy), model.dtype)
        return part._replace(pairs=slots), {**others, "codes": copies.codes(codes, copies.n, own=True)}
    if rows and elements.term.quadratic and not (damped or elements.refresh) and (found := _of_matrix(model, elements)):
        slots, numbers = found
        return part._replace(rows=slots), numbers
    return _by_element(elements, copies, part, arrays)


def gathered_in_rows(model, elements, pairs, **others):
    """As :func:`gathered`, for Jacobi sweeps, with the incidences of pairs in rows.

    See :func:`warpcloth.kernels.fast.gather_corrections.slot_rows` for rows.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        elements: :class:`warpcloth.model.elements.DeviceElements`.
        pairs: Whether incidences may store the other vertex instead of the element.
        others: Further numbers (B·E,) of the elements, by name.
    """
    part = TermFacts(elements.term, shared=0 in elements.stiffness.strides)
    arrays = {"stiffness": elements.stiffness, "rest": elements.rest, **others}
    copies, count = _Copies(model, elements), model.count
    if not pairs or not (found := _pairs(elements, copies)):
        return _by_element(elements, copies, part, {"stencil": elements.stencil, **arrays})
    slots, codes, source = found
    codes, source = copies.on_host(codes, copies.n), np.maximum(copies.on_host(source, elements.per_copy), 0)
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


class _Copies:
    """Repeats the layout of the first of the copies of a model, if elements are in the order of copies; else that of all.

    Attributes:
        n, E, count: Vertices and elements of a copy, and the number of copies; or those of all, and 1.
        stencil: That of the first copy, (E, K).
    """

    def __init__(self, model, elements):
        self._model, stencil = model, host_values(elements.stencil)
        self.n, self.E, self.count = model.per_copy, elements.per_copy, model.copies
        if stencil[: self.E].max(initial=0) >= self.n:  # coloured elements of all copies are mixed
            self.n, self.E, self.count = model.count, elements.count, 1
        self.stencil = stencil[: self.E]

    def codes(self, codes, step, own=False):
        """Returns codes (slots, n), −1 for none, of all copies in one row, see :func:`.codes_of_copies`."""
        out = wp.empty((len(codes), self.count, self.n), dtype=wp.int32, device=self._model.device)
        if out.size:
            self._model.launch(self._model.kernel(codes_of_copies), out.shape, [self._put(codes), step, int(own)], [out])
        return out.flatten()

    def values(self, array, sources, step=None):
        """Returns the values of an array for ``sources`` (slots, n), of all copies in one row.

        A source is ``step`` more for each copy, by default by the number of elements. An array that repeats one is returned.
        """
        if 0 in array.strides:
            return array
        model, width = self._model, getattr(array.dtype, "_length_", 1)
        out = wp.empty(len(sources) * self.count * self.n, dtype=array.dtype, device=model.device)
        if len(out):
            numbers, of_slots = (
                wp.array(ptr=each.ptr, shape=(*shape, width), dtype=model.dtype, device=model.device)
                for each, shape in ((array, array.shape), (out, (len(sources), self.count, self.n)))
            )
            given = [numbers, self._put(sources), self.E if step is None else step]
            model.launch(model.kernel(values_of_copies, model.dtype), of_slots.shape[:3], given, [of_slots])
        return out

    def offsets(self, offsets, step):
        """Returns offsets (n+1,) of all copies."""
        every = offsets[1:] + step * np.arange(self.count)[:, None]
        return int32_array(np.append(0, every), self._model.device)

    def on_host(self, codes, step):
        """Returns codes (slots, n), −1 for none, of all copies, (slots, N), on the host."""
        every = codes[:, None] + step * np.arange(self.count)[:, None]
        return np.where(codes[:, None] < 0, -1, every).reshape(len(codes), -1)

    def _put(self, values):
        return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=wp.int32, device=self._model.device)


def _by_element(elements, copies, part, arrays):
    """The part and the arrays of incidences that store elements."""
    stencil, device = copies.stencil.ravel(), elements.stencil.device
    offsets, codes = incidences_of(stencil, copies.n)
    arrays |= {"offsets": copies.offsets(offsets, stencil.size)}
    slots = int(np.diff(offsets).max(initial=0))
    if padded := slots * copies.n <= 2 * len(codes):
        table = np.full((slots, copies.n), -1)
        vertices = stencil[codes]
        table[np.arange(len(codes)) - offsets[vertices], vertices] = codes
        return part._replace(padded=padded), arrays | {"codes": copies.codes(table, stencil.size)}
    every = codes + stencil.size * np.arange(copies.count)[:, None]
    return part._replace(padded=padded), arrays | {"codes": int32_array(every.ravel(), device)}


def _pairs(elements, copies):
    """Numbers of slots of a vertex as first and as second of a pair; other vertex and element for each slot and vertex.

    The latter are (slots, n), of the first copy. An empty slot has −1. The result is None if elements are not pairs, if their
    rest states change in each step, or if there would be too many slots.
    """
    stencil = copies.stencil
    if stencil.shape[1] != 2 or elements.refresh is not None:
        return None
    columns = [incidences_of(stencil[:, corner], copies.n) for corner in range(2)]
    slots = tuple(int(np.diff(offsets).max(initial=0)) for offsets, _codes in columns)
    if sum(slots) > SLOTS or sum(slots) * copies.n > 2 * stencil.size:
        return None
    codes, source = (np.full((sum(slots), copies.n), -1) for _ in range(2))
    for corner, (offsets, order) in enumerate(columns):
        vertices = stencil[order, corner]
        slot = corner * slots[0] + np.arange(len(order)) - offsets[vertices], vertices
        codes[slot], source[slot] = stencil[order, 1 - corner], order
    return slots, codes, source


def _of_matrix(model, elements):
    """The largest number of off-diagonal entries in a row of kAGᵀG, and its rows, padded with 0 for the vertex itself.

    None if padding more than doubles their number, or if there are none.
    """
    n = model.per_copy
    rows, columns, entries_of_copies = matrix_entries(model, elements)
    firsts = np.searchsorted(rows, np.arange(n + 1))
    slots = int(np.diff(firsts).max())
    if slots * n > 2 * len(rows) or not slots:
        return None
    slot = np.arange(len(rows)) - firsts[rows]
    codes = np.full((slots, n), -1)
    codes[slot, rows] = columns
    alike = 0 in entries_of_copies.strides or model.copies == 1
    numbers = np.zeros((slots, 1 if alike else model.copies, n))
    numbers[slot, :, rows] = entries_of_copies[: numbers.shape[1]].T
    of_copies = _Copies(model, elements.by_copies(model))
    stiffness = model.array(numbers.ravel(), model.dtype)
    if alike:
        stiffness = of_copies.values(stiffness, np.arange(slots * n).reshape(slots, n), step=0)
    return slots, {"codes": of_copies.codes(codes, n, own=True), "stiffness": stiffness}


def lanes_of(model):
    """The number of threads per vertex."""
    return LANES if model.device.is_cuda and model.count <= LANED else 1
