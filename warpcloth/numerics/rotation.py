"""Singular value and polar decompositions of arrays of small matrices, and best-fit rotations, on the CPU and on CUDA."""

from collections.abc import Sequence
from typing import Literal, TypeVar

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..base.checks import as_array, choice, numeric, refuse, shown
from ..base.quiet import find_device
from ..base.turns import in_turn
from ..kernels import arap_cells as cells
from ..kernels import decompose, rotation

Array = TypeVar("Array", np.ndarray, wp.array)
_TYPES = {np.dtype(np.float32): wp.float32, np.dtype(np.float64): wp.float64}
_SVD = {
    "plain": {(3, 3): rotation.svd3, (3, 2): rotation.svd3x2, (2, 2): rotation.svd2},
    "rotation": {(3, 3): rotation.rotation_svd3, (3, 2): rotation.svd3x2, (2, 2): rotation.rotation_svd2},
}
_POLAR = {(3, 3): rotation.polar3, (3, 2): rotation.polar3x2, (2, 2): rotation.polar2}


@in_turn
def svd(A: Array, convention: Literal["plain", "rotation"] = "plain") -> tuple[Array, Array, Array]:
    """Computes singular value decompositions A = U diag(S) Vᵀ of many small matrices, S descending.

    The error is a few ε of the largest singular value, for any size and rank of A, in float32 and float64.
    See :mod:`warpcloth.kernels.rotation` for the method, its sources, and the choice where UVᵀ is not unique. If an entry is
    NaN or infinite, all results of its matrix are NaN.

    Args:
        A: (..., 3, 3), (..., 3, 2) or (..., 2, 2), float32 or float64: a NumPy array, decomposed on the CPU, or a Warp array of
            numbers or of matrices, decomposed on its device.
        convention: "plain" for S ≥ 0, or "rotation" for det U = det V = 1, where the last S has the sign of det A. For 3×2
            matrices both give S ≥ 0, det V = 1.

    Returns:
        tuple: U like A, S (..., columns), V (..., columns, columns), arrays of the same kind as A.

    Raises:
        ValueError: A has another shape or type, or there is no such convention.
    """
    choice("convention", convention, tuple(_SVD))
    batch = _Batch("A", A, tuple(_POLAR))
    n = batch.shape[1]
    return _decomposed(batch, decompose.into_three, _SVD[convention][batch.shape], batch.shape, (n,), (n, n))


@in_turn
def polar(A: Array) -> tuple[Array, Array]:
    """Computes polar decompositions A = R P of many small matrices.

    Args:
        A: As for :func:`svd`.

    Returns:
        tuple: R like A, the nearest rotation (det R = 1; for 3×2 the nearest matrix with RᵀR = I), and P (..., columns,
        columns), symmetric, whose lowest eigenvalue has the sign of det A if A is square. Arrays of the same kind as A.

    Raises:
        ValueError: A has another shape or type.
    """
    batch = _Batch("A", A, tuple(_POLAR))
    n = batch.shape[1]
    return _decomposed(batch, decompose.into_two, _POLAR[batch.shape], batch.shape, (n, n))


@in_turn
def kabsch(
    P: Array,
    Q: Array,
    weights: ArrayLike | wp.array | None = None,
    neighbours: ArrayLike | Sequence[ArrayLike] | None = None,
) -> Array:
    """Computes the best rotations R of points P to Q about their centroids: min Σ w ‖(q − q̄) − R(p − p̄)‖² (Kabsch 1976).

    p̄ = Σ w p / Σ w. R is never a reflection. For points on a line, R is the smallest of the best rotations, for one point the
    identity. If a point or a weight is not finite, R is NaN. A large distance from the origin adds no error beyond the rounding
    of the coordinates.

    Args:
        P: (..., n, 3) [m], float32 or float64: a NumPy array, or a Warp array of numbers or of vectors.
        Q: (..., n, 3) [m], of the same kind and type; leading dimensions broadcast as in NumPy.
        weights: (n,) or (..., n), 0 or more; 1 by default. A point has the same weight in all of its sets.
        neighbours: Sets of points with a rotation each: (C, k) indices, or C lists of indices of any lengths, as
            `scipy.spatial.cKDTree` returns them. By default one set of all points.

    Returns:
        R (..., 3, 3), with neighbours (..., C, 3, 3), an array of the same kind as P.

    Raises:
        ValueError: An array has the wrong shape or type, a set is empty or has an index outside 0 to n − 1, a weight is
            negative, or all weights of a set are 0.

    Examples:
        >>> import warpcloth as wc
        >>> points = wc.Mesh.grid(3, 3).points
        >>> turned = points[:, [1, 0, 2]] * [-1, 1, 1]  # by 90° about z
        >>> R = wc.kabsch(points, turned)
        >>> round(float(R[1] @ [1, 0, 0]), 6)  # the axis x turns to the axis y
        1.0
    """
    rest, turned = _Batch("P", P, ((3,),)), _Batch("Q", Q, ((3,),))
    if (rest.warp, rest.scalar, rest.device) != (turned.warp, turned.scalar, turned.device):
        raise ValueError(f"P is a {rest.words} and Q a {turned.words}; they must be of one kind and type, on one device")
    if not rest.batch or not turned.batch or rest.batch[-1] != turned.batch[-1] or not rest.batch[-1]:
        raise ValueError(
            f"P has shape {(*rest.batch, 3)} and Q {(*turned.batch, 3)}; both must be (…, n, 3) with one n above 0"
        )
    n = rest.batch[-1]
    sizes, members = point_sets(neighbours, n)
    w = np.ones(n) if weights is None else numeric("weights", _on_host(weights), f"have shape {(n,)} or (…, {n})")
    if w.ndim == 0 or w.shape[-1] != n:
        raise ValueError(f"weights has shape {w.shape}; it must be {(n,)} or (…, {n})")
    refuse("weights", w, w < 0.0, "must be 0 or more")
    shapes = rest.batch[:-1], turned.batch[:-1], w.shape[:-1]
    try:
        leading = np.broadcast_shapes(*shapes)
    except ValueError:
        raise ValueError("P, Q and weights have leading dimensions {}, {} and {}; they must fit".format(*shapes)) from None
    count = int(np.prod(leading, dtype=np.int64))
    # Every leading index has its own points and weights. All share the sets.
    offsets = np.concatenate([[0], np.cumsum(np.tile(sizes, count))])
    members = (members + n * np.arange(count)[:, None]).ravel()
    device, vec3, mat33 = rest.device, wp.types.vector(3, rest.scalar), wp.types.matrix((3, 3), rest.scalar)
    with np.errstate(over="ignore"):
        w = np.broadcast_to(w, (*leading, n)).reshape(-1).astype(wp.dtype_to_numpy(rest.scalar))
    starts = offsets[:-1]
    if len(starts) and not (np.add.reduceat(w[members], starts) != 0.0).all():
        raise ValueError(f"weights of a set of points are all 0 in {rest.scalar.__name__}; one of them must be above")
    offsets, members = (wp.array(part.astype(np.int32), dtype=wp.int32, device=device) for part in (offsets, members))
    w = wp.array(w, dtype=rest.scalar, device=device)
    X, x = (batch.spread((*leading, n)) for batch in (rest, turned))
    moments = wp.empty(len(members), dtype=vec3, device=device)
    R = wp.empty(len(offsets) - 1, dtype=mat33, device=device)
    wp.launch(cells.set_moments(rest.scalar), len(R), inputs=[offsets, members, w, X], outputs=[moments], device=device)
    wp.launch(cells.fit_rotations(rest.scalar), len(R), inputs=[offsets, members, moments, x], outputs=[R], device=device)
    return rest.like(R, leading if neighbours is None else (*leading, len(sizes)), (3, 3))


def point_sets(neighbours, n):
    """Returns the size of each set (C,), and the indices of all sets, one set after another."""
    if neighbours is None:
        return np.array([n]), np.arange(n)
    rule = f"it must be an array (C, k) of indices or C lists of them, of the {n} points, none of them empty"
    try:
        given = list(_on_host(neighbours))
        sets = [np.asarray(members) for members in given]
    except (TypeError, ValueError):
        raise ValueError(f"neighbours is {shown(neighbours)}; {rule}") from None
    for c, members in enumerate(sets):
        if members.ndim != 1 or not len(members) or members.dtype.kind not in "iu":
            raise ValueError(f"neighbours[{c}] is {shown(given[c])}; {rule}")
    sizes = np.array([len(members) for members in sets], dtype=int)
    members = np.concatenate([*sets, np.empty(0, dtype=int)]).astype(int)
    for k in np.flatnonzero((members < 0) | (members >= n))[:1]:
        c = np.searchsorted(np.cumsum(sizes), k, side="right")
        raise ValueError(f"neighbours[{c}] has {members[k]}; it must be an index of the {n} points, 0 to {n - 1}")
    return sizes, members


def _on_host(array):
    return array.numpy() if isinstance(array, wp.array) else array


def _decomposed(batch, factory, function, *shapes):
    """Launches a device function over all matrices, and returns its results, each with its shape."""
    kinds = [wp.types.vector(s[0], batch.scalar) if len(s) == 1 else wp.types.matrix(s, batch.scalar) for s in shapes]
    out = [wp.empty(len(batch.items), dtype=kind, device=batch.device) for kind in kinds]
    decompose.launch(factory, function, batch.items, out)
    return tuple(batch.like(array, batch.batch, shape) for array, shape in zip(out, shapes, strict=True))


class _Batch:
    """An array of vectors or small matrices as a flat Warp array, and the conversion of results to the kind of the input.

    Attributes:
        batch, shape: Leading dimensions, and the shape of one item.
        items: All items in a flat Warp array.
        words: Words for the kind of array, for error messages.
    """

    def __init__(self, name, A, shapes):
        self.warp = isinstance(A, wp.array)
        inner = getattr(A.dtype, "_shape_", ()) if self.warp else ()
        self.typed = len(inner) == len(shapes[0])  # items, not numbers
        if not self.warp:
            A = as_array(A)
            A = A.astype(np.float64) if A.dtype.kind in "iu" else A
        scalar = _TYPES.get(A.dtype) if not self.warp else A.dtype._wp_scalar_type_ if self.typed else A.dtype
        shape, split = (*A.shape, *inner), -len(shapes[0])
        self.batch, self.shape, self.scalar = shape[:split], shape[split:], scalar
        if scalar not in _TYPES.values() or self.shape not in shapes:
            allowed = " or ".join(f"(…, {', '.join(map(str, s))})" for s in shapes)
            raise ValueError(f"{name} has shape {shape} and type {shown(A.dtype)}; it must be {allowed} of float32 or float64")
        self.device = A.device if self.warp else find_device("cpu")
        self.words = f"{'Warp' if self.warp else 'NumPy'} array of {scalar.__name__} on {self.device}"
        vector = len(self.shape) == 1
        self.kind = wp.types.vector(self.shape[0], scalar) if vector else wp.types.matrix(self.shape, scalar)
        count = int(np.prod(self.batch, dtype=np.int64))
        if self.warp:
            self.source = A.contiguous()  # keeps the memory alive
            self.items = wp.array(ptr=self.source.ptr, shape=count, dtype=self.kind, device=self.device)
        else:
            A = np.ascontiguousarray(A).reshape(count, *self.shape)
            self.items = wp.array(A, dtype=self.kind, device="cpu", copy=False)

    def spread(self, batch):
        """Returns the items broadcast to other leading dimensions, as a flat array."""
        if batch == self.batch:
            return self.items
        rows = np.broadcast_to(np.arange(len(self.items)).reshape(self.batch), batch).ravel()
        return self.items[wp.array(rows.astype(np.int32), dtype=wp.int32, device=self.device)].contiguous()

    def like(self, array, batch, shape):
        """Returns a flat array of items with leading dimensions ``batch`` and items of a shape, of the kind of the input."""
        if not self.warp:
            return array.numpy().reshape(*batch, *shape)
        if self.typed and batch:
            return array.reshape(batch)
        if self.typed:
            return array
        numbers = wp.array(ptr=array.ptr, shape=(*batch, *shape), dtype=self.scalar, device=self.device)
        numbers.items = array  # keeps the memory alive
        return numbers
