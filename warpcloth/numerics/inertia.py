"""The quadratic part of the objective, s/2‖d‖²_M − load·Σ m g·d."""

import warp as wp

from ..kernels.minimise import add_inertia


class Inertia:
    """Adds inertia, and gravity if it acts as a force, to the objective and to its gradient.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        s: Weight of the inertia, 1/h² [1/s²].

    Attributes:
        s, load: s as given; the fraction of gravity that acts as a force, 0 by default.
        work: The summand of each vertex, (N,) [J].
    """

    def __init__(self, model, s):
        self.model, self.s, self.load = model, s, 0.0
        self.work = wp.zeros(model.count, dtype=wp.float64, device=model.device)
        self._kernel = model.kernel(add_inertia, model.dtype)

    def add(self, d, gradient):
        """Launches gradient (N,) += s M d − load·M g, g with loads, 0 for fixed coordinates; and sets ``work``."""
        model = self.model
        gravity, each = model.free_gravity
        given = [model.mass, model.inverse_mass, gravity, d, each, self.s, self.load]
        model.launch(self._kernel, model.count, given, [gradient, self.work])
        model.lock(gradient)
