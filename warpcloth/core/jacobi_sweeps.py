"""Plain Jacobi sweeps: local steps of the elements, the transpose, a move. Tests compare faster backends with them."""

import warp as wp

from ..kernels import jacobi as kernels
from ..kernels.transpose import stored
from ..terms.refresh import EVALUATION, Moment
from .transpose import Transpose


class JacobiSweeps:
    """Jacobi sweeps of several launches, on any device.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        x: x̃, (N,) vectors [m]; read only.
        h: Step [s].
        correction: d (N,) [m], which the sweeps update.
        multipliers: λ of each term, (B·E,) numbers or M × 3 matrices, or None.
        keys: For each term (term, dtype, whether to use its scalar constraint).
        factors: Factors of Δλ for each term, (B·E,).
        scale: Factors of the moves of vertices, (N,).
        spread: Number of sweeps over which the correction of finite stiffness is spread, or None.
    """

    def __init__(self, model, x, h, correction, multipliers, keys, factors, scale, spread):
        self.model, self.x, self.correction, self.multipliers = model, x, correction, multipliers
        more = any(array is not None for array in multipliers), spread is not None, model.mobility is not None
        self._move, self._total = model.kernel(kernels.move_vertices, model.dtype), model.vectors()
        self._given, self._scale, self._terms = [h, spread or 1], scale, []
        factories = kernels.scatter_moves, kernels.gather_moves
        for elements, key, factor, lambdas in zip(model.terms, keys, factors, multipliers, strict=True):
            data = stored(elements.term, model.dtype).data()
            z = wp.zeros(elements.count, dtype=wp.types.matrix((elements.term.rows, 3), model.dtype), device=model.device)
            data.z = z
            kernel = model.kernel(kernels.local_steps, *key, *more)
            transpose = Transpose(model, elements, *factories, elements.term, model.dtype)
            self._terms.append((elements, kernel, factor, lambdas, z, transpose, data))

    def launch_start(self):
        """Launches d = 0, λ = 0."""
        for array in (self.correction, self._total, *self.multipliers):
            if array is not None:
                array.zero_()

    def launch(self, sweeps=1, then=None):
        """Launches this number of sweeps, and ``then(d)`` after each, which may add to d (N,) [m]."""
        model, d = self.model, self.correction
        for _ in range(sweeps):
            model.refresh(EVALUATION, Moment(self.x, d))
            for elements, kernel, factor, lambdas, z, transpose, data in self._terms:
                given = [*elements.arguments, model.local_mobility, factor, self.x, d, *self._given]
                model.launch(kernel, elements.count, given, [lambdas, z])
                transpose.add(data, self._total)
            model.lock(self._total)
            model.launch(self._move, model.count, [model.inverse_mass, self._scale], [self._total, d])
            if then is not None:
                then(d)

    def parts(self, sweeps, then=None):
        """Returns pairs (function that launches, number of calls) for this number of sweeps, with ``then(d)`` after each."""
        return [(lambda: self.launch(1, then), sweeps)]
