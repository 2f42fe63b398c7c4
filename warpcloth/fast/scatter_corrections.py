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
        self._threads = [1 if elements.clear is not None else elements.count for elements in model.terms]
        self._kernels = [
            model.kernel(kernels.scatter_correction, *key, *more, elements.clear is not None)
            for elements, key in zip(model.terms, keys, strict=True)
        ]
        self._apply, self._total = model.kernel(kernels.apply_correction, model.dtype), model.vectors()
        self._given, self._factors, self._scale = [h, spread or 1], factors, scale

    def launch(self, sweeps=1, then=None):
        """Launches so many sweeps, and ``then(d)`` after each."""
        model, d = self.model, self.correction
        for _ in range(sweeps):
            model.refresh(EVALUATION, Moment(self.x, d))
            of_terms = model.terms, self._kernels, self._threads, self._factors, self.multipliers
            for elements, kernel, threads, factor, lambdas in zip(*of_terms, strict=True):
                given = [*elements.arguments, model.inverse_mass, factor, elements.clear, self.x, d, *self._given]
                model.launch(kernel, threads, given, [lambdas, self._total])
            model.launch(self._apply, model.count, [self._scale], [self._total, d])
            if then is not None:
                then(d)
