"""The structs of pairs of cloth with cloth, and of their blocks in a matrix."""

from functools import cache
from typing import Any

import warp as wp

from .vectors import types


@wp.struct
class Layout:
    """The numbers of vertices: N of all cloth, n of that of a copy, and m obstacles of a copy."""

    cloth: wp.int32
    per_copy: wp.int32
    obstacles: wp.int32


@wp.struct
class Pairs:
    """The near pairs of :class:`warpcloth.contact.proximity.Proximity`, or the contacts of an energy.

    Near pairs have the fields up to ``distances``: ``counts`` of vertex–triangle pairs, which come first, and of edge–edge
    pairs; those of vertex i in rows ``rows`` [i] to rows[i+1]; and r or, if less, half the rest distance [m], in the precision
    of the model. Kernels over pairs have so many ``threads``: on the CPU one, for each there copies structs.

    An energy has ``stencils``, of cloth alone, and the others. Its contacts are in the first ``number`` (1,) slots, on a
    GPU in any order. ``keys`` number contacts by their pairs, so that they do not depend on that order. ``slots`` [key] is
    the slot of a key, if a contact has it, see :func:`.contact.self_pairs.slot_with`. ``corners`` lists 4·slot + corner of
    contacts at vertex i, from ``first`` [i] to first[i+1], sorted by key. ``corner_counts`` is scratch, 0 between launches. The
    last three are empty if no kernel sums over vertices.
    """

    layout: Layout
    threads: wp.int32
    stencils: wp.array(dtype=wp.vec4i)
    counts: wp.array(dtype=wp.int32)
    rows: wp.array(dtype=wp.int32)
    distances: wp.array(dtype=wp.float64)
    number: wp.array(dtype=wp.int32)
    keys: wp.array(dtype=wp.int32)
    slots: wp.array(dtype=wp.int32)
    corner_counts: wp.array(dtype=wp.int32)
    first: wp.array(dtype=wp.int32)
    corners: wp.array(dtype=wp.int32)


@cache
def pair_blocks(dtype):
    """Struct of what products of each pair read, in the precision of the matrix: w, 0 at pins, ∂²U/∂y² [N/m], and its turns."""
    vec3, mat33 = types(dtype)

    @wp.struct
    class PairBlocks:
        weights: wp.array(dtype=wp.types.vector(4, dtype))
        blocks: wp.array(dtype=mat33)
        turns: wp.array(dtype=wp.types.matrix((4, 2), dtype))
        ways: wp.array(dtype=wp.types.matrix((2, 3), dtype))
        normal: wp.array(dtype=vec3)
        twisted: wp.array(dtype=wp.types.vector(2, dtype))

    return PairBlocks


@wp.func
def turned_pull(w: Any, t: Any, ways: Any, n: Any, twisted: Any, y: Any, z: Any):
    """wᵢα eᵀz + n tᵢ·(α e y + β z), what turns add to wᵢ ∂²U/∂y² y for y = Σ wⱼpⱼ and z = Σ tⱼ n·pⱼ."""
    return (w * twisted[0]) * (wp.transpose(ways) * z) + wp.dot(t, twisted[0] * (ways * y) + twisted[1] * z) * n
