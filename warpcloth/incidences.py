"""The elements of each vertex, as kernels read them that take all terms in one pass."""

import numpy as np
import warp as wp

from .kernels.elements import Part, chain_of, elements_of


def gathered(elements, count, damped=False):
    """The :class:`warpcloth.kernels.elements.Part` of elements and what their struct has, by name, to gather over vertices.

    Incidences are padded to rows of equal length, which neighbouring threads read side by side, unless that makes them more
    than twice as many, as a few vertices of many elements would.
    """
    stencil = elements.stencil.numpy()
    K, vertices = stencil.shape[1], stencil.ravel()
    order = np.argsort(vertices, kind="stable")
    offsets = np.searchsorted(vertices[order], np.arange(count + 1))
    degrees = np.diff(offsets)
    slots = int(degrees.max(initial=0))
    padded = slots * count <= 2 * len(order)
    place, size = np.arange(len(order)), len(order)
    if padded:
        place, size = (place - offsets[vertices[order]]) * count + vertices[order], slots * count
    codes = np.full(size, -1, dtype=np.int64)
    codes[place] = order
    found = {"slots": slots, "stencil": elements.stencil, "stiffness": elements.stiffness}
    found |= {"damping": elements.damping if damped else None, "rest": elements.rest}
    pairs = K == 2 and elements.origin is None  # else the rest state is set, by element, in each step
    if pairs:  # the other vertex is at hand, and what the element has beside it
        codes[place] = 2 * stencil[order // 2, 1 - order % 2] + order % 2
        source = np.zeros(size, dtype=np.int64)
        source[place] = order // 2
        found["stencil"] = None
        found |= {name: _of_incidences(found[name], source) for name in ("stiffness", "damping", "rest")}
    found["codes"] = indices(elements, codes)
    if not padded:
        found["offsets"] = indices(elements, offsets)
    return Part(elements.term, damped, pairs, padded=padded), found


def _of_incidences(array, source):
    """The values of elements ``source``, if elements do not share one."""
    if array is None or 0 in array.strides:
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
            if value is not None:
                setattr(elements, name, value)
        made.first, made.others = elements, chain(parts[1:], arrays[1:], dtype)
    return made
