"""The constraint rows of cells with a quadratic energy, for :mod:`warpcloth.numerics.constraints`."""

import numpy as np
import warp as wp

from ..kernels import sparse_rows as kernels
from ..model.host_values import host_values


class SparseRows:
    """The rows of one term of sparse cells, see :mod:`warpcloth.kernels.sparse_rows`.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        elements: The :class:`warpcloth.model.elements.DeviceElements`, of sparse cells.

    Attributes:
        count: Number of rows of one copy.
    """

    def __init__(self, model, elements):
        self.model, self.elements, cells = model, elements, elements.cells
        self.rows = 3 * cells.term.rows
        self.count = self.rows * cells.per_copy
        factories = kernels.linearise_cells, kernels.apply_cell_rows, kernels.gather_cell_rows
        self._launch = model.launcher((factories, cells.term, model.dtype))
        self._of_elements = np.repeat(np.arange(cells.count), cells.sizes)
        self._cells = wp.array(self._of_elements.astype(np.int32), dtype=wp.int32, device=model.device)
        self._incidences = elements.incidences  # built now, because during a capture it would only be recorded

    def set_layout(self, layout):
        """Sets the layout of its rows, a :class:`warpcloth.kernels.constraint_rows.RowLayout`."""
        self.layout = layout

    def launch_linearise(self, x, d, h, least, values):
        """As :meth:`warpcloth.numerics.constraints.TermRows.launch_linearise`."""
        cells, elements = self.elements.cells, self.elements
        given = [cells.offsets, cells.weights, cells.rest, elements.stencil, elements.stiffness, self.model.inverse_mass]
        self._launch(kernels.linearise_cells, cells.count, [*given, x, d, h, least, self.layout], [values])

    def launch_apply(self, v, out, active=None):
        """Launches out += J v, of all copies."""
        cells, elements = self.elements.cells, self.elements
        given = [cells.offsets, cells.weights, elements.stencil, elements.stiffness, v, self.layout]
        self._launch(kernels.apply_cell_rows, cells.count, given, [out])

    def launch_transpose(self, rows, out, active=None):
        """Launches out += Jᵀ rows, of all copies."""
        given = [*self._incidences, self._cells, self.elements.cells.weights, self.elements.stiffness, rows, self.layout]
        self._launch(kernels.gather_cell_rows, len(self._incidences[0]) - 1, given, [out])

    def entries(self):
        """Returns J on the host: values, rows and columns."""
        cells, elements, layout = self.elements.cells, self.elements, self.layout
        held = host_values(elements.stiffness) != 0.0
        weights = np.where(held[:, None], host_values(cells.weights).astype(np.float64), 0.0)  # (E, M)
        copy, cell = np.divmod(self._of_elements, layout.per_copy)
        first = copy * layout.rows_per_copy + layout.first + cell * self.rows
        row, axis = np.arange(self.rows).reshape(-1, 3), np.arange(3)
        columns = 3 * host_values(elements.stencil)[:, 0].astype(np.int64)
        shape = (len(first), *row.shape)
        values = np.broadcast_to(weights[:, :, None], shape)
        return (
            values.ravel(),
            (first[:, None, None] + row).ravel(),
            np.broadcast_to(columns[:, None, None] + axis, shape).ravel(),
        )
