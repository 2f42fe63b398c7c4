"""Jacobi sweeps, in which each constraint sees where its vertices were before: scattered on the CPU, gathered on CUDA.

Both take

- model, x, h, correction, multipliers: As :class:`warpcloth.numerics.sweeps.Sweep` has them.
- keys: Of each term (term, dtype, scalar).
- factors, scale: Factors of the Δλ of elements, of each term (B·E,), and of the moves of vertices, (N,).
- spread: The number of sweeps that finite stiffness is spread over, or None.
"""

import warp as wp

from ..kernels import project
from ..kernels.fast import gather_corrections as jacobi
from ..kernels.fast.parts import elements_of
from ..terms.refresh import EVALUATION, Moment
from .gather_layout import chain, filled, gathered_in_rows

RUN = 64  # sweeps of a graph, an even number


class Scatter:
    """Sweeps over elements, term by term, each with a pass over the vertices that moves them."""

    def __init__(self, model, x, h, correction, multipliers, keys, factors, scale, spread):
        self.model, self.x, self.correction, self.multipliers = model, x, correction, multipliers
        more = any(array is not None for array in multipliers), spread is not None
        self._kernels = [model.kernel(project.scatter_correction, *key, *more) for key in keys]
        self._apply, self._total = model.kernel(project.apply_correction, model.dtype), model.vectors()
        self._given, self._factors, self._scale = [h, spread or 1], factors, scale

    def launch_start(self):
        """d = 0, λ = 0."""
        for array in (self.correction, self._total, *self.multipliers):
            if array is not None:
                array.zero_()

    def launch(self):
        """One sweep."""
        model, d = self.model, self.correction
        model.refresh(EVALUATION, Moment(self.x, d))
        for elements, kernel, factor, lambdas in zip(model.terms, self._kernels, self._factors, self.multipliers, strict=True):
            given = [*elements.arguments, model.inverse_mass, self.x, d, *self._given, factor]
            model.launch(kernel, elements.count, given, [lambdas, self._total])
        model.launch(self._apply, model.count, [self._scale], [self._total, d])

    def parts(self, sweeps):
        """Pairs of a function that launches and of how many times it runs, for so many sweeps."""
        return [(self.launch, sweeps)]


class Gather:
    """Sweeps of one launch over vertices, see :mod:`gather_corrections`; d and λ go to and fro between two
    arrays."""

    def __init__(self, model, x, h, correction, multipliers, keys, factors, scale, spread):
        self.model, self.x, self.correction, self.multipliers = model, x, correction, multipliers
        more, count = any(array is not None for array in multipliers), model.count
        self._found = [  # whose memory the structs do not keep
            gathered_in_rows(elements, count, pairs=not more, factor=factor)
            for elements, factor in zip(model.terms, factors, strict=True)
        ]
        parts = tuple(
            jacobi.Projected(part, scalar, 0 in factor.strides, more, spread is not None)
            for (part, _arrays), (_term, _dtype, scalar), factor in zip(self._found, keys, factors, strict=True)
        )
        others = [None if array is None else wp.zeros_like(array) for array in multipliers]
        self._places = [(correction, *multipliers), (model.vectors(), *others)]
        self._chains = [
            _chain(parts, self._found, *lambdas, model.dtype) for lambdas in ((multipliers, others), (others, multipliers))
        ]
        self._rows = wp.zeros(count, dtype=wp.types.vector(4, model.dtype), device=model.device)
        self._pack = model.kernel(jacobi.pack, model.dtype)
        fast = model.device.is_cuda and model.dtype is wp.float32
        self._kernel = model.kernel(jacobi.sweep, parts, model.dtype, fast)
        self._given = [scale, self._rows, h, spread or 1]

    def launch_start(self):
        """d = 0, λ = 0."""
        self.model.launch(self._pack, self.model.count, [self.model.inverse_mass, self.x], [self._rows, self.correction])
        for array in self.multipliers:
            if array is not None:
                array.zero_()

    def launch(self, sweeps=1):
        """So many sweeps; what an odd number leaves in the other arrays is copied back."""
        model = self.model
        for sweep in range(sweeps):
            (before, *_), (after, *_) = self._places[sweep % 2], self._places[1 - sweep % 2]
            model.refresh(EVALUATION, Moment(self.x, before))
            model.launch(self._kernel, model.count, [self._chains[sweep % 2], *self._given, before], [after], block_dim=128)
        if sweeps % 2:
            for array, last in zip(*self._places, strict=True):
                if array is not None:
                    wp.copy(array, last)

    def parts(self, sweeps):
        """Pairs of a function that launches and of how many times it runs, for so many sweeps."""
        each = min(sweeps - sweeps % 2, RUN) or 1
        return [(lambda: self.launch(each), sweeps // each), (lambda: self.launch(sweeps % each), int(sweeps % each > 0))]


def _chain(parts, found, before, after, dtype):
    """The struct of all terms, with λ before and after a sweep."""
    structs = []
    for of, (_part, arrays), *lambdas in zip(parts, found, before, after, strict=True):
        elements = filled(elements_of(of.part, dtype), {name: array for name, array in arrays.items() if name != "factor"})
        structs.append({"elements": elements, "factor": arrays["factor"]})
        if of.multipliers:
            structs[-1] |= dict(zip(("before", "after"), lambdas, strict=True))
    return chain(parts, structs, dtype, jacobi.constraints_of)
