"""Structs of the arrays of all terms, for kernels that take all terms in one launch."""

import numpy as np
import warp as wp

from ..core.filled import filled
from ..kernels.fast.term_facts import chain_of, elements_struct


def chained(parts, arrays, dtype, struct_of=elements_struct):
    """Struct of all terms: that of the first, and the chain of the others.

    Args:
        parts: The facts of each term, for ``struct_of``.
        arrays: The values of each struct, by name.
        dtype: A Warp scalar type.
        struct_of: See :func:`warpcloth.kernels.fast.term_facts.chain_of`.
    """
    made = chain_of(tuple(parts), dtype, struct_of)()
    if parts:
        made.first = filled(struct_of(parts[0], dtype), **arrays[0])
        made.others = chained(parts[1:], arrays[1:], dtype, struct_of)
    return made


def int32_array(values, device):
    """An int32 array (n,) on the device."""
    return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=wp.int32, device=device)
