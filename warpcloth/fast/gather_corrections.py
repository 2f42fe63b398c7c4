"""Jacobi sweeps in one launch each, which gather over the constraints of each vertex, for CUDA."""

import warp as wp

from ..core.filled import filled
from ..kernels.fast import gather_corrections as kernels
from ..kernels.fast.term_facts import elements_struct
from ..terms.refresh import EVALUATION, Moment
from .gather_layout import gathered_in_rows
from .structs import chained

RUN = 64  # sweeps per graph, an even number


class GatherSweeps:
    """Sweeps in one launch over vertices each, see :mod:`warpcloth.kernels.fast.gather_corrections`.

    d and λ alternate between two arrays. The arguments are those of :class:`warpcloth.core.jacobi_sweeps.JacobiSweeps`.
    """

    def __init__(self, model, x, h, correction, multipliers, keys, factors, scale, spread):
        self.model, self.x, self.correction, self.multipliers = model, x, correction, multipliers
        more, count = any(array is not None for array in multipliers), model.count
        self._found = [  # the structs hold no references
            gathered_in_rows(model, elements, pairs=not more, factor=factor)
            for elements, factor in zip(model.terms, factors, strict=True)
        ]
        parts = tuple(
            kernels.Projected(part, scalar, 0 in factor.strides, more, spread is not None)
            for (part, _arrays), (_term, _dtype, scalar), factor in zip(self._found, keys, factors, strict=True)
        )
        others = [None if array is None else wp.zeros_like(array) for array in multipliers]
        self._states = [(correction, *multipliers), (model.vectors(), *others)]
        self._chains = [
            _chained(parts, self._found, *lambdas, model.dtype) for lambdas in ((multipliers, others), (others, multipliers))
        ]
        self._rows = wp.zeros(count, dtype=wp.types.vector(4, model.dtype), device=model.device)
        self._set_rows = model.kernel(kernels.set_vertex_rows, model.dtype)
        fast = model.device.is_cuda and model.dtype is wp.float32
        self._kernel = model.kernel(kernels.gather_corrections, parts, model.dtype, fast)
        self._scale, self._given = scale, [h, spread or 1]

    def launch_start(self):
        """Launches d = 0, λ = 0."""
        self.model.launch(self._set_rows, self.model.count, [self.model.inverse_mass, self.x], [self._rows, self.correction])
        for array in self.multipliers:
            if array is not None:
                array.zero_()

    def launch(self, sweeps=1, then=None):
        """Launches a number of sweeps, and ``then(d)`` after each; after an odd number, the second arrays are copied back."""
        model = self.model
        for sweep in range(sweeps):
            (before, *_), (after, *_) = self._states[sweep % 2], self._states[1 - sweep % 2]
            model.refresh(EVALUATION, Moment(self.x, before))
            given = [self._chains[sweep % 2], self._scale, self._rows, before, *self._given]
            model.launch(self._kernel, model.count, given, [after], block_dim=128)
            if then is not None:
                then(after)
        if sweeps % 2:
            for array, last in zip(*self._states, strict=True):
                if array is not None:
                    wp.copy(array, last)

    def parts(self, sweeps, then=None):
        """Returns pairs (launcher, number of calls) for a number of sweeps, with ``then(d)`` after each."""
        each = min(sweeps - sweeps % 2, RUN) or 1
        left = sweeps % each
        return [(lambda: self.launch(each, then), sweeps // each), (lambda: self.launch(left, then), int(left > 0))]


def _chained(parts, found, before, after, dtype):
    """Struct of all terms, with λ before and after a sweep."""
    structs = []
    for of, (_part, arrays), *lambdas in zip(parts, found, before, after, strict=True):
        values = {name: array for name, array in arrays.items() if name != "factor"}
        elements = filled(elements_struct(of.part, dtype), **values)
        structs.append({"elements": elements, "factor": arrays["factor"]})
        if of.multipliers:
            structs[-1] |= dict(zip(("before", "after"), lambdas, strict=True))
    return chained(parts, structs, dtype, kernels.constraints_of)
