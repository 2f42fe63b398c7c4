"""The constraint rows of a model and their Schur complement J W Jᵀ + α̃, the matrix of constrained dynamics.

Each term has an object for its rows of J. Self-contact, rigid clusters and sparse cells have objects with the
same methods.
"""

from functools import cached_property

import numpy as np
import warp as wp

from ..core.capture import Mirror
from ..core.transpose import Transpose
from ..kernels import constraint_jacobian as jacobian
from ..kernels import constraint_rows as kernels
from ..kernels.elementwise import scale
from ..model.host_values import host_values
from ..terms.refresh import EVALUATION, Moment
from .cluster_rows import ClusterRows
from .pair_rows import PairRows
from .sparse_rows import SparseRows


class TermRows:
    """The rows of one term, see :mod:`warpcloth.kernels.constraint_rows`.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        elements: The :class:`warpcloth.model.elements.DeviceElements`.
        curved: Whether to add geometric stiffness.

    Attributes:
        count: Number of rows of one copy.
        slopes: The Jacobian of each element, see :func:`warpcloth.kernels.constraint_rows.slope_type`.
        key: Arguments of the factories of kernels.
    """

    def __init__(self, model, elements, curved):
        term = elements.term
        scalar = term.constraint is not None
        key = (term, model.dtype, scalar, curved and scalar)
        self.model, self.elements, self.key = model, elements, key
        self.rows = kernels.row_count(term, *key[2:])
        self.count = self.rows * elements.per_copy
        self.slopes = wp.zeros(elements.count, dtype=kernels.slope_type(*key), device=model.device)
        self._linearise, self._apply = model.kernel(kernels.linearise, *key), model.kernel(jacobian.apply_rows, *key)
        self._transpose = Transpose(model, elements, jacobian.scatter_rows, jacobian.gather_rows, *key)

    def set_layout(self, layout):
        """Sets the layout of its rows, a :class:`warpcloth.kernels.constraint_rows.RowLayout`."""
        self.layout = layout

    def launch_linearise(self, x, d, h, least, values):
        """Launches the linearisation of its rows at x + d, see :func:`warpcloth.kernels.constraint_rows.linearise`.

        Args:
            x: Positions (N,) [m].
            d: Correction (N,) [m].
            h: Step [s].
            least: Smallest compliance, relative to the diagonal of J W Jᵀ.
            values: The struct of the rows, which is written.
        """
        model = self.model
        given = [*self.elements.arguments, model.inverse_mass, x, d, h, least, self.layout]
        model.launch(self._linearise, self.elements.count, given, [self.slopes, values])

    def launch_apply(self, v, out, active=None):
        """Launches out += J v, for the copies that are ``active`` (B,), or for all if it is None."""
        given = [self.elements.stencil, self.elements.rest, self.slopes, v, self.layout, active]
        self.model.launch(self._apply, self.elements.count, given, [out])

    def launch_transpose(self, rows, out, active=None):
        """Launches out += Jᵀ rows, for the copies that are ``active`` (B,), or for all if it is None."""
        held = jacobian.held_rows(*self.key)()
        held.slopes, held.multipliers, held.layout = self.slopes, rows, self.layout
        if active is not None:
            held.active = active
        self._transpose.add(held, out)

    @cached_property
    def _in_full(self):
        """Scratch, kernel, rows and columns of :meth:`entries`, for one matrix of all copies."""
        elements, Q = self.elements, self.rows
        stencil = host_values(elements.stencil).astype(np.int64)
        E, K = stencil.shape
        blocks = Mirror(wp.zeros((E, Q * K), dtype=wp.vec3d, device=self.model.device))
        copy, e = np.divmod(np.arange(E), elements.per_copy)
        rows = copy * self.layout.rows_per_copy + self.layout.first + e * Q
        rows = np.broadcast_to(rows[:, None, None, None] + np.arange(Q)[None, None, :, None], (E, K, Q, 3))
        columns = np.broadcast_to(3 * stencil[:, :, None, None] + np.arange(3), (E, K, Q, 3))
        return blocks, self.model.kernel(jacobian.rows_in_full, *self.key), rows.ravel(), columns.ravel()

    def entries(self):
        """Returns J on the host: values, rows and columns."""
        blocks, kernel, rows, columns = self._in_full
        self.model.launch(kernel, self.elements.count, [self.elements.rest, self.slopes], [blocks.array])
        return blocks.read().ravel(), rows, columns


def _rows_of(model, elements, curved):
    """Returns the object for the rows of one term."""
    if elements.term.cell:
        return SparseRows(model, elements)
    return ClusterRows(model, elements) if elements.cells else TermRows(model, elements, curved)


class Constraints:
    """All constraint rows of a model, with the matrix A = J W Jᵀ + α̃, W the inverse masses.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        h: Step [s].
        curved: Whether to add geometric stiffness.

    Attributes:
        parts: The rows of each term, and then of dynamic elements.
        count, per_copy: Number of rows of all copies and of one.
        multipliers: λ (count,) [J·s² over the unit of the constraint].
        gap: C + α̃λ (count,).
        compliance, inverse: α̃, and the inverse diagonal of A, 0 where that is 0, (count,).
        residual, rounding, carried: (count,) [m], see :func:`warpcloth.kernels.constraint_rows.linearise`.
    """

    def __init__(self, model, h, curved):
        self.model, self.h = model, h
        self.parts = [_rows_of(model, elements, curved) for elements in model.terms]
        sizes = [elements.cells.per_copy if elements.term.cell else elements.per_copy for elements in model.terms]
        self.parts += [PairRows(model, each, curved) for each in model.dynamic]
        sizes += [each.capacity for each in model.dynamic]
        self._fresh = [elements for elements in model.terms if not elements.cells]  # rows of cells update themselves
        self.per_copy = sum(part.count for part in self.parts)
        self.count = self.per_copy * model.copies
        first = 0
        for part, size in zip(self.parts, sizes, strict=True):
            layout = kernels.RowLayout()
            layout.per_copy, layout.first, layout.rows_per_copy = size, first, self.per_copy
            part.set_layout(layout)
            first += part.count

        def rows(dtype=model.dtype):
            return wp.zeros(self.count, dtype=dtype, device=model.device)

        self.multipliers, self.gap, self.compliance, self.inverse = (rows() for _ in range(4))
        self.residual, self.rounding, self.carried = (rows(wp.float64) for _ in range(3))
        self._values = kernels.row_values(model.dtype)()
        self._values.multipliers, self._values.gap = self.multipliers, self.gap
        self._values.compliance, self._values.inverse = self.compliance, self.inverse
        self._values.residual, self._values.rounding, self._values.carried = self.residual, self.rounding, self.carried
        self._vectors = model.vectors()
        self._weigh, self._scale = (model.kernel(scale, model.dtype, numbers) for numbers in (False, True))
        self.vector = self.block = model.dtype
        # Without compliance, redundant hard rows would make A singular and λ undetermined.
        self.least = float(np.finfo(model.numpy_dtype).eps) ** 0.7

    def launch_linearise(self, x, d):
        """Launches the linearisation of all rows at x + d, with the present λ."""
        self.model.refresh(EVALUATION, Moment(x, d), self._fresh)
        for part in self.parts:
            part.launch_linearise(x, d, self.h, self.least, self._values)

    def launch_apply(self, v, out, active=None):
        """Launches out += J v; undefined for copies that are not ``active`` (B,), if that is given."""
        for part in self.parts:
            part.launch_apply(v, out, active)

    def launch_moves(self, rows, out, active=None):
        """Launches out = W Jᵀ rows, (N,) vectors, [m] for λ; undefined for copies that are not ``active`` (B,)."""
        out.zero_()
        for part in self.parts:
            part.launch_transpose(rows, out, active)
        self.model.launch(self._weigh, self.model.count, [self.model.inverse_mass, out], [out])
        self.model.lock(out)

    # The matrix A, for ConjugateGradients.

    block_rows = None

    def prepare(self):
        """Does nothing."""

    def multiply(self, p, q, active):
        """Launches q = A p, for the copies that are ``active`` (B,)."""
        self.launch_moves(p, self._vectors, active)
        self.model.launch(self._scale, self.count, [self.compliance, p], [q])
        self.launch_apply(self._vectors, q, active)

    def invert_diagonal(self, out):
        """Launches out = the inverse of the diagonal of A, 0 where that is 0."""
        wp.copy(out, self.inverse)

    @property
    def of_elements(self):
        """Whether there are rows, and all belong to elements with a fixed number of vertices."""
        return self.count > 0 and all(isinstance(part, TermRows) for part in self.parts)

    @cached_property
    def _on_host(self):
        """Inverse masses of coordinates, and the mirror of the compliances."""
        return self.model.coordinate_mobility(), Mirror(self.compliance)

    def matrices(self):
        """Returns A of each copy as scipy matrices in double precision."""
        from scipy.sparse import csr_matrix, diags

        n, R, copies = 3 * self.model.per_copy, self.per_copy, self.model.copies
        values, rows, columns = (np.concatenate(each) for each in zip(*(part.entries() for part in self.parts), strict=True))
        J = csr_matrix((values, (rows, columns)), shape=(self.count, copies * n))
        w, compliance = self._on_host
        compliance = compliance.read().astype(np.float64)
        found = []
        for copy in range(copies):
            own = J[copy * R : (copy + 1) * R, copy * n : (copy + 1) * n]
            weights = diags(w[copy * n : (copy + 1) * n])
            found.append((own @ weights @ own.T + diags(compliance[copy * R : (copy + 1) * R])).tocsc())
        return found
