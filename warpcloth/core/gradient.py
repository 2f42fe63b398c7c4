"""The gradient of the energy of a model."""

from ..kernels import assemble
from ..terms.refresh import EVALUATION, Moment
from .dynamic import dynamic_of
from .transpose import Transpose


class Gradient:
    """The gradient ∂U/∂x = Dᵀ(kA ∂u/∂y) [N] of all terms or of the ``terms`` given, one launch for each.

    It includes the dynamic elements of the model, or with ``terms`` those given.
    """

    def __init__(self, model, corrected=False, terms=None, dynamic=()):
        self.model, self.terms = model, model.terms if terms is None else terms
        self.dynamic = dynamic_of(model, terms, dynamic)
        self._sums = []
        for elements in self.terms:
            factories, clearing = (
                (assemble.scatter_gradient, assemble.gather_gradient),
                corrected and elements.clear is not None,
            )
            data = assemble.elastic(elements.term, model.dtype)()
            data.stencil, data.stiffness = elements.stencil, elements.stiffness
            if clearing:
                data.clear = elements.clear
            self._sums.append((Transpose(model, elements, *factories, elements.term, model.dtype, corrected, clearing), data))

    def add(self, x, out, correction=None):
        """Launches out += ∂U/∂x at x, or at x + correction if built with ``corrected``."""
        self.model.refresh(EVALUATION, Moment(x, correction), self.terms)
        for transpose, data in self._sums:
            data.x = x
            if correction is not None:
                data.d = correction
            transpose.add(data, out)
        self.dynamic.launch(x, correction)
        self.dynamic.add_gradient(out)
