"""Kernels that repeat the layout of one copy for all copies."""

from functools import cache

import warp as wp


@cache
def codes_of_copies():
    """Kernel over (slots, copies, vertices): out = the first copy's code, ``step`` more per copy; −1 if negative, or with
    ``own`` = 1 the vertex itself.
    """

    @wp.kernel(module="unique", enable_backward=False)
    def code_of_each_slot(
        # elements
        codes: wp.array2d(dtype=wp.int32),
        # parameters
        step: int,
        own: int,
        # out
        out: wp.array3d(dtype=wp.int32),
    ):
        slot, copy, i = wp.tid()
        code = codes[slot, i]
        if code >= 0:
            out[slot, copy, i] = code + copy * step
        elif own == 1:
            out[slot, copy, i] = copy * out.shape[2] + i
        else:
            out[slot, copy, i] = -1

    return code_of_each_slot


@cache
def values_of_copies(dtype):
    """Kernel over (slots, copies, vertices): out = the values of the first copy's source, or ``step`` more per copy; the first
    values if negative.
    """

    @wp.kernel(module="unique", enable_backward=False)
    def values_of_each_slot(
        # elements
        values: wp.array2d(dtype=dtype),
        sources: wp.array2d(dtype=wp.int32),
        # parameters
        step: int,
        # out
        out: wp.array4d(dtype=dtype),
    ):
        slot, copy, i = wp.tid()
        source = int(sources[slot, i])
        if source >= 0:
            source += copy * step
        else:
            source = 0
        for p in range(values.shape[1]):
            out[slot, copy, i, p] = values[source, p]

    return values_of_each_slot
