"""Additive multigrid with smoothed interpolation, which has no products with A and so few launches."""

import numpy as np
import warp as wp

from ..core.block_pattern import to_device
from ..kernels import additive_multigrid as kernels
from ..kernels.block_rows import LANES
from .multigrid import Multigrid
from .v_cycle import VCycle

# On CUDA one block, of THREADS threads, takes all levels of at most SMALL vertices.
THREADS, SMALL = 1024, 128


class AdditiveMultigrid(Multigrid):
    """Approximates A⁻¹ by M = S + P̄ M_c P̄ᵀ with P̄ = P − S A P; M_c does the same for the next coarser level.

    This is the simplified additive variant of a cycle by Vassilevski and Yang (2014, *Reducing communication in algebraic
    multigrid using additive variants*). If S were 2S − S A S, it would be the V-cycle. M of the coarsest level is its
    inverse, or S. Of pairs of self-contact, P̄ and coarse matrices take the diagonal blocks only.

    It takes 1.1 to 1.3 times the iterations of the V-cycle in contact, and 1.5 times in hanging cloth. On a GPU launches and
    products with pairs cost most, so that an iteration takes about half the time.
    """

    def __init__(self, hessian):
        super().__init__(hessian)
        model, self._structs, self._arrays = self.model, [], []
        self._launch = model.launcher(
            ((kernels.smooth_interpolation, kernels.restrict_smoothly, kernels.prolong_smoothly), model.dtype)
        )
        self._threads = THREADS if self._block else 1
        self._refine = model.kernel(kernels.refine, model.dtype, THREADS if self._block else 0)
        for k, P in enumerate(self.interpolations):
            self._add_transfer(k, P)
        kind = kernels.transfer(model.dtype)
        self._together = wp.array(self._structs, dtype=kind, device=model.device) if self._structs else None
        # Transfers that have launches of their own.
        self._apart = sum(size > SMALL for size in self.sizes[:-1]) if self._block else 0
        blocks = sum(2 * len(T.values) for T in self.transfers) // model.copies + 2 * sum(self.sizes)
        self.cycle = self._cost_of_cycle(blocks, 2 * self._apart + 1)

    def _add_transfer(self, k, P):
        """Makes the struct of P̄ from level k + 1, which holds no references, and its arrays."""
        model, pattern, coarse = self.model, self.transfers[k].pattern, self.levels[k + 1]
        of_column, of_row = pattern.columns.numpy(), pattern.rows.numpy()
        order = np.argsort(of_column, kind="stable")
        keys = np.repeat(np.arange(len(P.offsets) - 1), np.diff(P.offsets)) * np.int64(P.coarse) + P.parents
        weights = np.zeros(len(of_column))
        weights[np.searchsorted(of_row * np.int64(P.coarse) + of_column, keys)] = P.weights
        arrays = {
            "starts": to_device(model, np.append(0, np.cumsum(np.bincount(of_column, minlength=P.coarse)))),
            "entries": to_device(model, of_row[order]),
            "slots": to_device(model, np.argsort(order)),
            "by_column": wp.zeros_like(self.transfers[k].values),
            "weights": model.array(weights, model.dtype),
            **{name: wp.zeros(len(coarse.sweep), dtype=model.vec3, device=model.device) for name in ("r", "x")},
        }
        found = kernels.transfer(model.dtype)()
        found.rows, found.columns, found.values = pattern.offsets, pattern.columns, self.transfers[k].values
        found.sweep = coarse.sweep
        for name in ("starts", "entries", "by_column", "r", "x"):
            setattr(found, name, arrays[name])
        if self.dense and coarse is self.levels[-1]:
            found.dense = coarse.values
        found.n, found.coarse = self.sizes[k : k + 2]
        self._structs.append(found)
        self._arrays.append(arrays)

    def update_coarse(self, due):
        """Launches the coarse matrices and P̄ for the present A in the copies that are ``due`` (B,); None for all."""
        super().update_coarse(due)
        for k, (transfer, arrays) in enumerate(zip(self.transfers, self._arrays, strict=True)):
            pattern, mobility, finer = transfer.pattern, self.model.mobility if k == 0 else None, self.levels[k]
            given = [pattern.rows, arrays["slots"], arrays["weights"], mobility, finer.sweep, due, finer.n]
            dim = self.model.copies, len(pattern.columns)
            self._launch(kernels.smooth_interpolation, dim, given, [transfer.values, arrays["by_column"]])

    def refine(self, r, z, active):
        """Launches z += P̄ M_c P̄ᵀ r, so from z = S r to z = M r, in the copies that are ``active`` (B,)."""
        B, apart, count = self.model.copies, self._apart, len(self.transfers)
        right = [r, *(arrays["r"] for arrays in self._arrays)]
        out = [z, *(arrays["x"] for arrays in self._arrays)]
        for k in range(apart):
            given = [self._structs[k], right[k], active]
            self._launch(kernels.restrict_smoothly, (B, self.sizes[k + 1] * kernels.COLUMN_LANES), given, [])
        if apart < count:
            given = [self._together, right[apart], active, apart]
            block_dim = {"block_dim": THREADS} if self._block else {}
            self.model.launch(self._refine, (B, self._threads), given, [out[apart]], **block_dim)
        for k in reversed(range(apart)):
            self._launch(kernels.prolong_smoothly, (B, self.sizes[k] * LANES), [self._structs[k], active], [out[k]])


def multigrid_of(hessian):
    """Returns the multigrid of a :class:`warpcloth.core.hessian.Hessian`: additive for self-contact on CUDA, else a V-cycle."""
    return (AdditiveMultigrid if hessian.model.device.is_cuda and hessian.dynamic else VCycle)(hessian)
