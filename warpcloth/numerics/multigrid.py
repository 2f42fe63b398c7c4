"""The levels of multigrid, a preconditioner with which the number of iterations hardly depends on resolution."""

import numpy as np
import warp as wp

from ..core.block_pattern import dense_pattern, pattern_of_product, to_device
from ..core.sums import Lanes
from ..kernels import multigrid as kernels
from .interpolation import find, neighbours

# Meshes of fewer vertices are solved faster without.
MIN_VERTICES = 200
# A level of at most so many vertices gets no coarser one.
COARSEST = 12
# A coarsest level of at most so many vertices is solved by its dense inverse. One with more has many pieces that nothing joins.
DENSE = 48
# Pairs of self-contact have 4 vertices, and so a matrix of at most 4 times its diagonal blocks.
PAIRED = 4.0
# A launch on CUDA takes as long as reading so many blocks: 3 µs at 3 TB/s.
LAUNCH = 250_000


class LevelMatrix:
    """A level: its matrix in every copy.

    Attributes:
        n: Vertices of a copy.
        offsets, columns, diagonal, values: Block rows of all copies, as those of :class:`warpcloth.core.hessian.Hessian`.
        sweep: S (B·n,), the diagonal blocks of a Jacobi sweep.
    """

    def __init__(self, model, rows, n):
        """``rows`` has the block rows of all copies."""
        self.n, self.offsets, self.columns, self.diagonal, self.values = n, rows.offsets, rows.columns, rows.diagonal, None
        self.sweep = wp.zeros(model.copies * n, dtype=model.mat33, device=model.device)


class Transfer:
    """P from a coarser level, and the coarse matrix PᵀAP as Pᵀ(AP).

    Attributes:
        rows, columns: (offsets, columns, weights) of P and of Pᵀ, in float64.
        pattern, coarse: The patterns of AP and of PᵀAP of one copy, :class:`warpcloth.core.block_pattern.BlockPattern`.
        values: The blocks of AP in all copies.
    """

    def __init__(self, model, P, fine, dense, launch):
        """P is a :class:`.interpolation.Interpolation`, ``fine`` (offsets, columns) of A in one copy.

        If ``dense``, PᵀAP has all blocks. ``launch`` launches the kernels that list the blocks.
        """
        self.rows, self.columns = (_rows(model, *each) for each in ((P.offsets, P.parents, P.weights), P.transposed()))
        self.pattern = pattern = pattern_of_product(model, fine, self.rows[:2])
        product = pattern.offsets, pattern.columns
        self.coarse = dense_pattern(model, P.coarse) if dense else pattern_of_product(model, self.columns[:2], product)
        self.values = wp.zeros(model.copies * len(pattern.columns), dtype=model.mat33, device=model.device)
        self._product = _Product(model, fine, self.rows, product, launch)
        coarse = self.coarse.offsets, self.coarse.columns
        self._coarse = _Product(model, self.columns, product, coarse, launch, symmetric=True)

    def launch_matrix(self, values, due, coarse):
        """Launches AP and PᵀAP of A's ``values`` in the copies that are ``due`` (B,), or in all if that is None."""
        self._product.launch(values, due, self.values)
        self._coarse.launch(self.values, due, coarse)


class _Product:
    """A product of two sparse matrices, of which one has blocks and the other the same weights in all copies.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        left, right: Their (offsets, columns, weights) in one copy; without weights for blocks.
        pattern: (offsets, columns) of the product.
        launch: Launches the kernels that list the blocks.
        symmetric: Whether the product is symmetric. Then only blocks on the diagonal and right of it are computed.
    """

    def __init__(self, model, left, right, pattern, launch, symmetric=False):
        self._copies, self._launch, n, count = model.copies, launch, len(pattern[0]) - 1, len(pattern[1])

        def empty(size, dtype=wp.int32):
            return wp.empty(size, dtype=dtype, device=model.device)

        given = [_struct(*each) for each in (left, right, pattern)]
        offsets, columns, others = (array.numpy() for array in (*left[:2], right[0]))
        most = _starts(np.diff(_starts(np.diff(others)[columns])[offsets]))
        firsts, slots = to_device(model, most), empty(int(most[-1]))
        counts, mirrors = empty(n), empty(count)
        launch(kernels.find_slots, n, [*given, int(symmetric), firsts], [slots, counts, mirrors])
        starts = _starts(counts.numpy())
        ends, sources, weights = empty(count + 1), empty(int(starts[-1])), empty(int(starts[-1]), model.dtype)
        ends[:1].zero_()
        launch(kernels.list_multiples, n, [*given, slots, firsts, to_device(model, starts)], [ends[1:], sources, weights])
        blocks = np.stack([np.arange(count), mirrors.numpy()], axis=1).astype(np.int32)
        if symmetric:
            blocks = blocks[blocks[:, 1] >= blocks[:, 0]]
        self._sums, self._blocks = (ends, sources, weights), wp.array(blocks, dtype=wp.vec2i, device=model.device)

    def launch(self, values, due, out):
        """Launches the blocks ``out`` from the ``values`` of the blocks in the copies that are ``due`` (B,), or in all."""
        B, blocks = self._copies, self._blocks
        given = [*self._sums, blocks, values, due, len(values) // B, len(out) // B]
        threads = len(blocks) if values.device.is_cuda else 1
        self._launch(kernels.add_multiples, (B, threads), [*given, threads], [out])


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


class Multigrid:
    """Approximates A⁻¹ in each copy by sweeps on levels, of which :meth:`refine` of a subclass says how.

    The coarse matrices are PᵀAP (Galerkin) with P of :mod:`warpcloth.numerics.interpolation`. The result is symmetric and
    positive definite for every A, so conjugate gradients may use it even if A is indefinite.

    Args:
        hessian: A, a :class:`warpcloth.core.hessian.Hessian`.

    Attributes:
        sweep: S of the finest level (N,). The first sweep is z = S r, which the caller does.
        sizes: Vertices of each level of a copy, finer ones first.
        cycle: The cost of an iteration with multigrid over that of one with diagonal blocks.
    """

    def __init__(self, hessian):
        model = self.model = hessian.model
        self.hessian, n = hessian, model.per_copy
        blocks = len(hessian.columns) // model.copies
        pattern = hessian.offsets[: n + 1], hessian.columns[:blocks]
        joined = model.in_model(neighbours(model.scene.mesh))
        self.interpolations = found = find(model.rest_points, joined, model.inverse_mass.numpy()[:n] > 0.0, COARSEST)
        self.sizes = [n, *(P.coarse for P in found)]
        self.dense = len(found) > 0 and self.sizes[-1] <= DENSE
        self._block = Lanes(model, 1).block
        self._lanes = kernels.LANES if self._block else 1
        of_matrix = kernels.list_multiples, kernels.add_multiples, kernels.factorise_diagonal, kernels.eliminate
        self._launch_matrix = model.launcher(
            (of_matrix, model.dtype), ((kernels.find_slots,),), ((kernels.scale_sweeps,), model.dtype, self._block)
        )
        self.levels, self.transfers = [LevelMatrix(model, hessian, n)], []
        self.levels[0].values = hessian.values
        for P in found:
            transfer = Transfer(model, P, pattern, self.dense and P is found[-1], self._launch_matrix)
            level = LevelMatrix(model, transfer.coarse.of_copies(model, []), P.coarse)
            level.values = wp.zeros(len(level.columns), dtype=model.mat33, device=model.device)
            self.levels.append(level)
            self.transfers.append(transfer)
            pattern = transfer.coarse.offsets, transfer.coarse.columns
        if self.dense:
            self._other = wp.zeros_like(self.levels[-1].values)
        self.sweep = self.levels[0].sweep
        self._factor = wp.zeros(model.count, dtype=model.mat33, device=model.device)

    def _cost_of_cycle(self, blocks, launches):
        """Returns the cost of an iteration with multigrid over that of one with diagonal blocks.

        It counts the ``blocks`` that both read, vectors as blocks of a third each, and ``launches`` on CUDA, all of one copy,
        so that a copy of a batch has the bits of a single one.
        """
        launch = LAUNCH if self._block else 0
        plain = len(self.hessian.columns) // self.model.copies + 4 * self.sizes[0] + 2 * launch
        return max(round((plain + blocks + launches * launch) / plain), 1)

    def update(self):
        """Launches the sweeps and the coarse matrices for the present A."""
        self.update_sweeps()
        self.update_coarse(None)

    def update_sweeps(self):
        """Launches the sweeps of the finest level for the present A."""
        self._set_sweeps(self.levels[0], PAIRED if self.hessian.dynamic else 1.0, None)

    def update_coarse(self, due):
        """Launches the coarse matrices for the present A in the copies that are ``due`` (B,), or in all if that is None."""
        for finer, level, transfer in zip(self.levels, self.levels[1:], self.transfers, strict=False):
            transfer.launch_matrix(finer.values, due, level.values)
            if level is not self.levels[-1] or not self.dense:
                self._set_sweeps(level, 1.0, due)
        if self.dense:
            self._invert(self.levels[-1], due)

    def _set_sweeps(self, level, own, due):
        count = self.model.copies * level.n
        factor = self._factor[:count]
        self._launch_matrix(kernels.factorise_diagonal, count, [level.diagonal, level.values, due, level.n], [factor])
        given = [level.offsets, level.columns, level.values, factor, due, level.n, own]
        self._launch_matrix(kernels.scale_sweeps, (count, self._lanes), given, [level.sweep])

    def _invert(self, level, due):
        """Launches the inversion of the dense matrices of the coarsest level."""
        before, after = level.values, self._other
        for p in range(level.n):
            self._launch_matrix(kernels.eliminate, (self.model.copies, level.n, level.n), [before, due, p, level.n], [after])
            before, after = after, before
        if before is not level.values:
            wp.copy(level.values, before)
