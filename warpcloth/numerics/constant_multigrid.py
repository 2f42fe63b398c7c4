"""Multigrid for the constant matrices of projective dynamics and ADMM: a fixed number of cycles, for all copies at once."""

import time

import numpy as np
import warp as wp

from ..core.capture import Segment
from ..kernels import constant_multigrid as kernels
from ..kernels.multigrid import OMEGA
from .interpolation import interpolations, neighbours

# A level of at most so many vertices is solved by its dense inverse; a larger one without a coarser level by its sweeps.
DENSE = 300
# Cycles are repeated until the error, in the norm of the matrix, has fallen to this fraction, at most so many times.
LEFT, MAX_CYCLES = 0.4, 12
# Cycles by which the contraction is measured.
TRIALS = 15

_INDEFINITE = "the matrix is not positive definite, so it has no multigrid cycles"


class CopyCycles:
    """Approximates x = A⁻¹ b of each copy by V-cycles of multigrid, with a constant scalar matrix each.

    A cycle has a sweep of weighted Jacobi before and one after the coarser levels, with PᵀAP there. As the matrices are
    constant, sweeps and transfers are multiplied together once: with S of the sweeps, r_c = Qᵀr and x = Q x_c + T r with
    Q = (I − S A) P and T = 2S − S A S. So a level takes two launches.

    x = B b with a symmetric matrix B that is the same in all solves. Because (1 − ``error``) A⁻¹ ≤ B ≤ A⁻¹, a method that
    minimises with A as an upper bound of the Hessian does so with B⁻¹, and acceleration in the norm of the matrix is
    consistent, in that of B⁻¹. Conjugate gradients to a tolerance would have another B in each solve.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        matrices: A of each copy, scipy matrices (n, n) of one pattern, symmetric and positive definite.

    Attributes:
        error: ε of each copy (B,), an estimate of the largest error in the norm of A, relative to the solution.
        cycles: The largest number of cycles of a copy. Each has as many as it needs, whatever the other copies are.
        sizes: Vertices of each level of a copy, finer ones first.
        launches: Launches of a solve.
        seconds: Time of the setup [s].

    Raises:
        ValueError: A matrix is not finite; or its diagonal or that of a coarser one is not above 0, or the coarsest is not
            positive definite.
    """

    capturable = True

    def __init__(self, model, matrices):
        start = time.perf_counter()
        self.model = model
        distinct, of_copy = _distinct(matrices)
        self._of_copy = wp.array(np.array(of_copy, dtype=np.int32), dtype=wp.int32, device=model.device)
        self._kinds = kernels.constant_rows(model.dtype)
        hierarchies = _hierarchies(model, distinct)
        self.sizes = hierarchies[0].sizes
        contractions = np.array([hierarchy.contraction() for hierarchy in hierarchies])
        cycles = np.ceil(np.log(LEFT) / np.log(np.clip(contractions, LEFT, LEFT ** (1.0 / MAX_CYCLES)))).astype(np.int32)
        self.cycles, self.error = int(cycles.max()), (contractions**cycles)[of_copy]
        self._cycles = wp.array(cycles, dtype=wp.int32, device=model.device)
        self._levels = [
            tuple(self._rows([getattr(hierarchy, name)[k] for hierarchy in hierarchies]) for name in ("down", "up", "own"))
            for k in range(len(self.sizes) - 1)
        ]
        self._dense = hierarchies[0].inverse is not None
        if self._dense:
            self._last = model.array([hierarchy.inverse for hierarchy in hierarchies], model.dtype)
        else:
            self._last = self._rows([hierarchy.own[-1] for hierarchy in hierarchies])
        self._matrix = self._rows(distinct)
        self._residual = model.vectors()
        self._r, self._x = (
            [wp.zeros(model.copies * n, dtype=model.vec3, device=model.device) for n in self.sizes[1:]] for _ in range(2)
        )
        factories = kernels.multiply_constant, kernels.subtract_constant, kernels.multiply_dense, kernels.add_levels
        self._launch = model.launcher((factories, model.dtype))
        self._segments = {}
        self.launches = self.cycles * (2 * len(self._levels) + 1) + self.cycles - 1
        self.seconds = time.perf_counter() - start

    def solve(self, b, x):
        """Computes x = B b ≈ A⁻¹ b, both (N,) vectors. NaN in b is NaN in x of that copy.

        While a graph is captured it is launched into that; else a graph of its own is replayed, built on first use.
        """
        if self.model.device.is_capturing:
            self._launch_cycles(b, x)
            return
        key = b.ptr, x.ptr
        if key not in self._segments:
            self._segments[key] = Segment(self.model.device, lambda: self._launch_cycles(b, x))
        self._segments[key]()

    def _launch_cycles(self, b, x):
        for cycle in range(self.cycles):
            r = b
            if cycle:
                r = self._residual
                given = [self._cycles, self._matrix, x, b]
                self._launch_over(self.sizes[0], kernels.subtract_constant, given, r, cycle)
            self._launch_cycle(r, x, cycle > 0)

    def _launch_cycle(self, r, x, accumulate):
        """Launches x = B₁ r, or x += B₁ r, of one cycle."""
        sizes, right, found = self.sizes, [r, *self._r], [x, *self._x]
        last = len(sizes) - 1
        for k, (down, _up, _own) in enumerate(self._levels):
            self._launch_over(sizes[k + 1], kernels.multiply_constant, [down, right[k]], right[k + 1], sizes[k])
        if self._dense:
            self._launch_over(sizes[last], kernels.multiply_dense, [self._last, right[last]], found[last])
        else:
            self._launch_over(sizes[last], kernels.multiply_constant, [self._last, right[last]], found[last], sizes[last])
        for k in reversed(range(last)):
            _down, up, own = self._levels[k]
            given = [up, own, found[k + 1], right[k]]
            added = int(accumulate and k == 0)
            self._launch_over(sizes[k], kernels.add_levels, given, found[k], sizes[k + 1], added)

    def _launch_over(self, n, factory, given, out, *parameters):
        """Launches a kernel over (copies, n)."""
        self._launch(factory, (self.model.copies, n), [self._of_copy, *given, n, *parameters], [out])

    def _rows(self, matrices):
        """Returns sparse matrices, one of each kind of copy, as compressed rows of one pattern."""
        model, rows = self.model, self._kinds()
        offsets, columns, values = _in_one_pattern(matrices)
        rows.offsets = wp.array(offsets.astype(np.int32), dtype=wp.int32, device=model.device)
        rows.columns = wp.array(columns.astype(np.int32), dtype=wp.int32, device=model.device)
        rows.values = model.array(values, model.dtype)
        return rows


def _in_one_pattern(matrices):
    """Returns (offsets, columns, values) of matrices in compressed rows; values (matrices, m) are 0 where one has no entry."""
    for matrix in matrices:
        matrix.sum_duplicates()
    first = matrices[0]
    if all(
        np.array_equal(first.indptr, matrix.indptr) and np.array_equal(first.indices, matrix.indices) for matrix in matrices
    ):
        return first.indptr, first.indices, np.stack([matrix.data for matrix in matrices])
    count, width = first.shape
    rows = [np.repeat(np.arange(count, dtype=np.int64), np.diff(matrix.indptr)) for matrix in matrices]
    keys = [row * width + matrix.indices for row, matrix in zip(rows, matrices, strict=True)]
    pattern = np.unique(np.concatenate(keys))
    values = np.zeros((len(matrices), len(pattern)))
    for matrix, key, found in zip(matrices, keys, values, strict=True):
        found[np.searchsorted(pattern, key)] = matrix.data
    return np.searchsorted(pattern, np.arange(count + 1, dtype=np.int64) * width), pattern % width, values


def _distinct(matrices):
    """Returns the different ones of the matrices in compressed rows, and the index among them of each."""
    found, distinct, of_copy = {}, [], []
    for matrix in matrices:
        key = matrix.data.tobytes()
        if key not in found:
            found[key] = len(distinct)
            rows = matrix.tocsr().astype(np.float64)
            if not np.isfinite(rows.data).all():
                raise ValueError(f"the matrix has {np.count_nonzero(~np.isfinite(rows.data))} entries that are not finite")
            if not (rows.diagonal() > 0.0).all():
                raise ValueError(_INDEFINITE)
            distinct.append(rows)
        of_copy.append(found[key])
    return distinct, of_copy


def _hierarchies(model, matrices):
    """Returns the :class:`_Hierarchy` of each matrix, with levels for the vertices that an entry couples to others."""
    coupled = np.zeros(model.per_copy, dtype=bool)
    for matrix in matrices:
        coupled |= np.asarray(abs(matrix).sum(axis=1)).ravel() > matrix.diagonal()
    joined = model.in_model(neighbours(model.scene.mesh))
    transfers = interpolations(model.rest_points, joined, coupled, DENSE)
    return [_Hierarchy(matrix, transfers) for matrix in matrices]


class _Hierarchy:
    """The levels of a matrix, scipy matrices in float64.

    Attributes:
        sizes: Vertices of each level.
        down, up, own: Qᵀ, Q and T of each level, see :class:`CopyCycles`; those of the last level have no Q.
        inverse: The dense inverse of the last level, or None if that is too large.
    """

    def __init__(self, matrix, transfers):
        from scipy.sparse import diags_array, eye_array

        self.matrix, self.sizes, self.inverse = matrix, [matrix.shape[0]], None
        self.down, self.up, self.own = [], [], []
        for P in [*transfers, None]:
            if P is None and matrix.shape[0] <= DENSE:
                self.inverse = _inverse(matrix.toarray())
                return
            if not (matrix.diagonal() > 0.0).all():
                raise ValueError(_INDEFINITE)
            sweep = diags_array(_sweep(matrix))
            kept = eye_array(matrix.shape[0], format="csr") - sweep @ matrix
            self.own.append((sweep + kept @ sweep).tocsr())
            if P is not None:
                self.up.append((kept @ P).tocsr())
                self.down.append(self.up[-1].T.tocsr())
                matrix = (P.T @ matrix @ P).tocsr()
                self.sizes.append(matrix.shape[0])

    def contraction(self):
        """Returns the factor by which a cycle multiplies the error in the norm of the matrix, by power iteration."""
        x = np.random.default_rng(0).normal(size=self.sizes[0])
        found = 0.0
        for _ in range(TRIALS):
            x = x / np.sqrt(x @ (self.matrix @ x))
            x = x - self._cycle(self.matrix @ x)
            found = np.sqrt(max(x @ (self.matrix @ x), 0.0))
            if found == 0.0:
                break
        return found

    def _cycle(self, r):
        right = [r]
        for down in self.down:
            right.append(down @ right[-1])
        x = (self.own[-1] if self.inverse is None else self.inverse) @ right[-1]
        for k in reversed(range(len(self.up))):
            x = self.up[k] @ x + self.own[k] @ right[k]
        return x


def _inverse(matrix):
    """Returns the inverse of a dense symmetric matrix; raises ValueError if it is not positive definite."""
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise ValueError(_INDEFINITE) from None
    inverse = np.linalg.inv(matrix)
    return 0.5 * (inverse + inverse.T)


def _sweep(matrix):
    """Returns S (n,): the inverse diagonal for vertices that nothing couples, else ω/aᵢᵢΣⱼ|aᵢⱼ|/√(aᵢᵢaⱼⱼ), ω < 2.

    So no eigenvalue of S A is above ω, see :func:`warpcloth.kernels.multigrid.scale_sweeps`.
    """
    from scipy.sparse import diags_array

    diagonal = matrix.diagonal()
    scale = diags_array(1.0 / np.sqrt(diagonal))
    rows = np.asarray(abs(scale @ matrix @ scale).sum(axis=1)).ravel()
    return np.where(rows > 1.0 + 1e-12, OMEGA / (diagonal * rows), 1.0 / diagonal)
