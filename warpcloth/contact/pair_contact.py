"""The energy of self-contact in the steps of a solver."""

import warp as wp

from ..core.dynamic import DynamicElements
from ..kernels.contact import self_contact as kernels


class PairContact(DynamicElements):
    """Contact of the pairs of a :class:`warpcloth.contact.self_steps.SelfSteps`.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        bounded: Whether contact is that of explicit steps, without the logarithm.
        list_corners: See :meth:`warpcloth.core.dynamic.DynamicElements.list_corners`.

    Attributes:
        apart: Whether pairs never pass through one another where forces are computed.
        least: The least gap [m] of the filter if it keeps all pairs apart wherever forces are computed, otherwise 0.
    """

    def __init__(self, model, bounded, list_corners):
        super().__init__(model, kernels.CONTACT_OF_PAIRS)
        self.list_corners = list_corners
        self.apart, self.least = False, 0.0
        self._find = model.kernel(kernels.find_forces, model.dtype, bounded)

    def hold_pairs(self, pairs, begun):
        super().hold_pairs(pairs, begun)
        if self._in_turn:
            begun.clearance = self.room(wp.float64)

    def launch_forces(self, x, correction):
        given = [self.pairs, self.data, x, correction, self.apart, self.least]
        self.model.launch(self._find, self.capacity, given, [self.forces])

    def sweeps(self, in_turn):
        super().sweeps(in_turn)
        if self._in_turn:
            self._clear = self.model.kernel(kernels.find_clearances, self.model.dtype)

    def launch_sweep_start(self, x):
        super().launch_sweep_start(x)
        if self._in_turn:
            self.model.launch(self._clear, self.capacity, [self.pairs, x], [self.data])
