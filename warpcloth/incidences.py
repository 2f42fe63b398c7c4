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
    K, vertices = stencil.shape[1], stencil.ravel()
    order = np.argsort(vertices, kind="stable")
    vertices = vertices[order]
    offsets = np.searchsorted(vertices, np.arange(count + 1))
    slots = int(np.diff(offsets).max(initial=0))
    place, size = np.arange(len(order)), len(order)
    padded = slots * count <= 2 * size
    if padded:
        place, size = (place - offsets[vertices]) * count + vertices, slots * count
    codes = np.full(size, -1, dtype=np.int64)
    codes[place] = order
    found = {"stencil": elements.stencil, "stiffness": elements.stiffness, "rest": elements.rest}
    if damped:
        found["damping"] = elements.damping
    pairs = padded and K == 2 and elements.origin is None and slots <= SLOTS
    if pairs:
        del found["stencil"]
        codes[place] = 2 * stencil[order // 2, 1 - order % 2] + order % 2
        source = np.zeros(size, dtype=np.int64)
        source[place] = order // 2
        found = {name: _of_incidences(array, source) for name, array in found.items()}
    else:
        found["offsets"] = indices(elements, offsets)
    found["codes"] = indices(elements, codes)
    return Part(elements.term, damped, pairs=slots if pairs else 0, padded=padded), found


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
