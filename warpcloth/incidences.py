"""The elements of each vertex, as kernels read them that take all terms in one pass."""

import numpy as np
import warp as wp

from .kernels.elements import Part, chain_of, elements_of

SLOTS = 16  # of pairs, which are compiled one by one


def gathered(elements, count, damped=False):
    """The :class:`warpcloth.kernels.elements.Part` of elements and what their struct has, by name, to gather over vertices.

    Incidences are padded to as many for each vertex, which neighbouring threads read side by side, unless that makes them more
    than twice as many, as a few vertices of many elements would. Padded pairs have the other vertex and what the element has
    beside it at hand, unless the rest state is set, by element, in each step.
    """
    stencil = elements.stencil.numpy()
    part = Part(elements.term, damped, shared=0 in elements.stiffness.strides)
    arrays = {"stencil": elements.stencil, "stiffness": elements.stiffness, "rest": elements.rest}
    if damped:
        arrays["damping"] = elements.damping
    if stencil.shape[1] == 2 and elements.origin is None:
        columns = [_rows(stencil[:, corner], count) for corner in range(2)]
        slots = tuple(int(np.diff(offsets).max(initial=0)) for _order, _vertices, offsets in columns)
        if sum(slots) <= SLOTS and sum(slots) * count <= 2 * stencil.size:
            return part._replace(pairs=slots), _of_pairs(elements, columns, slots, count, arrays)
    order, vertices, offsets = _rows(stencil.ravel(), count)
    slots = int(np.diff(offsets).max(initial=0))
    codes, padded = order, slots * count <= 2 * len(order)
    if padded:
        codes = np.full(slots * count, -1)
        codes[(np.arange(len(order)) - offsets[vertices]) * count + vertices] = order
    arrays |= {"offsets": indices(elements, offsets), "codes": indices(elements, codes)}
    return part._replace(padded=padded), arrays


def _rows(vertices, count):
    """The order that sorts vertices (E,), the sorted ones, and where those of each of the ``count`` vertices are in it."""
    order = np.argsort(vertices, kind="stable")
    return order, vertices[order], np.searchsorted(vertices[order], np.arange(count + 1))


def _of_pairs(elements, columns, slots, count, arrays):
    """The arrays of incidences that name the other vertex, those as first of a pair before those as second."""
    stencil = elements.stencil.numpy()
    codes, source = np.full(sum(slots) * count, -1), np.zeros(sum(slots) * count, dtype=np.int64)
    for corner, (order, vertices, offsets) in enumerate(columns):
        place = (corner * slots[0] + np.arange(len(order)) - offsets[vertices]) * count + vertices
        codes[place], source[place] = stencil[order, 1 - corner], order
    found = {name: _of_incidences(array, source) for name, array in arrays.items() if name != "stencil"}
    return found | {"codes": indices(elements, codes)}


def _of_incidences(array, source):
    """The values of elements ``source``, if elements do not share one."""
    if 0 in array.strides:
        return array
    return wp.array(array.numpy()[source], dtype=array.dtype, device=array.device)


def indices(elements, values):
    """Whole numbers (n,) on the device."""
    return wp.array(values.astype(np.int32), dtype=wp.int32, device=elements.stencil.device)


def chain(parts, arrays, dtype):
    """The struct of all terms: that of the first, and the chain of the others."""
    made = chain_of(tuple(parts), dtype)()
    if parts:
        elements = elements_of(parts[0], dtype)()
        for name, value in arrays[0].items():
            setattr(elements, name, value)
        made.first, made.others = elements, chain(parts[1:], arrays[1:], dtype)
    return made
