"""The second derivative of the energy of a model, as a sparse matrix."""

import numpy as np
import warp as wp

from ..kernels import assemble, linear, sparse
from ..kernels.block_rows import block_rows
from ..kernels.term import HessianPolicy
from ..model.host_values import host_values
from .block_pattern import TermCorners, find_pattern, slots_of
from .dynamic import dynamic_of

CHUNK = 1 << 16  # number of elements whose blocks `norms` computes at once


def _is_sparse(elements):
    return elements.cells is not None and elements.cells.weights is not None


class ElementBlocks:
    """The Hessian blocks of the elements of one term, (B·E·K²,)."""

    factories = assemble.hessian_blocks, assemble.scatter_hessian

    def __init__(self, model, elements):
        self.model, self.elements, self.term = model, elements, elements.term
        self.count, self.blocks = elements.count, elements.count * elements.term.vertices**2
        self._given, self._per_copy = elements.arguments, elements.per_copy

    def corners(self):
        """The :class:`warpcloth.core.block_pattern.TermCorners`."""
        stencil = host_values(self.elements.stencil)[: self.elements.per_copy]
        return TermCorners(self.model, stencil.ravel(), K=stencil.shape[1])

    def array(self):
        """A new array for the blocks, in the shape that the kernel takes."""
        K = self.term.vertices
        return wp.empty((self.count, K * K), dtype=self.model.mat33, device=self.model.device)

    def launch(self, kernel, x, correction, policy, out, slots=()):
        self.model.launch(kernel, self.count, [*self._given, *slots, x, correction, self._per_copy, policy], [out])


class _Cells(ElementBlocks):
    """The Hessian blocks of the cells of one term, cell by cell, see :mod:`warpcloth.kernels.sparse`."""

    factories = sparse.blocks, sparse.scatter_blocks

    def __init__(self, model, elements):
        self.model, self.elements, cells = model, elements, elements.cells
        starts, self.blocks = cells.blocks()
        self.term, self.count, self._per_copy = cells.term, cells.count, cells.per_copy
        self._given = [cells.offsets, starts, elements.stencil, cells.weights, elements.stiffness, cells.rest]

    def corners(self):
        """The :class:`warpcloth.core.block_pattern.TermCorners`."""
        elements, cells = self.elements, self.elements.cells
        vertices = host_values(elements.stencil)[: elements.per_copy, 0]
        return TermCorners(self.model, vertices, sizes=cells.sizes[: cells.per_copy].astype(np.int64))

    def array(self):
        """A new array for the blocks, in the shape that the kernel takes."""
        return wp.empty(self.blocks, dtype=self.model.mat33, device=self.model.device)


def _of(model, elements):
    return (_Cells if _is_sparse(elements) else ElementBlocks)(model, elements)


class BlockSum:
    """Adds the blocks of a term to those of the matrix: scatters from elements on the CPU, gathers on CUDA, in a fixed order.

    Args:
        of_term: The blocks, such as :class:`ElementBlocks`.
        sums: What the blocks of the matrix are the sums of, see :class:`warpcloth.core.block_pattern.BlockPattern`.
        key: Arguments of the factories of ``of_term``.
    """

    def __init__(self, of_term, sums, *key):
        model = self.model = of_term.model
        self._of_term, self._sums, cuda = of_term, sums, model.device.is_cuda
        gather, scatter = of_term.factories
        self._kernel = model.kernel(gather if cuda else scatter, *key)
        if cuda:
            self._blocks, self._add_blocks = of_term.array(), model.kernel(linear.add_blocks, model.dtype)
        else:
            self._slots, self._sums = slots_of(model, sums, of_term.blocks), None

    def add(self, values, *state):
        """Launches values += the blocks of the term, which depend on ``state``."""
        if self._sums is None:
            self._of_term.launch(self._kernel, *state, values, [self._slots])
            return
        self._of_term.launch(self._kernel, *state, self._blocks)
        self.model.launch(self._add_blocks, len(values), [*self._sums, self._blocks.flatten()], [values])


def _is_constant(elements):
    """Whether the Hessian of a term depends neither on positions nor on a rest state that changes in a run."""
    return elements.term.whole.linear and (elements.refresh is None or _is_sparse(elements))  # that of cells stores forces


class BlockMatrix:
    """A symmetric matrix of 3×3 blocks over the vertices of all copies, in block compressed rows (BSR).

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        found: Its :class:`warpcloth.core.block_pattern.BlockPattern`.
        contact: Whether blocks may have condition numbers of 1e5 and more, as in contact.

    Attributes:
        offsets, columns: Block rows (N+1,) and the column of each block.
        diagonal: Index of each diagonal block (N,).
        values: The blocks.
        count, per_copy: Vertices of all copies, and of one copy.
        vector, block: Warp types of an unknown and of a block.
    """

    dynamic = ()

    def __init__(self, model, found, contact):
        self.model, self._ill_conditioned = model, contact
        self.count, self.per_copy, self.vector, self.block = model.count, model.per_copy, model.vec3, model.mat33
        self.offsets, self.columns, self.diagonal = found.offsets, found.columns, found.diagonal
        self._rows = None if model.mobility is None else found.rows
        # Zeros, because matrices() may be called for the pattern before values are assembled.
        self.values = wp.zeros(len(found.columns), dtype=model.mat33, device=model.device)
        self._add_masses = model.kernel(linear.add_masses, model.dtype)
        self._multiply = self._invert_diagonal = None

    def launch_masses(self, scale):
        """Launches values += ``scale`` times the masses on the diagonal, and the identity for pins."""
        model = self.model
        model.launch(self._add_masses, model.count, [self.diagonal, model.mass, model.inverse_mass, scale], [self.values])

    def launch_locks(self):
        """Launches rows and columns of locked coordinates as 0 but for the diagonal, see :class:`Hessian`."""
        if self._rows is not None:
            lock = self.model.kernel(linear.lock_blocks, self.model.dtype)
            self.model.launch(lock, len(self.values), [self._rows, self.columns, self.model.mobility], [self.values])

    def prepare(self):
        """Makes the kernels of :meth:`multiply` and :meth:`invert_diagonal`, which not every solver needs."""
        self._multiply = self.model.kernel(linear.multiply, self.model.dtype)
        self._invert_diagonal = self.model.kernel(linear.invert_diagonal, self.model.dtype)
        self._lost = 16.0 * float(np.finfo(self.model.numpy_dtype).eps) * self._ill_conditioned

    @property
    def terms_in_rows(self):
        """The number of dynamic elements of which :meth:`block_rows` has the pairs."""
        return self.dynamic.terms_in_rows if self.dynamic else 0

    @property
    def apart(self):
        """The dynamic elements of which it has not, so that their products have launches of their own; or None."""
        return self.dynamic if self.dynamic and not self.terms_in_rows else None

    def block_rows(self):
        """Returns the :func:`warpcloth.kernels.block_rows.block_rows`, which holds no references."""
        rows = block_rows(self.model.dtype)()
        rows.offsets, rows.columns, rows.diagonal, rows.values = self.offsets, self.columns, self.diagonal, self.values
        if self.dynamic:
            self.dynamic.set_pairs(rows)
        return rows

    def invert_diagonal(self, out):
        """Launches out (N,) = the inverse diagonal blocks."""
        self.model.launch(self._invert_diagonal, self.count, [self.diagonal, self.values, self._lost], [out])


class Hessian(BlockMatrix):
    """∂²U/∂x² + scale·M of all terms, or of the ``terms`` given, in block compressed rows (BSR). Rows of pins are the identity.

    The row and column of a locked coordinate are 0 but for the diagonal, which keeps its value, or is 1 if that is not above 0
    (Baraff and Witkin 1998). So the coordinate does not move, and does not affect the others.

    It includes the dynamic elements of the model, or with ``terms`` those given. ``values`` has only their diagonal blocks;
    :meth:`multiply` uses all of their blocks.

    Attributes:
        dynamic: A :class:`warpcloth.core.dynamic.Dynamic`.
        values: The blocks [N/m]. Others are those of :class:`BlockMatrix`.
        policy: (B,) float64, a :class:`HessianPolicy` or a factor between for each copy.
    """

    def __init__(self, model, policy=HessianPolicy.RAW, corrected=False, terms=None, dynamic=()):
        self.dynamic = dynamic_of(model, terms, dynamic)
        self.terms = model.terms if terms is None else terms
        self.policy = wp.full(model.copies, float(policy), dtype=wp.float64, device=model.device)
        found = pattern_of(model, self.terms)
        touches = len(self.dynamic) > 0 or any(elements.collider is not None for elements in self.terms)
        super().__init__(model, found, touches)
        self._varying, self._constant = [], None
        for elements, sums in zip(self.terms, found.sums, strict=True):
            one = BlockSum(of_term := _of(model, elements), sums, of_term.term, model.dtype, corrected)
            if not _is_constant(elements):
                self._varying.append(one)
                continue
            if self._constant is None:
                self._constant, zero = wp.zeros_like(self.values), model.vectors()
            one.add(self._constant, zero, zero, self.policy)

    def assemble(self, x, scale, correction=None, further=None):
        """Launches the assembly of ``values`` at x, or x + correction, with ``scale`` times the masses on the diagonal.

        The sum of the terms whose Hessian is constant is computed once, and copied. A function ``further``(values) may add to
        the blocks.
        """
        self.dynamic.launch(x, correction)
        self.assemble_after_gradient(x, scale, correction, further)

    def assemble_after_gradient(self, x, scale, correction=None, further=None):
        """As :meth:`assemble`, where a gradient at the same positions has found the forces of dynamic elements."""
        if self._constant is None:
            self.values.zero_()
        else:
            wp.copy(self.values, self._constant)
        self.launch_masses(scale)
        for one in self._varying:
            one.add(self.values, x, correction, self.policy)
        self.dynamic.add_diagonal(self.diagonal, self.values, self.policy)
        if further is not None:
            further(self.values)
        self.launch_locks()

    def multiply(self, p, q, active):
        """Launches q = A p for the copies that are ``active`` (B,)."""
        given = [self.offsets, self.columns, self.values, p, active, self.per_copy]
        self.model.launch(self._multiply, self.count, given, [q])
        self.dynamic.add_products(p, q, active)

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
        """Returns the off-diagonal blocks of dynamic elements at the last :meth:`assemble`, scipy (3N, 3N); None without."""
        if not self.dynamic:
            return None
        whole = sum(each.matrix() for each in self.dynamic.terms).tocoo()
        off = whole.row // 3 != whole.col // 3
        whole.data[~off] = 0.0
        return whole.tocsc()

    def matrix(self):
        """Returns all copies in one scipy matrix (3N, 3N)."""
        from scipy.sparse import block_diag

        return block_diag(self.matrices(), format="csr")


def pattern_of(model, terms):
    """Returns the :class:`warpcloth.core.block_pattern.BlockPattern` of the sum of ``terms`` in all copies."""
    of_terms = [_of(model, each) for each in terms]
    fixed = model.inverse_mass[: model.per_copy].numpy() == 0.0
    one = find_pattern(model, [of_term.corners() for of_term in of_terms], fixed)
    return one.of_copies(model, [of_term.blocks // model.copies for of_term in of_terms])


def norms(model, terms, x):
    """Returns Σⱼ‖∂²uₑ/∂xᵢ∂xⱼ‖ at x of each vertex i, summed over the elements of ``terms``, (N,) [N/m].

    The norms are upper bounds, see :func:`warpcloth.kernels.assemble.row_norms`. Nothing is assembled.
    """
    rows, policy = np.zeros(model.count), wp.full(model.copies, float(HessianPolicy.RAW), dtype=wp.float64, device=model.device)
    row_norms = model.kernel(assemble.row_norms, model.dtype)

    def add(blocks, vertices):
        found = wp.empty(len(blocks), dtype=wp.float64, device=model.device)
        model.launch(row_norms, len(blocks), [blocks], [found])
        np.add.at(rows, vertices, found.numpy())

    for elements in terms:
        if _is_sparse(elements):
            of_term = _Cells(model, elements)
            blocks = of_term.array()
            of_term.launch(model.kernel(sparse.blocks, of_term.term, model.dtype, False), x, None, policy, blocks)
            add(blocks.reshape((-1, 1)), elements.cells.pairs(elements)[0])
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
