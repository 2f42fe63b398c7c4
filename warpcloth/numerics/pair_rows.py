"""The constraint rows of dynamic elements in :class:`warpcloth.numerics.constraints.Constraints`."""

import numpy as np
import warp as wp

from ..core.scan import Scan
from ..kernels.contact import pair_rows as kernels


class PairRows:
    """The rows of dynamic elements, with the methods of :class:`.constraints.TermRows`.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        of: The :class:`warpcloth.core.dynamic_elements.DynamicElements`.
        curved: Whether to add geometric stiffness.

    Attributes:
        elements: None, because the number of the elements changes.
        per_copy: Number of slots; each copy has rows for all of them.
        count: Number of rows of one copy.
    """

    elements = None

    def __init__(self, model, of, curved):
        of.list_corners()
        curved = curved and of.term.rows == 1
        self.model, self._of, self._rows = model, of, 2 if curved else of.term.rows
        self._linearise = model.kernel(kernels.linearise_pair_rows, of.term, model.dtype, curved)
        self.per_copy = capacity = of.capacity
        self.count = self._rows * capacity
        self._slopes = kernels.PairSlopes()
        for name, kind in (("weights", wp.vec4d), ("first", wp.vec3d), ("second", wp.vec3d)):
            setattr(self._slopes, name, wp.zeros(capacity, dtype=kind, device=model.device))
        self._ranks = None
        if model.device.is_cuda:  # where slots are in any order
            self._ranks, self._starts, self._counts = (
                wp.zeros(size, dtype=wp.int32, device=model.device) for size in (capacity, model.count + 1, model.count)
            )
            self._firsts = Scan(model, model.count)
        factories = kernels.apply_pair_rows, kernels.gather_pair_rows
        self._apply, self._gather = (model.kernel(factory, model.dtype, self._rows == 2) for factory in factories)

    def set_layout(self, layout):
        """Sets the layout of its rows, a :class:`warpcloth.kernels.constraint_rows.RowLayout`."""
        self._layout = layout

    def launch_linearise(self, x, d, h, least, values):
        """As of the rows of a term."""
        model, of = self.model, self._of
        of.launch_rows(x, d)
        if self._ranks:
            model.launch(kernels.count_first_corners, model.count, [of.pairs], [self._counts])
            self._firsts.launch(self._counts, self._starts)
            model.launch(kernels.rank_pairs, model.count, [of.pairs, self._starts], [self._ranks])
        given = [of.pairs, model.inverse_mass, of.data, x, d, h, least, self._layout, self._ranks]
        model.launch(self._linearise, (model.copies, self.per_copy), given, [self._slopes, values])

    def launch_apply(self, v, out, active=None):
        """Launches out += J v, of all copies."""
        given = [self._of.pairs, self._slopes, v, self._layout, self._ranks]
        self.model.launch(self._apply, self.per_copy, given, [out])

    def launch_transpose(self, rows, out, active=None):
        """Launches out += Jᵀ rows, of all copies."""
        given = [self._of.pairs, self._slopes, rows, self._layout, self._ranks]
        self.model.launch(self._gather, self.model.count, given, [out])

    def entries(self):
        """Returns J on the host: values, rows and columns."""
        binds = np.flatnonzero(self._slopes.first.numpy().any(axis=1))
        names = ("first", "second")[: self._rows]
        slopes = np.stack([getattr(self._slopes, name).numpy()[binds] for name in names], axis=1)
        w = self._slopes.weights.numpy()[binds]
        stencils = self._of.pairs.stencils.numpy()[binds].astype(np.int64)
        layout, copy = self._layout, stencils[:, 0] // self.model.per_copy
        ranks = self._ranks.numpy()[binds] if self._ranks else binds
        first = copy * layout.rows_per_copy + layout.first + self._rows * ranks
        values = slopes[:, :, None, :] * w[:, None, :, None]
        rows = np.broadcast_to((first[:, None] + np.arange(self._rows))[:, :, None, None], values.shape)
        columns = np.broadcast_to((3 * stencils[:, :, None] + np.arange(3))[:, None], values.shape)
        return values.ravel(), rows.ravel(), columns.ravel()
