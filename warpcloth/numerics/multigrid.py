"""Multigrid as a preconditioner, with which the number of iterations hardly depends on resolution."""

import numpy as np
import warp as wp

from ..kernels import multigrid as kernels
from ..kernels.linear import multiply
from .interpolation import interpolations, neighbours

# Meshes of fewer vertices are solved faster without.
LEAST = 200
# A level of at most so many vertices gets no coarser one.
COARSEST = 12
# A coarsest level of at most so many vertices is solved by its dense inverse. One with more has many pieces that nothing joins.
DENSE = 48
# Pairs of self-contact have 4 vertices, and so a matrix of at most 4 times its diagonal blocks.
PAIRED = 4.0


class _Level:
    """A level: its matrix in every copy, and its vectors.

    Attributes:
        n: Vertices of a copy.
        offsets, columns, diagonal, values: Block rows of all copies, as those of :class:`warpcloth.core.hessian.Hessian`.
        sweep: S (B·n,), the diagonal blocks of its sweeps.
        r, x, d: Residual, solution, and what the coarser level adds to it, (B·n,).
    """

    def __init__(self, model, n, offsets, columns):
        """``offsets`` and ``columns`` are the block rows of one copy."""
        B, count, device = model.copies, len(columns), model.device
        copies = np.arange(B)[:, None]
        diagonal = np.flatnonzero(np.repeat(np.arange(n), np.diff(offsets)) == columns)

        def put(values):
            return wp.array(values.astype(np.int32), dtype=wp.int32, device=device)

        self.n = n
        self.offsets = put(np.append(offsets[:-1] + copies * count, B * count))
        self.columns, self.diagonal = put((columns + copies * n).ravel()), put((diagonal + copies * count).ravel())
        self.values = wp.zeros(B * count, dtype=model.mat33, device=device)
        self.sweep = wp.zeros(B * n, dtype=model.mat33, device=device)
        self.r, self.x, self.d = (wp.zeros(B * n, dtype=model.vec3, device=device) for _ in range(3))


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


class _Transfer:
    """P from a coarser level, by rows and by columns, and the blocks of which those of PᵀAP are sums."""

    def __init__(self, model, P, pattern, dense):
        """P is a scipy matrix (n, n_c), ``pattern`` the block rows (offsets, columns) of one copy of A."""
        device = model.device

        def put(values):
            return wp.array(values.astype(np.int32), dtype=wp.int32, device=device)

        def compressed(matrix):
            return put(matrix.indptr), put(matrix.indices), model.array(matrix.data, model.dtype)

        self.rows, self.columns = compressed(P), compressed(P.T.tocsr())
        entries, sources, weights, self.coarse = products(P, *pattern, dense)
        self.sums = put(entries), put(sources), model.array(weights, model.dtype)
        rows = np.repeat(np.arange(P.shape[1]), np.diff(self.coarse[0]))
        columns = self.coarse[1]
        upper = np.flatnonzero(rows <= columns)
        mirror = np.searchsorted(rows * P.shape[1] + columns, columns[upper].astype(np.int64) * P.shape[1] + rows[upper])
        self.blocks = wp.array(np.stack([upper, mirror], axis=1).astype(np.int32), dtype=wp.vec2i, device=device)


def products(P, offsets, columns, dense=False):
    """Finds the blocks of PᵀAP as sums over those of A, which is symmetric.

    Args:
        P: The interpolation, scipy (n, n_c).
        offsets: Starts of the block rows of A, (n + 1,).
        columns: Columns of its blocks.
        dense: Whether PᵀAP has all blocks.

    Returns:
        (starts, sources, weights, pattern): the upper block u is Σ weights·A[sources] over starts[u] … starts[u + 1] − 1, upper
        blocks in the order of ``pattern``, the block rows (offsets, columns) of PᵀAP.
    """
    n, coarse = P.shape
    rows = np.repeat(np.arange(n), np.diff(offsets))
    parents, shares = _padded(P)
    weights = shares[rows][:, :, None] * shares[columns][:, None, :]
    one = np.broadcast_to(parents[rows][:, :, None], weights.shape)
    two = np.broadcast_to(parents[columns][:, None, :], weights.shape)
    entries = np.flatnonzero((weights != 0.0) & (one <= two))
    keys = one.reshape(-1)[entries] * np.int64(coarse) + two.reshape(-1)[entries]
    keys, order = _by_key(keys, entries, coarse * coarse, weights.size)
    if dense:
        one, two = np.triu_indices(coarse)
        unique = one * coarse + two
    else:
        diagonal = np.arange(coarse, dtype=np.int64) * (coarse + 1)
        unique = np.union1d(keys[np.flatnonzero(np.diff(keys, prepend=-1))], diagonal)
    starts = np.searchsorted(keys, np.append(unique, coarse * coarse))
    one, two = np.divmod(unique, coarse)
    lower = one != two
    whole = np.sort(np.concatenate([unique, two[lower] * coarse + one[lower]]))
    pattern = np.searchsorted(whole, np.arange(coarse + 1) * coarse), whole % coarse
    return starts, order // weights[0].size, weights.reshape(-1)[order], pattern


def _padded(P):
    """Returns the parents and the weights of each row of P, (n, most), with weights of 0 behind the last."""
    count = np.diff(P.indptr)
    rows = np.repeat(np.arange(len(count)), count)
    at = np.arange(len(rows)) - P.indptr[rows]
    parents = np.zeros((len(count), count.max()), dtype=np.int32)
    weights = np.zeros(parents.shape)
    parents[rows, at], weights[rows, at] = P.indices, P.data
    return parents, weights


def _by_key(keys, entries, most_keys, most_entries):
    """Returns both sorted by key, then by entry; as packed numbers, if they fit, which is several times as fast."""
    if most_keys * most_entries < 2**62:
        packed = np.sort(keys * most_entries + entries)
        return np.divmod(packed, most_entries)
    order = np.argsort(keys, kind="stable")
    return keys[order], entries[order]


class Multigrid:
    """Approximates A⁻¹ in each copy by a V-cycle with a Jacobi sweep before and one after the coarser levels.

    The coarse matrices are PᵀAP (Galerkin) with P of :mod:`warpcloth.numerics.interpolation`. They are computed again after
    :meth:`outdate`, or if a solve was slow. The result is symmetric and positive definite for every A, so conjugate gradients
    may use it even if A is indefinite.

    Args:
        hessian: A, a :class:`warpcloth.core.hessian.Hessian`.
        iterations: Maximum number of iterations of one solve.

    Attributes:
        sweep: S of the finest level (N,). The first sweep is z = S r, which the caller does.
        sizes: Vertices of each level of a copy, finer ones first.
        used: Whether the next solve uses multigrid, (1,) int32 on the device.
    """

    def __init__(self, hessian, iterations):
        model = self.model = hessian.model
        self.hessian, n = hessian, model.per_copy
        offsets = hessian.offsets.numpy()[: n + 1]
        pattern = offsets, hessian.columns.numpy()[: offsets[-1]]
        joined = model.in_model(neighbours(model.scene.mesh))
        found = interpolations(model.rest_points, joined, model.inverse_mass.numpy()[:n] > 0.0, COARSEST)
        self.sizes = [n, *(P.shape[1] for P in found)]
        self._dense = len(found) > 0 and self.sizes[-1] <= DENSE
        self._levels, self._transfers = [_Finest(hessian)], []
        for P in found:
            self._transfers.append(_Transfer(model, P, pattern, dense=self._dense and P is found[-1]))
            pattern = self._transfers[-1].coarse
            self._levels.append(_Level(model, P.shape[1], *pattern))
        if self._dense:
            self._other = wp.zeros_like(self._levels[-1].values)
        self.sweep = self._levels[0].sweep
        self._factor = wp.zeros(model.count, dtype=model.mat33, device=model.device)
        self._further = None if hessian.pairs is None else model.vectors()
        self._choice, self._iterations = kernels.PreconditionerChoice(), iterations
        choice = self._choice
        choice.used, choice.outdated, choice.fresh = (wp.ones(1, dtype=wp.int32, device=model.device) for _ in range(3))
        choice.progress = wp.zeros(1, dtype=wp.float64, device=model.device)
        choice.rates = wp.zeros(2, dtype=wp.float64, device=model.device)
        choice.ages = wp.zeros(2, dtype=wp.int32, device=model.device)
        self.used = choice.used
        of_matrix = kernels.multiply_by_transfers, kernels.factorise_diagonal, kernels.scale_sweeps, kernels.eliminate
        products = kernels.subtract_product, kernels.sweep_after
        self._launch = model.launcher(
            (of_matrix + products + (kernels.restrict, kernels.prolong), model.dtype),
            ((multiply,), model.dtype),
            ((kernels.measure_progress, kernels.choose),),
        )
        self._launch_finest = self._launch
        if self._further is not None:
            self._launch_finest = model.launcher((products, model.dtype, True))

    def update(self):
        """Launches the sweeps of the finest level for the present A, and the coarse matrices if they are ``outdated``."""
        self._set_sweeps(self._levels[0], 1.0 if self._further is None else PAIRED)
        if self._transfers:
            wp.capture_if(self._choice.outdated, self._update_coarse)

    def outdate(self):
        """Launches that the next :meth:`update` computes the coarse matrices."""
        self._choice.outdated.fill_(1)

    def choose(self, solves):
        """Launches the choice whether the next solve uses multigrid, see :func:`warpcloth.kernels.multigrid.choose`."""
        self._launch(kernels.measure_progress, self.model.copies, [solves], [self._choice])
        self._launch(kernels.choose, 1, [self._iterations], [solves, self._choice])

    def refine(self, r, z, active):
        """Launches the rest of a cycle: from z = S r to z ≈ A⁻¹ r, in the copies that are ``active`` (B,)."""
        if not self._transfers:
            return
        B, last = self.model.copies, self._levels[-1]
        right, x = r, z
        for finer, level, transfer in zip(self._levels, self._levels[1:], self._transfers, strict=False):
            launch, further = self._with_pairs(finer, x, active)
            given = [finer.offsets, finer.columns, finer.values, x, further, right, active, finer.n]
            launch(kernels.subtract_product, B * finer.n, given, [finer.r])
            given = [*transfer.columns, finer.r, level.sweep, active, finer.n, level.n]
            self._launch(kernels.restrict, (B, level.n), given, [level.r, level.x])
            right, x = level.r, level.x
        if self._dense:
            given = [last.offsets, last.columns, last.values, last.r, active, last.n]
            self._launch(multiply, B * last.n, given, [last.x])
        for k in reversed(range(len(self._transfers))):
            level, coarser = self._levels[k], self._levels[k + 1]
            given = [*self._transfers[k].rows, coarser.x, active, level.n, coarser.n]
            self._launch(kernels.prolong, (B, level.n), given, [level.d])
            if k == 0:
                self.model.lock(level.d)
            launch, further = self._with_pairs(level, level.d, active)
            given = [level.offsets, level.columns, level.values, level.sweep, level.d, further, level.r, active, level.n]
            launch(kernels.sweep_after, B * level.n, given, [level.x if k else z])

    def _with_pairs(self, level, x, active):
        """Returns the function that launches kernels of a level, and its further product with x, that of pairs."""
        if self._further is None or level is not self._levels[0]:
            return self._launch, None
        self._further.zero_()
        self.hessian.pairs.forces.add_products(x, self._further, active)
        return self._launch_finest, self._further

    def _update_coarse(self):
        B = self.model.copies
        for finer, level, transfer in zip(self._levels, self._levels[1:], self._transfers, strict=False):
            given = [*transfer.sums, transfer.blocks, finer.values, len(finer.values) // B, len(level.values) // B]
            self._launch(kernels.multiply_by_transfers, (B, len(transfer.blocks)), given, [level.values])
            if level is not self._levels[-1] or not self._dense:
                self._set_sweeps(level, 1.0)
        if self._dense:
            self._invert(self._levels[-1])
        self._choice.fresh.fill_(-1)

    def _set_sweeps(self, level, own):
        count = self.model.copies * level.n
        factor = self._factor[:count]
        self._launch(kernels.factorise_diagonal, count, [level.diagonal, level.values], [factor])
        given = [level.offsets, level.columns, level.values, factor, own]
        self._launch(kernels.scale_sweeps, count, given, [level.sweep])

    def _invert(self, level):
        """Launches the inversion of the dense matrices of the coarsest level."""
        before, after = level.values, self._other
        for p in range(level.n):
            self._launch(kernels.eliminate, (self.model.copies, level.n, level.n), [before, p, level.n], [after])
            before, after = after, before
        if before is not level.values:
            wp.copy(level.values, before)
