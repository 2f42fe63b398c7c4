"""The gradient of all terms in one launch, which gathers over the elements of each vertex."""

from ..core.dynamic import dynamic_of
from ..kernels.fast.gather_forces import gather_forces
from ..terms.refresh import EVALUATION, Moment
from .gather_layout import gathered, lanes_of
from .structs import chained


class GatherGradient:
    """∂U/∂x of all terms [N], with the methods of :class:`warpcloth.core.gradient.Gradient`.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        corrected: Whether it is evaluated at x + correction.
        terms: :class:`warpcloth.model.elements.DeviceElements`, by default all of the model.
        dynamic: The dynamic elements if ``terms`` are given, else those of the model.
    """

    def __init__(self, model, corrected=False, terms=None, dynamic=()):
        self.model, self.terms, self._lanes = model, model.terms if terms is None else terms, lanes_of(model)
        self.dynamic = dynamic_of(model, terms, dynamic)
        self._found = [gathered(model, elements, rows=False) for elements in self.terms]  # the struct holds no references
        parts = tuple(part._replace(exact=corrected) for part, _arrays in self._found)
        self._kernel = model.kernel(gather_forces, parts, model.dtype, corrected, self._lanes) if parts else None
        self._chain = chained(parts, [arrays for _part, arrays in self._found], model.dtype)

    def add(self, x, out, correction=None):
        """Launches out += ∂U/∂x at x, or if ``corrected`` at x + correction."""
        model = self.model
        model.refresh(EVALUATION, Moment(x, correction), self.terms)
        if self._kernel:
            model.launch(self._kernel, model.count * self._lanes, [self._chain, x, correction], [out])
        self.dynamic.launch(x, correction)
        self.dynamic.add_gradient(out)
