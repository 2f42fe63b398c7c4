"""The energy of a model."""

import warp as wp

from ..base.turns import in_turn
from ..kernels import assemble
from ..terms.refresh import EVALUATION, Moment


class Energy:
    """U of all terms of each copy [J], or of the ``terms`` given."""

    @in_turn
    def __init__(self, model, sums, corrected=False, terms=None):
        self.model, self.sums, self.terms = model, sums, model.terms if terms is None else terms
        self.kernels = [model.kernel(assemble.energy, elements.term, model.dtype, corrected) for elements in self.terms]
        self.of_elements = [wp.zeros(elements.count, dtype=wp.float64, device=model.device) for elements in self.terms]

    def add(self, x, out, correction=None):
        """out (B,) += U(x), or U(x + correction)."""
        self.model.refresh(EVALUATION, Moment(x, correction), self.terms)
        for elements, kernel, values in zip(self.terms, self.kernels, self.of_elements, strict=True):
            self.model.launch(kernel, elements.count, [*elements.arguments, x, correction], [values])
            self.sums.sum(values, elements.per_copy, out, accumulate=1)
