"""A V-cycle of multigrid."""

import warp as wp

from ..kernels import v_cycle as kernels
from ..kernels.block_rows import block_rows, lanes_of_rows
from ..kernels.linear import multiply
from .multigrid import Multigrid


class VCycle(Multigrid):
    """A V-cycle with a Jacobi sweep before and one after the coarser levels, see :class:`.multigrid.Multigrid`."""

    def __init__(self, hessian):
        super().__init__(hessian)
        model, terms = self.model, hessian.terms_in_rows
        self._further = None if hessian.apart is None else model.vectors()
        self._weights = [[model.array(each[2].numpy(), model.dtype) for each in (T.rows, T.columns)] for T in self.transfers]
        self._r, self._x, self._d = (
            [wp.zeros(model.copies * n, dtype=model.vec3, device=model.device) for n in self.sizes] for _ in range(3)
        )
        products = kernels.subtract_product, kernels.sweep_after
        self._launch = model.launcher(
            (products, model.dtype, self._block),
            ((kernels.restrict, kernels.prolong), model.dtype),
            ((multiply,), model.dtype),
        )
        self._launch_finest = model.launcher((products, model.dtype, self._block, terms)) if terms else self._launch
        self._of_row = lanes_of_rows(self._block)
        of_levels = [len(level.columns) // model.copies for level in self.levels]
        blocks = 2 * sum(of_levels[:-1]) + of_levels[-1] * self.dense + sum(4 * n for n in self.sizes[:-1])
        self.cycle = self._cost_of_cycle(blocks, 4 * len(self.transfers) + self.dense + 1)

    def refine(self, r, z, active):
        """Launches the rest of a cycle: from z = S r to z ≈ A⁻¹ r, in the copies that are ``active`` (B,)."""
        B, right, x = self.model.copies, r, z
        for k, (transfer, coarser) in enumerate(zip(self.transfers, self.levels[1:], strict=True)):
            launch, further = self._with_dynamic(k, x, active)
            given = [self._rows(k), x, further, right, active, self.sizes[k]]
            launch(kernels.subtract_product, (B, self._threads(self.sizes[k] * self._of_row)), given, [self._r[k]])
            given = [*transfer.columns[:2], self._weights[k][1], self._r[k], coarser.sweep, active, *self.sizes[k : k + 2]]
            threads = self._threads(coarser.n)
            self._launch(kernels.restrict, (B, threads), [*given, threads], [self._r[k + 1], self._x[k + 1]])
            right, x = self._r[k + 1], self._x[k + 1]
        if self.dense:
            last = self.levels[-1]
            given = [last.offsets, last.columns, last.values, self._r[-1], active, last.n]
            self._launch(multiply, B * last.n, given, [self._x[-1]])
        for k in reversed(range(len(self.transfers))):
            given = [*self.transfers[k].rows[:2], self._weights[k][0], self._x[k + 1], active, *self.sizes[k : k + 2]]
            threads = self._threads(self.sizes[k])
            self._launch(kernels.prolong, (B, threads), [*given, threads], [self._d[k]])
            if k == 0:
                self.model.lock(self._d[k])
            launch, further = self._with_dynamic(k, self._d[k], active)
            given = [self._rows(k), self.levels[k].sweep, self._d[k], further, self._r[k], active, self.sizes[k]]
            launch(kernels.sweep_after, (B, self._threads(self.sizes[k] * self._of_row)), given, [self._x[k] if k else z])

    def _threads(self, count):
        """Returns the number of threads of a copy that share ``count`` items: one on the CPU."""
        return count if self._block else 1

    def _rows(self, k):
        """Returns the :func:`warpcloth.kernels.block_rows.block_rows` of a level, which holds no references."""
        if k == 0:
            return self.hessian.block_rows()
        level, rows = self.levels[k], block_rows(self.model.dtype)()
        rows.offsets, rows.columns, rows.values = level.offsets, level.columns, level.values
        return rows

    def _with_dynamic(self, k, x, active):
        """Returns the function that launches kernels of a level, and a product with x of dynamic elements that it lacks."""
        if k:
            return self._launch, None
        if self._further is not None:
            self._further.zero_()
            self.hessian.apart.add_products(x, self._further, active)
        return self._launch_finest, self._further
