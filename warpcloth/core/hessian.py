"""The second derivative of the energy of a model, as a sparse matrix."""

import numpy as np
import warp as wp

from ..base.turns import in_turn
from ..kernels import assemble, linear


class Hessian:
    """∂²U/∂x² + scale·M in block compressed rows, pinned vertices replaced by the identity; or of the ``terms`` given.

    Attributes:
        offsets, columns: Block rows (N+1,) and the column of each block.
        diagonal: Place of each diagonal block (N,).
        values: The blocks [N/m].
        policy: (B,) int32, a :class:`HessianPolicy` for each copy.
        count, per_copy, vector, block: Unknowns, those of a copy, the types of one and of a diagonal block.
    """

    @in_turn
    def __init__(self, model, policy=0, corrected=False, terms=None):
        self.count, self.per_copy, self.vector, self.block = model.count, model.per_copy, model.vec3, model.mat33
        self.model, self.terms = model, model.terms if terms is None else terms
        device = model.device
        self.kernels = [model.kernel(assemble.hessian_blocks, elements.term, model.dtype, corrected) for elements in self.terms]
        self.blocks = [
            wp.zeros((elements.count, elements.term.vertices**2), dtype=model.mat33, device=device) for elements in self.terms
        ]
        self.policy = wp.full(model.copies, int(policy), dtype=wp.int32, device=device)
        self._set_inertia = model.kernel(linear.set_inertia, model.dtype)
        self._add_blocks = model.kernel(linear.add_blocks, model.dtype)
        self._multiply = self._invert_diagonal = None
        self._find_pattern()

    def _find_pattern(self):
        """The blocks of the matrix and, for each, the element blocks that it is the sum of."""
        model, n = self.model, self.model.count
        fixed = model.inverse_mass.numpy() == 0.0
        keys, sources = [np.arange(n, dtype=np.int64) * (n + 1)], []
        for elements in self.terms:
            stencil = elements.stencil.numpy().astype(np.int64)
            K = stencil.shape[1]
            rows, columns = np.repeat(stencil, K, axis=1).ravel(), np.tile(stencil, K).ravel()
            source = np.flatnonzero(~(fixed[rows] | fixed[columns]))
            keys.append(rows[source] * n + columns[source])
            sources.append(source)
        unique, place = np.unique(np.concatenate(keys), return_inverse=True)

        def put(values):
            return wp.array(values.astype(np.int32), dtype=wp.int32, device=model.device)

        self.offsets = put(np.searchsorted(unique, np.arange(n + 1) * n))
        self.columns = put(unique % n)
        self.diagonal = put(place[:n])
        self.values = wp.zeros(len(unique), dtype=model.mat33, device=model.device)
        self.gathers, start = [], n
        for source in sources:
            target = place[start : start + len(source)]
            order = np.argsort(target, kind="stable")
            offsets = np.searchsorted(target[order], np.arange(len(unique) + 1))
            self.gathers.append((put(offsets), put(source[order])))
            start += len(source)

    def assemble(self, x, scale, correction=None):
        """Fills ``values`` at x, or x + correction, with ``scale`` times the masses on the diagonal."""
        model = self.model
        self.values.zero_()
        model.launch(self._set_inertia, model.count, [self.diagonal, model.mass, model.inverse_mass, scale], [self.values])
        for elements, kernel, blocks, gather in zip(self.terms, self.kernels, self.blocks, self.gathers, strict=True):
            arguments = [*elements.arguments, x, correction, elements.per_copy, self.policy]
            model.launch(kernel, elements.count, arguments, [blocks])
            model.launch(self._add_blocks, len(self.values), [*gather, blocks.flatten()], [self.values])

    def prepare(self):
        """Finds the kernels of :meth:`multiply` and :meth:`invert_diagonal`, which not every solver needs."""
        self._multiply = self.model.kernel(linear.multiply, self.model.dtype)
        self._invert_diagonal = self.model.kernel(linear.invert_diagonal, self.model.dtype)

    def multiply(self, p, q, active):
        """q = A p, of the copies that are ``active`` (B,)."""
        given = [self.offsets, self.columns, self.values, p, active, self.per_copy]
        self.model.launch(self._multiply, self.count, given, [q])

    def invert_diagonal(self, out):
        """out = the inverse diagonal blocks."""
        self.model.launch(self._invert_diagonal, self.count, [self.diagonal, self.values], [out])

    def matrices(self):
        """The values of now on the host, for each copy a scipy matrix in block compressed rows (3n, 3n), double precision."""
        from scipy.sparse import bsr_matrix

        n = self.model.per_copy
        offsets, columns, values = (array.numpy() for array in (self.offsets, self.columns, self.values))
        found = []
        for first in range(0, self.model.count, n):
            rows = offsets[first : first + n + 1]
            blocks = slice(rows[0], rows[-1])
            parts = values[blocks].astype(np.float64), columns[blocks] - first, rows - rows[0]
            found.append(bsr_matrix(parts, shape=(3 * n, 3 * n)))
        return found

    def matrix(self):
        """All copies in one scipy matrix (3N, 3N)."""
        from scipy.sparse import block_diag

        return block_diag(self.matrices(), format="csr")
