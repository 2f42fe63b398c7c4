"""The second derivative of the energy of a model, as a sparse matrix."""

import numpy as np
import warp as wp

from ..base.turns import in_turn
from ..kernels import assemble, linear, sparse
from ..model.host_values import host_values
from .block_pattern import TermCorners, find_pattern

CHUNK = 1 << 16  # number of elements whose blocks `norms` computes at once


def _is_sparse(elements):
    return elements.cells is not None and elements.cells.weights is not None


class _Blocks:
    """The Hessian blocks of the elements of one term, (B·E, K²)."""

    def __init__(self, model, elements, corrected):
        self.model, self.elements, K = model, elements, elements.term.vertices
        self._kernel = model.kernel(assemble.hessian_blocks, elements.term, model.dtype, corrected)
        self.blocks = wp.empty((elements.count, K * K), dtype=model.mat33, device=model.device)

    def corners(self):
        """The :class:`warpcloth.core.block_pattern.TermCorners`."""
        stencil = host_values(self.elements.stencil)[: self.elements.per_copy]
        return TermCorners(self.model, stencil.ravel(), K=stencil.shape[1])

    def launch(self, x, correction, policy):
        arguments = [*self.elements.arguments, x, correction, self.elements.per_copy, policy]
        self.model.launch(self._kernel, self.elements.count, arguments, [self.blocks])


class _SparseBlocks:
    """The Hessian blocks of the cells of one term, cell by cell, see :mod:`warpcloth.kernels.sparse`."""

    def __init__(self, model, elements, corrected):
        self.model, self.elements, cells = model, elements, elements.cells
        self._kernel = model.kernel(sparse.blocks, cells.term, model.dtype, corrected)
        self._starts, count = cells.blocks()
        self.blocks = wp.empty(count, dtype=model.mat33, device=model.device)

    def corners(self):
        """The :class:`warpcloth.core.block_pattern.TermCorners`."""
        elements, cells = self.elements, self.elements.cells
        vertices = host_values(elements.stencil)[: elements.per_copy, 0]
        return TermCorners(self.model, vertices, sizes=cells.sizes[: cells.per_copy].astype(np.int64))

    def launch(self, x, correction, policy):
        cells, elements = self.elements.cells, self.elements
        given = [cells.offsets, self._starts, elements.stencil, cells.weights, elements.stiffness, cells.rest]
        given += [x, correction, cells.per_copy, policy]
        self.model.launch(self._kernel, cells.count, given, [self.blocks])


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
        fixed = model.inverse_mass[: model.per_copy].numpy() == 0.0
        one = find_pattern(model, [of_term.corners() for of_term in self._of_terms], fixed)
        found = one.of_copies(model, [blocks.size // model.copies for blocks in self.blocks])
        self.offsets, self.columns, self.diagonal, self.gathers = found.offsets, found.columns, found.diagonal, found.sums
        self._rows = None if model.mobility is None else found.rows
        self.values = wp.empty(len(found.columns), dtype=model.mat33, device=device)

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

    def prepare(self):
        """Makes the kernels of :meth:`multiply` and :meth:`invert_diagonal`, which not every solver needs."""
        self._multiply = self.model.kernel(linear.multiply, self.model.dtype)
        self._invert_diagonal = self.model.kernel(linear.invert_diagonal, self.model.dtype)
        contact = self.pairs is not None or any(elements.collider is not None for elements in self.terms)
        self._lost = 16.0 * float(np.finfo(self.model.numpy_dtype).eps) * contact

    @property
    def block_rows(self):
        """The offsets, columns and values of the rows, without pairs; else None, because values are not all of the matrix."""
        return None if self.pairs is not None else (self.offsets, self.columns, self.values)

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


def norms(model, terms, x):
    """Returns Σⱼ‖∂²uₑ/∂xᵢ∂xⱼ‖ at x of each vertex i, summed over the elements of ``terms``, (N,) [N/m].

    The norms are upper bounds, see :func:`warpcloth.kernels.assemble.row_norms`. Nothing is assembled.
    """
    rows, policy = np.zeros(model.count), wp.zeros(model.copies, dtype=wp.int32, device=model.device)
    row_norms = model.kernel(assemble.row_norms, model.dtype)

    def add(blocks, vertices):
        found = wp.empty(len(blocks), dtype=wp.float64, device=model.device)
        model.launch(row_norms, len(blocks), [blocks], [found])
        np.add.at(rows, vertices, found.numpy())

    for elements in terms:
        if _is_sparse(elements):
            of_term = _SparseBlocks(model, elements, corrected=False)
            of_term.launch(x, None, policy)
            add(of_term.blocks.reshape((-1, 1)), elements.cells.pairs(elements)[0])
            continue
        kernel, K = model.kernel(assemble.hessian_blocks, elements.term, model.dtype), elements.term.vertices
        stencil = host_values(elements.stencil)
        blocks = wp.empty((min(CHUNK, elements.count), K * K), dtype=model.mat33, device=model.device)
        for first in range(0, elements.count, CHUNK):
            some = slice(first, min(first + CHUNK, elements.count))
            given = [*(array[some] for array in elements.arguments), x, None, elements.per_copy, policy]
            own = blocks[: some.stop - first]
            model.launch(kernel, len(own), given, [own])
            add(own.reshape((-1, K)), stencil[some].ravel())
    return rows
