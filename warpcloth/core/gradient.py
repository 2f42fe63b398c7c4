"""The gradient of the energy of a model."""

from ..base.turns import in_turn
from ..kernels import assemble
from ..terms.refresh import EVALUATION, Moment
from .transpose import Transpose


class Gradient:
    """∂U/∂x of all terms [N], or of the ``terms`` given: Dᵀ(kA∂u/∂y), one launch for each term."""

    @in_turn
    def __init__(self, model, corrected=False, terms=None):
        self.model, self.terms = model, model.terms if terms is None else terms
        self._sums = []
        for elements in self.terms:
            factories = assemble.scatter_gradient, assemble.gather_gradient
            data = assemble.elastic(elements.term, model.dtype)()
            data.stencil, data.stiffness = elements.stencil, elements.stiffness
            self._sums.append((Transpose(model, elements, *factories, elements.term, model.dtype, corrected), data))

    def add(self, x, out, correction=None):
        """out += ∂U/∂x at x, or at x + correction if it was built ``corrected``."""
        self.model.refresh(EVALUATION, Moment(x, correction), self.terms)
        for transpose, data in self._sums:
            data.x = x
            if correction is not None:
                data.d = correction
            transpose.add(data, out)
