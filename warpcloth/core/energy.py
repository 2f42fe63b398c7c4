"""The energy of a model."""

import warp as wp

from ..base.turns import in_turn
from ..kernels import assemble
from ..kernels.contact.clear_elements import add_energy
from ..terms.refresh import EVALUATION, Moment
from .dynamic import dynamic_of


class Energy:
    """The energy U [J] of each copy, of all terms or of the ``terms`` given.

    It includes the dynamic elements of the model, or with ``terms`` those given.
    """

    @in_turn
    def __init__(self, model, sums, corrected=False, terms=None, dynamic=()):
        self.model, self.sums, self.terms = model, sums, model.terms if terms is None else terms
        self.dynamic = dynamic_of(model, terms, dynamic)
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
        parts: (T, B, blocks) [J], those of each term that is not in ``other`` of :meth:`launch`.
    """

    @in_turn
    def __init__(self, model, lanes, sums):
        self.model, self._lanes, self._sums, self._dynamic = model, lanes, sums, dynamic_of(model)
        clear = [elements for elements in model.terms if elements.clear is not None]
        whole = [elements for elements in model.terms if elements.clear is None]
        self._clear = [(elements, model.kernel(add_energy, elements.term, model.dtype)) for elements in clear]
        key = model.dtype, lanes.block
        self.parts = lanes.parts(len(whole))
        kernels = [model.kernel(assemble.energy_parts, elements.term, *key) for elements in whole]
        self._whole = [(*each, self.parts[k]) for k, each in enumerate(zip(whole, kernels, strict=True))]

    def launch(self, x, correction, other):
        """Launches the ``parts``, and other (B,) += the energy of elements of colliders and of dynamic ones [J]."""
        model, lanes = self.model, self._lanes
        model.refresh(EVALUATION, Moment(x, correction))
        for elements, kernel, parts in self._whole:
            given = [*elements.arguments, x, correction, elements.per_copy, lanes.count]
            model.launch(kernel, lanes.dim, given, [parts])
        for elements, kernel in self._clear:
            model.launch(kernel, 1, [*elements.arguments, elements.clear, x, correction, elements.per_copy], [other])
        self._dynamic.add_energy(self._sums, other)
