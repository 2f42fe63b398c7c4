"""The energy of a model."""

import warp as wp

from ..kernels import assemble
from ..terms.refresh import EVALUATION, Moment
from .dynamic import dynamic_of


class Energy:
    """The energy U [J] of each copy, of all terms or of the ``terms`` given.

    It includes the dynamic elements of the model, or with ``terms`` those given.
    """

    def __init__(self, model, sums, corrected=False, terms=None, dynamic=()):
        self.model, self.sums, self.terms = model, sums, model.terms if terms is None else terms
        self.dynamic = dynamic_of(model, terms, dynamic)
        self.kernels, self.of_elements = [], []
        for elements in self.terms:
            clearing = corrected and elements.clear is not None
            self.kernels.append(model.kernel(assemble.energy, elements.term, model.dtype, corrected, clearing))
            self.of_elements.append(wp.zeros(elements.count, dtype=wp.float64, device=model.device))

    def add(self, x, out, correction=None):
        """Launches out (B,) += U(x), or U(x + correction)."""
        self.model.refresh(EVALUATION, Moment(x, correction), self.terms)
        for elements, kernel, values in zip(self.terms, self.kernels, self.of_elements, strict=True):
            self.model.launch(kernel, elements.count, [*elements.arguments, x, correction, elements.clear], [values])
            self.sums.sum(values, elements.per_copy, out, accumulate=1)
        self.dynamic.launch(x, correction)
        self.dynamic.add_energy(self.sums, out)


class EnergyParts:
    """The energy U of each copy at x + correction as parts of sums, one launch for each term.

    The energies of dynamic elements are those of their last evaluation, which a gradient at x + correction makes.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        lanes: :class:`warpcloth.core.sums.Lanes`.
        sums: :class:`warpcloth.core.sums.Sums`.

    Attributes:
        parts: (T, B, blocks) [J], those of each term.
    """

    def __init__(self, model, lanes, sums):
        self.model, self._lanes, self._sums, self._dynamic = model, lanes, sums, dynamic_of(model)
        self.parts = lanes.parts(len(model.terms))
        keys = [(elements.term, model.dtype, lanes.block, elements.clear is not None) for elements in model.terms]
        self._kernels = [model.kernel(assemble.energy_parts, *key) for key in keys]

    def launch(self, x, correction, other=None):
        """Launches the ``parts``, and other (B,) += the energy of dynamic elements [J], if it is given."""
        model, lanes = self.model, self._lanes
        model.refresh(EVALUATION, Moment(x, correction))
        for k, (elements, kernel) in enumerate(zip(model.terms, self._kernels, strict=True)):
            given = [*elements.arguments, x, correction, elements.clear, elements.per_copy, lanes.count]
            model.launch(kernel, lanes.dim, given, [self.parts[k]])
        if other is not None:
            self._dynamic.add_energy(self._sums, other)
