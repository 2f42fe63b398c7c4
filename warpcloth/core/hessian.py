"""The second derivative of the energy of a model, as a sparse matrix."""

import numpy as np
import warp as wp

from ..base.turns import in_turn
from ..kernels import assemble, linear, sparse
from ..model.host_values import host_values


def _is_sparse(elements):
    return elements.cells is not None and elements.cells.weights is not None


class _Blocks:
    """The Hessian blocks of the elements of one term, (B·E, K²)."""

    def __init__(self, model, elements, corrected):
        self.model, self.elements, K = model, elements, elements.term.vertices
        self._kernel = model.kernel(assemble.hessian_blocks, elements.term, model.dtype, corrected)
        self.blocks = wp.zeros((elements.count, K * K), dtype=model.mat33, device=model.device)

    def pairs(self):
        """The row and the column of each block."""
        stencil = host_values(self.elements.stencil).astype(np.int64)
        K = stencil.shape[1]
        return np.repeat(stencil, K, axis=1).ravel(), np.tile(stencil, K).ravel()

    def launch(self, x, correction, policy):
        arguments = [*self.elements.arguments, x, correction, self.elements.per_copy, policy]
        self.model.launch(self._kernel, self.elements.count, arguments, [self.blocks])

    def add_norms(self, norms, rows):
        """Adds the norms of the blocks to their rows."""
        K = self.elements.term.vertices
        np.add.at(rows, host_values(self.elements.stencil), norms.reshape(-1, K, K).sum(axis=2))


class _SparseBlocks:
    """The Hessian blocks of the cells of one term, cell by cell, see :mod:`warpcloth.kernels.sparse`."""

    def __init__(self, model, elements, corrected):
        self.model, self.elements, cells = model, elements, elements.cells
        self._kernel = model.kernel(sparse.blocks, cells.term, model.dtype, corrected)
        self._starts, count = cells.blocks()
        self.blocks = wp.zeros(count, dtype=model.mat33, device=model.device)

    def pairs(self):
        """The row and the column of each block."""
        return self.elements.cells.pairs(self.elements)

    def launch(self, x, correction, policy):
        cells, elements = self.elements.cells, self.elements
        given = [cells.offsets, self._starts, elements.stencil, cells.weights, elements.stiffness, cells.rest]
        given += [x, correction, cells.per_copy, policy]
        self.model.launch(self._kernel, cells.count, given, [self.blocks])

    def add_norms(self, norms, rows):
        """Adds the norms of the blocks to their rows."""
        np.add.at(rows, self.pairs()[0], norms)


class Hessian:
    """∂²U/∂x² + scale·M of all terms, or of the ``terms`` given, in block compressed rows (BSR). Rows of pins are the identity.

    The row and column of a locked coordinate are 0 but for the diagonal, which keeps its value, or is 1 if that is not above 0
    (Baraff and Witkin 1998). So the coordinate does not move, and does not affect the others.

    ``values`` has only the diagonal blocks of ``pairs``, a :class:`warpcloth.contact.self_steps.SelfSteps`; :meth:`multiply`
    uses all of their blocks.

    Attributes:
        offsets, columns: Block rows (N+1,) and the column of each block.
        diagonal: Index of each diagonal block (N,).
        values: The blocks [N/m].
        policy: (B,) int32, a :class:`HessianPolicy` for each copy.
        count, per_copy: Vertices of all copies, and of one copy.
        vector, block: Warp types of an unknown and of a block.
    """

    @in_turn
    def __init__(self, model, policy=0, corrected=False, terms=None, pairs=None):
        self.pairs = pairs
        self.count, self.per_copy, self.vector, self.block = model.count, model.per_copy, model.vec3, model.mat33
        self.model, self.terms = model, model.terms if terms is None else terms
        device = model.device
        self._of_terms = [(_SparseBlocks if _is_sparse(each) else _Blocks)(model, each, corrected) for each in self.terms]
        self.blocks = [of_term.blocks for of_term in self._of_terms]
        self.policy = wp.full(model.copies, int(policy), dtype=wp.int32, device=device)
        self._set_inertia = model.kernel(linear.set_inertia, model.dtype)
        self._add_blocks = model.kernel(linear.add_blocks, model.dtype)
        self._multiply = self._invert_diagonal = None
        self._find_pattern()

    def _find_pattern(self):
        """Finds the blocks of the matrix and, for each, the element blocks of which it is the sum."""
        model, n = self.model, self.model.count
        fixed = model.inverse_mass.numpy() == 0.0
        keys, sources = [np.arange(n, dtype=np.int64) * (n + 1)], []
        for of_term in self._of_terms:
            rows, columns = of_term.pairs()
            source = np.flatnonzero(~(fixed[rows] | fixed[columns]))
            keys.append(rows[source] * n + columns[source])
            sources.append(source)
        unique, index = np.unique(np.concatenate(keys), return_inverse=True)

        def put(values):
            return wp.array(values.astype(np.int32), dtype=wp.int32, device=model.device)

        self.offsets = put(np.searchsorted(unique, np.arange(n + 1) * n))
        self.columns = put(unique % n)
        self.diagonal = put(index[:n])
        self.values = wp.zeros(len(unique), dtype=model.mat33, device=model.device)
        self._rows = None if model.mobility is None else put(unique // n)
        self.gathers, start = [], n
        for source in sources:
            target = index[start : start + len(source)]
            order = np.argsort(target, kind="stable")
            offsets = np.searchsorted(target[order], np.arange(len(unique) + 1))
            self.gathers.append((put(offsets), put(source[order])))
            start += len(source)

    def assemble(self, x, scale, correction=None):
        """Launches the assembly of ``values`` at x, or x + correction, with ``scale`` times the masses on the diagonal."""
        model = self.model
        self.values.zero_()
        model.launch(self._set_inertia, model.count, [self.diagonal, model.mass, model.inverse_mass, scale], [self.values])
        for of_term, gather in zip(self._of_terms, self.gathers, strict=True):
            of_term.launch(x, correction, self.policy)
            model.launch(self._add_blocks, len(self.values), [*gather, of_term.blocks.flatten()], [self.values])
        if self.pairs is not None:
            self.pairs.forces.launch_forces(x, correction)
            self.pairs.forces.add_diagonal(self.diagonal, self.values)
        if self._rows is not None:
            lock = model.kernel(linear.lock_blocks, model.dtype)
            model.launch(lock, len(self.values), [self._rows, self.columns, model.mobility], [self.values])

    def norms(self):
        """Returns Σⱼ‖∂²uₑ/∂xᵢ∂xⱼ‖ of each vertex i, summed over elements, (N,) [N/m], each norm bounded by √(‖·‖₁‖·‖∞)."""
        rows = np.zeros(self.model.count)
        for of_term in self._of_terms:
            sizes = np.abs(of_term.blocks.numpy().astype(np.float64))
            # A cheap upper bound of the spectral norm, equal to it along the axes and diagonals of a grid.
            of_term.add_norms(np.sqrt(sizes.sum(axis=-1).max(axis=-1) * sizes.sum(axis=-2).max(axis=-1)), rows)
        return rows

    def prepare(self):
        """Makes the kernels of :meth:`multiply` and :meth:`invert_diagonal`, which not every solver needs."""
        self._multiply = self.model.kernel(linear.multiply, self.model.dtype)
        self._invert_diagonal = self.model.kernel(linear.invert_diagonal, self.model.dtype)
        contact = self.pairs is not None or any(elements.collider is not None for elements in self.terms)
        self._lost = 16.0 * float(np.finfo(self.model.numpy_dtype).eps) * contact

    def multiply(self, p, q, active):
        """Launches q = A p for the copies that are ``active`` (B,)."""
        given = [self.offsets, self.columns, self.values, p, active, self.per_copy]
        self.model.launch(self._multiply, self.count, given, [q])
        if self.pairs is not None:
            self.pairs.forces.add_products(p, q, active)

    def invert_diagonal(self, out):
        """Launches out (N,) = the inverse diagonal blocks."""
        self.model.launch(self._invert_diagonal, self.count, [self.diagonal, self.values, self._lost], [out])

    def matrices(self):
        """Returns the present values of each copy as a scipy BSR matrix (3n, 3n) in float64."""
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

    def coupling(self):
        """Returns the off-diagonal blocks of pairs at the last :meth:`assemble`, scipy (3N, 3N); None without pairs."""
        if self.pairs is None:
            return None
        J, D = self.pairs.forces.rows()
        whole = (J.T @ D @ J).tocoo()
        off = whole.row // 3 != whole.col // 3
        whole.data[~off] = 0.0
        return whole.tocsc()

    def matrix(self):
        """Returns all copies in one scipy matrix (3N, 3N)."""
        from scipy.sparse import block_diag

        return block_diag(self.matrices(), format="csr")
