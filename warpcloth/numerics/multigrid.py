"""Multigrid as a preconditioner, with which the number of iterations hardly depends on resolution."""

import numpy as np
import warp as wp

from ..core.block_pattern import dense_pattern, pattern_of_product, to_device
from ..core.sums import Lanes
from ..kernels import multigrid as kernels
from ..kernels.block_rows import block_rows, lanes_of_rows
from ..kernels.linear import multiply
from .interpolation import find, neighbours

# Meshes of fewer vertices are solved faster without.
LEAST = 200
# A level of at most so many vertices gets no coarser one.
COARSEST = 12
# A coarsest level of at most so many vertices is solved by its dense inverse. One with more has many pieces that nothing joins.
DENSE = 48
# Pairs of self-contact have 4 vertices, and so a matrix of at most 4 times its diagonal blocks.
PAIRED = 4.0
# A launch on CUDA takes as long as reading so many blocks: 3 µs at 3 TB/s.
LAUNCH = 250_000


class _Level:
    """A level: its matrix in every copy, and its vectors.

    Attributes:
        n: Vertices of a copy.
        offsets, columns, diagonal, values: Block rows of all copies, as those of :class:`warpcloth.core.hessian.Hessian`.
        sweep: S (B·n,), the diagonal blocks of its sweeps.
        r, x, d: Residual, solution, and what the coarser level adds to it, (B·n,).
    """

    def __init__(self, model, pattern):
        """``pattern`` is that of one copy, a :class:`warpcloth.core.block_pattern.BlockPattern`."""
        whole, self.n, device = pattern.of_copies(model, []), len(pattern.diagonal), model.device
        self.offsets, self.columns, self.diagonal = whole.offsets, whole.columns, whole.diagonal
        self.values = wp.zeros(len(whole.columns), dtype=model.mat33, device=device)
        self.sweep = wp.zeros(model.copies * self.n, dtype=model.mat33, device=device)
        self.r, self.x, self.d = (wp.zeros(model.copies * self.n, dtype=model.vec3, device=device) for _ in range(3))
        self._dtype = model.dtype

    def block_rows(self):
        """Returns the :func:`warpcloth.kernels.block_rows.block_rows`, which holds no references."""
        rows = block_rows(self._dtype)()
        rows.offsets, rows.columns, rows.values = self.offsets, self.columns, self.values
        return rows


class _Finest:
    """The finest level: the matrix itself; its right-hand side and its solution are those of the caller."""

    def __init__(self, hessian):
        model, self.n = hessian.model, hessian.per_copy
        self.offsets, self.columns, self.diagonal, self.values = (
            hessian.offsets,
            hessian.columns,
            hessian.diagonal,
            hessian.values,
        )
        self.sweep = wp.zeros(model.count, dtype=model.mat33, device=model.device)
        self.r, self.d = model.vectors(), model.vectors()
        self.block_rows = hessian.block_rows


class _Transfer:
    """P from a coarser level, by rows and by columns, and the blocks of which those of PᵀAP are sums.

    Attributes:
        rows, columns: (offsets, columns, weights) of P and of Pᵀ.
        coarse: The pattern of PᵀAP of one copy, :class:`warpcloth.core.block_pattern.BlockPattern`.
        sums, blocks: (offsets, sources, weights) of the multiples, and (upper, lower) blocks, see
            :func:`warpcloth.kernels.multigrid.multiply_by_transfers`.
    """

    def __init__(self, model, P, fine, dense, launch):
        """P is a :class:`.interpolation.Interpolation`, ``fine`` (offsets, columns) of A in one copy.

        If ``dense``, PᵀAP has all blocks. ``launch`` launches the kernels that list the blocks.
        """
        by_rows, by_columns = (P.offsets, P.parents, P.weights), P.transposed()
        exact = [_rows(model, *each) for each in (by_rows, by_columns)]
        self.rows, self.columns = (
            [*each[:2], model.array(weights, model.dtype)]
            for each, (_, _, weights) in zip(exact, (by_rows, by_columns), strict=True)
        )
        if dense:
            self.coarse = dense_pattern(model, P.coarse)
        else:
            products = pattern_of_product(model, fine, self.rows[:2])
            self.coarse = pattern_of_product(model, self.columns[:2], (products.offsets, products.columns))
        self._list_multiples(model, [fine, *exact, (self.coarse.offsets, self.coarse.columns)], launch)

    def _list_multiples(self, model, matrices, launch):
        """Finds ``sums`` and ``blocks`` from the rows of A, P, Pᵀ and PᵀAP."""
        n, count = len(self.coarse.diagonal), len(self.coarse.columns)

        def empty(size, dtype=wp.int32):
            return wp.empty(size, dtype=dtype, device=model.device)

        given = [_struct(*each) for each in matrices]
        (A_offsets, A_columns), P, transposed = ([array.numpy() for array in each[:2]] for each in matrices[:3])
        of_rows = _sums(np.diff(P[0])[A_columns], A_offsets)  # products of each row of A with the weights of its columns
        most = _starts(_sums(of_rows[transposed[1]], transposed[0]))
        firsts, slots = to_device(model, most), empty(int(most[-1]))
        counts, mirrors = empty(n), empty(count)
        launch(kernels.find_slots, n, [*given, firsts], [slots, counts, mirrors])
        starts = _starts(counts.numpy())
        ends, sources, weights = empty(count + 1), empty(int(starts[-1])), empty(int(starts[-1]), model.dtype)
        ends[:1].zero_()
        launch(kernels.list_multiples, n, [*given, slots, firsts, to_device(model, starts)], [ends[1:], sources, weights])
        mirrors = mirrors.numpy()
        upper = np.flatnonzero(mirrors >= np.arange(count))
        pairs = np.stack([upper, mirrors[upper]], axis=1).astype(np.int32)
        self.sums, self.blocks = (ends, sources, weights), wp.array(pairs, dtype=wp.vec2i, device=model.device)


def _rows(model, offsets, columns, weights):
    """Returns a matrix in compressed rows on the device, with weights in float64."""
    return *(to_device(model, each) for each in (offsets, columns)), wp.array(weights, dtype=wp.float64, device=model.device)


def _struct(offsets, columns, weights=None):
    """Returns the :class:`warpcloth.kernels.multigrid.Rows`, which hold no references."""
    rows = kernels.Rows()
    rows.offsets, rows.columns, rows.weights = offsets, columns, weights
    return rows


def _starts(counts):
    """Returns the sums of the counts before each, and of all."""
    return np.append(0, np.cumsum(counts))


def _sums(values, offsets):
    """Returns the sum of the values of each row."""
    return np.diff(_starts(values)[offsets])


class Multigrid:
    """Approximates A⁻¹ in each copy by a V-cycle with a Jacobi sweep before and one after the coarser levels.

    The coarse matrices are PᵀAP (Galerkin) with P of :mod:`warpcloth.numerics.interpolation`. The result is symmetric and
    positive definite for every A, so conjugate gradients may use it even if A is indefinite.

    Args:
        hessian: A, a :class:`warpcloth.core.hessian.Hessian`.

    Attributes:
        sweep: S of the finest level (N,). The first sweep is z = S r, which the caller does.
        sizes: Vertices of each level of a copy, finer ones first.
        cycle: The cost of an iteration with a cycle over that of one with diagonal blocks.
    """

    def __init__(self, hessian):
        model = self.model = hessian.model
        self.hessian, n = hessian, model.per_copy
        blocks = len(hessian.columns) // model.copies
        pattern = hessian.offsets[: n + 1], hessian.columns[:blocks]
        joined = model.in_model(neighbours(model.scene.mesh))
        found = find(model.rest_points, joined, model.inverse_mass.numpy()[:n] > 0.0, COARSEST)
        self.sizes = [n, *(P.coarse for P in found)]
        self._dense = len(found) > 0 and self.sizes[-1] <= DENSE
        self._levels, self._transfers = [_Finest(hessian)], []
        self._make_kernels()
        for P in found:
            self._transfers.append(_Transfer(model, P, pattern, self._dense and P is found[-1], self._launch))
            coarse = self._transfers[-1].coarse
            self._levels.append(_Level(model, coarse))
            pattern = coarse.offsets, coarse.columns
        if self._dense:
            self._other = wp.zeros_like(self._levels[-1].values)
        self.sweep = self._levels[0].sweep
        self._factor = wp.zeros(model.count, dtype=model.mat33, device=model.device)
        self._further = None if hessian.apart is None else model.vectors()
        self.cycle = self._cost_of_cycle()

    def _make_kernels(self):
        model = self.model
        self._block = block = Lanes(model, 1).block
        self._lanes = lanes_of_rows(block)
        of_matrix = kernels.list_multiples, kernels.multiply_by_transfers, kernels.factorise_diagonal, kernels.scale_sweeps
        products = kernels.subtract_product, kernels.sweep_after
        of_vectors = kernels.eliminate, kernels.restrict, kernels.prolong
        self._launch = model.launcher(
            ((*of_matrix, *of_vectors), model.dtype),
            (products, model.dtype, block),
            ((multiply,), model.dtype),
            ((kernels.find_slots,),),
        )
        self._launch_finest, terms = self._launch, self.hessian.terms_in_rows
        if terms:
            self._launch_finest = model.launcher((products, model.dtype, block, terms))

    def _cost_of_cycle(self):
        """Returns the cost of an iteration with a cycle over that of one with diagonal blocks.

        It counts the blocks that both read, vectors as blocks of a third each, and launches on CUDA, all of one copy, so that a
        copy of a batch has the bits of a single one.
        """
        launch = LAUNCH if self.model.device.is_cuda else 0
        of_levels = [len(level.columns) // self.model.copies for level in self._levels]
        plain = of_levels[0] + 4 * self.sizes[0] + 2 * launch
        products = 2 * sum(of_levels[:-1]) + of_levels[-1] * (1 if self._dense else 0)
        vectors = sum(4 * n for n in self.sizes[:-1])
        launches = 4 * len(self._transfers) + self._dense + 1
        return max(round((plain + products + vectors + launches * launch) / plain), 1)

    def update(self):
        """Launches the sweeps and the coarse matrices for the present A."""
        self.update_sweeps()
        self.update_coarse(None)

    def update_sweeps(self):
        """Launches the sweeps of the finest level for the present A."""
        self._set_sweeps(self._levels[0], PAIRED if self.hessian.dynamic else 1.0, None)

    def update_coarse(self, due):
        """Launches the coarse matrices for the present A in the copies that are ``due`` (B,), or in all if that is None."""
        B = self.model.copies
        for finer, level, transfer in zip(self._levels, self._levels[1:], self._transfers, strict=False):
            given = [*transfer.sums, transfer.blocks, finer.values, due, len(finer.values) // B, len(level.values) // B]
            self._launch(kernels.multiply_by_transfers, (B, len(transfer.blocks)), given, [level.values])
            if level is not self._levels[-1] or not self._dense:
                self._set_sweeps(level, 1.0, due)
        if self._dense:
            self._invert(self._levels[-1], due)

    def refine(self, r, z, active):
        """Launches the rest of a cycle: from z = S r to z ≈ A⁻¹ r, in the copies that are ``active`` (B,)."""
        if not self._transfers:
            return
        B, last = self.model.copies, self._levels[-1]
        right, x = r, z
        for finer, level, transfer in zip(self._levels, self._levels[1:], self._transfers, strict=False):
            launch, further = self._with_dynamic(finer, x, active)
            given = [finer.block_rows(), x, further, right, active, finer.n]
            launch(kernels.subtract_product, (B, self._threads(finer.n * self._lanes)), given, [finer.r])
            threads = self._threads(level.n)
            given = [*transfer.columns, finer.r, level.sweep, active, finer.n, level.n, threads]
            self._launch(kernels.restrict, (B, threads), given, [level.r, level.x])
            right, x = level.r, level.x
        if self._dense:
            given = [last.offsets, last.columns, last.values, last.r, active, last.n]
            self._launch(multiply, B * last.n, given, [last.x])
        for k in reversed(range(len(self._transfers))):
            level, coarser = self._levels[k], self._levels[k + 1]
            threads = self._threads(level.n)
            given = [*self._transfers[k].rows, coarser.x, active, level.n, coarser.n, threads]
            self._launch(kernels.prolong, (B, threads), given, [level.d])
            if k == 0:
                self.model.lock(level.d)
            launch, further = self._with_dynamic(level, level.d, active)
            given = [level.block_rows(), level.sweep, level.d, further, level.r, active, level.n]
            launch(kernels.sweep_after, (B, self._threads(level.n * self._lanes)), given, [level.x if k else z])

    def _threads(self, count):
        """Returns the number of threads of a copy that share ``count`` items: one on the CPU."""
        return count if self._block else 1

    def _with_dynamic(self, level, x, active):
        """Returns the function that launches kernels of a level, and a product with x of dynamic elements that it lacks."""
        if level is not self._levels[0]:
            return self._launch, None
        if self._further is not None:
            self._further.zero_()
            self.hessian.apart.add_products(x, self._further, active)
        return self._launch_finest, self._further

    def _set_sweeps(self, level, own, due):
        count = self.model.copies * level.n
        factor = self._factor[:count]
        self._launch(kernels.factorise_diagonal, count, [level.diagonal, level.values, due, level.n], [factor])
        given = [level.offsets, level.columns, level.values, factor, due, level.n, own]
        self._launch(kernels.scale_sweeps, count, given, [level.sweep])

    def _invert(self, level, due):
        """Launches the inversion of the dense matrices of the coarsest level."""
        before, after = level.values, self._other
        for p in range(level.n):
            self._launch(kernels.eliminate, (self.model.copies, level.n, level.n), [before, due, p, level.n], [after])
            before, after = after, before
        if before is not level.values:
            wp.copy(level.values, before)
