"""Jacobi sweeps that scatter the corrections of constraints to their vertices, for the CPU, where nothing need be atomic."""

from ..core.jacobi_sweeps import JacobiSweeps
from ..kernels.fast import scatter_corrections as kernels
from ..terms.refresh import EVALUATION, Moment


class ScatterSweeps(JacobiSweeps):
    """Sweeps of one launch a term, over elements that add to the moves of their vertices in order, and one that moves these.

    Arguments are those of :class:`warpcloth.core.jacobi_sweeps.JacobiSweeps`.
    """

    def __init__(self, model, x, h, correction, multipliers, keys, factors, scale, spread):
        self.model, self.x, self.correction, self.multipliers = model, x, correction, multipliers
        more = any(array is not None for array in multipliers), spread is not None
        self._kernels = [model.kernel(kernels.scatter_correction, *key, *more) for key in keys]
        self._apply, self._total = model.kernel(kernels.apply_correction, model.dtype), model.vectors()
        self._given, self._factors, self._scale = [h, spread or 1], factors, scale

    def launch(self, sweeps=1):
        """Launches so many sweeps."""
        model, d = self.model, self.correction
        for _ in range(sweeps):
            model.refresh(EVALUATION, Moment(self.x, d))
            for elements, kernel, factor, lambdas in zip(
                model.terms, self._kernels, self._factors, self.multipliers, strict=True
            ):
                given = [*elements.arguments, model.inverse_mass, factor, elements.clear, self.x, d, *self._given]
                model.launch(kernel, elements.count, given, [lambdas, self._total])
            model.launch(self._apply, model.count, [self._scale], [self._total, d])
