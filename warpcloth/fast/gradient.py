"""The gradient of the energy of a model, on CUDA of all terms in one launch."""

from ..base.turns import in_turn
from ..core.gradient import Gradient
from ..kernels.fast.gather_forces import gather_gradient
from ..terms.refresh import EVALUATION, Moment
from .gather_layout import chain, gathered, lanes


def gradient(model, corrected=False, terms=None):
    """The faster of :class:`warpcloth.core.gradient.Gradient` and :class:`GatheredGradient` on the device of the model."""
    return (GatheredGradient if model.device.is_cuda else Gradient)(model, corrected, terms)


class GatheredGradient:
    """:class:`warpcloth.core.gradient.Gradient` by one launch over vertices."""

    @in_turn
    def __init__(self, model, corrected=False, terms=None):
        self.model, self.terms = model, model.terms if terms is None else terms
        self._found = [gathered(model, elements, rows=False) for elements in self.terms]  # whose memory the structs do not keep
        parts = tuple(part for part, _arrays in self._found)
        self._lanes = lanes(model)
        self._gather = model.kernel(gather_gradient, parts, model.dtype, corrected, self._lanes) if parts else None
        self._chain = chain(parts, [arrays for _part, arrays in self._found], model.dtype)

    def add(self, x, out, correction=None):
        """out += ∂U/∂x at x, or at x + correction of one built ``corrected``."""
        self.model.refresh(EVALUATION, Moment(x, correction), self.terms)
        if self._gather:
            self.model.launch(self._gather, self.model.count * self._lanes, [self._chain, x, correction], [out])
