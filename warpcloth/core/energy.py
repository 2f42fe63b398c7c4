"""The energy of a model."""

import warp as wp

from ..base.turns import in_turn
from ..kernels import assemble
from ..kernels.contact.clear_elements import add_energy
from ..terms.refresh import EVALUATION, Moment


class Energy:
    """The energy U [J] of each copy, of all terms or of the ``terms`` given."""

    @in_turn
    def __init__(self, model, sums, corrected=False, terms=None):
        self.model, self.sums, self.terms = model, sums, model.terms if terms is None else terms
        self.kernels, self.of_elements = [], []
        for elements in self.terms:
            if corrected and elements.clear is not None:
                self.kernels.append(model.kernel(add_energy, elements.term, model.dtype))
                self.of_elements.append(None)
                continue
            self.kernels.append(model.kernel(assemble.energy, elements.term, model.dtype, corrected))
            self.of_elements.append(wp.zeros(elements.count, dtype=wp.float64, device=model.device))

    def add(self, x, out, correction=None):
        """Launches out (B,) += U(x), or U(x + correction)."""
        self.model.refresh(EVALUATION, Moment(x, correction), self.terms)
        for elements, kernel, values in zip(self.terms, self.kernels, self.of_elements, strict=True):
            if values is None:
                given = [*elements.arguments, elements.clear, x, correction, elements.per_copy]
                self.model.launch(kernel, 1, given, [out])
                continue
            self.model.launch(kernel, elements.count, [*elements.arguments, x, correction], [values])
            self.sums.sum(values, elements.per_copy, out, accumulate=1)
