"""The transpose of local coordinates, out += Dᵀz, for the elements of one term."""


class Transpose:
    """Adds Dᵀz to arrays of vertices: scatters from elements on the CPU, gathers by vertex on CUDA, in a fixed order.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        elements: The :class:`warpcloth.model.elements.DeviceElements` of the term.
        scatter, gather: The factories of the two kernels, see :mod:`warpcloth.kernels.transpose`.
        key: Arguments of both factories.
    """

    def __init__(self, model, elements, scatter, gather, *key):
        self.model, cuda = model, model.device.is_cuda
        self._kernel = model.kernel(gather if cuda else scatter, *key)
        if cuda:
            offsets, codes = elements.incidences  # built now, because during a capture it would only be recorded
            self._dim, self._given = len(offsets) - 1, [offsets, codes, elements.rest]
        else:
            self._dim, self._given = elements.count, [elements.stencil, elements.rest]

    def add(self, data, *out):
        """Launches out += Dᵀz, z from the struct ``data``."""
        self.model.launch(self._kernel, self._dim, [*self._given, data], out)
