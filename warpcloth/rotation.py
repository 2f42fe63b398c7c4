"""Singular values, polar decomposition and best rotations of arrays of small matrices, on the CPU and on CUDA."""

import numpy as np
import warp as wp

from .checks import choice, shown
from .kernels import decompose, rotation

_TYPES = {np.dtype(np.float32): wp.float32, np.dtype(np.float64): wp.float64}
_SVD = {
    "plain": {(3, 3): rotation.svd3, (3, 2): rotation.svd3x2, (2, 2): rotation.svd2},
    "rotation": {(3, 3): rotation.rotation_svd3, (3, 2): rotation.svd3x2, (2, 2): rotation.rotation_svd2},
}
_POLAR = {(3, 3): rotation.polar3, (3, 2): rotation.polar3x2, (2, 2): rotation.polar2}


def svd(A, convention="plain"):
    """Singular value decompositions A = U diag(S) Vᵀ of many small matrices, S descending.

    The error is a few ε of the largest singular value, whatever the size or the rank of A, in float32 as in float64.
    See :mod:`warpcloth.kernels.rotation` for the method, its sources, and what holds where UVᵀ is not unique. A NaN or an
    infinity in a matrix makes all of its results NaN.

    Args:
        A: (..., 3, 3), (..., 3, 2) or (..., 2, 2), a NumPy array (decomposed on the CPU) or a Warp array, of numbers or of
            matrices (decomposed on its device); float32 or float64.
        convention: "plain", S ≥ 0; or "rotation", det U = det V = 1, and the last S has the sign of det A. Of 3×2 matrices
            both are one: S ≥ 0, det V = 1.

    Returns:
        tuple: U like A, S (..., columns), V (..., columns, columns), of the kind of array that A is.

    Raises:
        ValueError: A is of another shape or type, or there is no such convention.
    """
    choice("convention", convention, tuple(_SVD))
    batch = _Batch("A", A)
    n = batch.shape[1]
    functions, results = _SVD[convention], (batch.shape, (n,), (n, n))
    return batch.apply(decompose.into_three, functions[batch.shape], results)


def polar(A):
    """Polar decompositions A = R P of many small matrices.

    Args:
        A: As of :func:`svd`.

    Returns:
        tuple: R like A, the nearest rotation (det R = 1; of 3×2 the nearest matrix with RᵀR = I), and P (..., columns,
        columns), symmetric; of square A its least eigenvalue has the sign of det A. Of the kind of array that A is.

    Raises:
        ValueError: A is of another shape or type.
    """
    batch = _Batch("A", A)
    n = batch.shape[1]
    return batch.apply(decompose.into_two, _POLAR[batch.shape], (batch.shape, (n, n)))


class _Batch:
    """An array of small matrices as one row of Warp matrices, and results of the same kind of array.

    Attributes:
        shape: Of one matrix.
    """

    def __init__(self, name, A):
        self.warp = isinstance(A, wp.array)
        self.typed = self.warp and len(getattr(A.dtype, "_shape_", ())) == 2  # of matrices, not of numbers
        if not self.warp:
            A = np.asarray(A)
            A = A.astype(np.float64) if A.dtype.kind in "iu" else A
        scalar = A.dtype._wp_scalar_type_ if self.typed else A.dtype if self.warp else _TYPES.get(A.dtype)
        shape = (*A.shape, *A.dtype._shape_) if self.typed else A.shape
        self.batch, self.shape, self.scalar = shape[:-2], shape[-2:], scalar
        if scalar not in _TYPES.values() or self.shape not in _POLAR:
            raise ValueError(
                f"{name} has shape {shape} and type {shown(A.dtype)}; it must be (…, 3, 3), (…, 3, 2) or (…, 2, 2) of float32 "
                "or float64"
            )
        self.device = A.device if self.warp else wp.get_device("cpu")
        self.matrix = wp.types.matrix(self.shape, scalar)
        self.count = int(np.prod(self.batch, dtype=np.int64))
        self.A = A.contiguous() if self.warp else np.ascontiguousarray(A)

    def apply(self, factory, function, shapes):
        """The results of a kernel over the matrices, each of a shape."""
        types = tuple(wp.types.vector(s[0], self.scalar) if len(s) == 1 else wp.types.matrix(s, self.scalar) for s in shapes)
        if self.warp:
            A = wp.array(ptr=self.A.ptr, shape=self.count, dtype=self.matrix, device=self.device)
        else:
            A = wp.array(self.A.reshape(self.count, *self.shape), dtype=self.matrix, device="cpu", copy=False)
        out = [wp.empty(self.count, dtype=dtype, device=self.device) for dtype in types]
        decompose.launch(factory, function, A, out)
        return tuple(self._like(array, shape) for array, shape in zip(out, shapes, strict=True))

    def _like(self, array, shape):
        if not self.warp:
            return array.numpy().reshape(*self.batch, *shape)
        if self.typed:
            return array.reshape(self.batch)
        numbers = wp.array(ptr=array.ptr, shape=(*self.batch, *shape), dtype=self.scalar, device=self.device)
        numbers.matrices = array  # keeps the memory alive
        return numbers
