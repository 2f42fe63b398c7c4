"""The gradient of the energy of a model."""

from ..base.turns import in_turn
from ..kernels import assemble
from ..kernels.contact.clear_elements import add_gradient
from ..terms.refresh import EVALUATION, Moment
from .dynamic import dynamic_of
from .transpose import Transpose


class Gradient:
    """The gradient ∂U/∂x = Dᵀ(kA ∂u/∂y) [N] of all terms or of the ``terms`` given, one launch for each.

    It includes the dynamic elements of the model, or with ``terms`` those given.
    """

    @in_turn
    def __init__(self, model, corrected=False, terms=None, dynamic=()):
        self.model, self.terms = model, model.terms if terms is None else terms
        self.dynamic = dynamic_of(model, terms, dynamic)
        self._sums, self._clear = [], []
        for elements in self.terms:
            if corrected and elements.clear is not None:
                self._clear.append((elements, model.kernel(add_gradient, elements.term, model.dtype)))
                continue
            factories = assemble.scatter_gradient, assemble.gather_gradient
            data = assemble.elastic(elements.term, model.dtype)()
            data.stencil, data.stiffness = elements.stencil, elements.stiffness
            self._sums.append((Transpose(model, elements, *factories, elements.term, model.dtype, corrected), data))

    def add(self, x, out, correction=None):
        """Launches out += ∂U/∂x at x, or at x + correction if built with ``corrected``."""
        self.model.refresh(EVALUATION, Moment(x, correction), self.terms)
        for transpose, data in self._sums:
            data.x = x
            if correction is not None:
                data.d = correction
            transpose.add(data, out)
        for elements, kernel in self._clear:
            self.model.launch(kernel, 1, [*elements.arguments, elements.clear, x, correction], [out])
        self.dynamic.launch(x, correction)
        self.dynamic.add_gradient(out)
