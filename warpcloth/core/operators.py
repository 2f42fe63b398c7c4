"""Sums over the terms of a model: energy, gradient, Hessian. Each allocates its scratch once and then only launches."""

import numpy as np
import warp as wp

from ..base.turns import in_turn
from ..fast.gather_layout import chain, gathered, lanes
from ..kernels import assemble, linear, reduce
from ..kernels.fast.gather_forces import gather_gradient
from ..terms.refresh import EVALUATION, Moment

# Chunks of a sum per copy: one on the CPU, which runs them in turn; on a GPU enough for it to be busy.
CHUNKS = 256


class Sums:
    """Sums and maxima per copy in double precision and a fixed order."""

    @in_turn
    def __init__(self, model):
        self.model = model
        chunks = CHUNKS if model.device.is_cuda else 1
        self.partial = wp.zeros((model.copies, chunks), dtype=wp.float64, device=model.device)
        self._finish = model.kernel(reduce.finish_sum)
        self._sum = model.kernel(reduce.partial_sum)
        self._dot = model.kernel(reduce.partial_dot, model.dtype)
        self._largest = model.kernel(reduce.partial_largest, model.dtype)
        self._finish_largest = model.kernel(reduce.finish_largest)

    def dot(self, a, b, out, active=None):
        """out (B,) = Σ a·b over the vertices of each copy; anything for those not ``active`` (B,), if that is given."""
        self.model.launch(self._dot, self.partial.shape, [a, b, active, self.model.per_copy], [self.partial])
        self._add_chunks(0, out)

    def sum(self, values, per_copy, out, accumulate=0):
        """out (B,) = Σ of the ``per_copy`` values of each copy, and what out held too where ``accumulate`` is 1."""
        self.model.launch(self._sum, self.partial.shape, [values, per_copy], [self.partial])
        self._add_chunks(accumulate, out)

    def largest(self, weights, a, out):
        """out (B,) = max wᵢ‖aᵢ‖ over the vertices of each copy."""
        self.model.launch(self._largest, self.partial.shape, [weights, a, self.model.per_copy], [self.partial])
        self.model.launch(self._finish_largest, self.model.copies, [self.partial], [out])

    def _add_chunks(self, accumulate, out):
        self.model.launch(self._finish, self.model.copies, [self.partial, accumulate], [out])


class RowSums(Sums):
    """The same of numbers that every copy has ``per_copy`` of, such as the rows of constraints."""

    @in_turn
    def __init__(self, model, per_copy):
        self.model, self.per_copy = model, per_copy
        chunks = CHUNKS if model.device.is_cuda else 1
        self.partial = wp.zeros((model.copies, chunks), dtype=wp.float64, device=model.device)
        self._finish = model.kernel(reduce.finish_sum)
        self._dot = model.kernel(reduce.partial_product, model.dtype)
        self._largest = model.kernel(reduce.partial_largest_number)
        self._finish_largest = model.kernel(reduce.finish_largest)

    def dot(self, a, b, out, active=None):
        """out (B,) = Σ a b of each copy, as :meth:`Sums.dot`."""
        self.model.launch(self._dot, self.partial.shape, [a, b, active, self.per_copy], [self.partial])
        self._add_chunks(0, out)

    def largest(self, values, out):
        """out (B,) = max of each copy of double precision ``values`` of 0 or more."""
        self.model.launch(self._largest, self.partial.shape, [values, self.per_copy], [self.partial])
        self.model.launch(self._finish_largest, self.model.copies, [self.partial], [out])


class Gradient:
    """∂U/∂x of all terms [N]; or of the ``terms`` given. On CUDA one launch for all terms, on the CPU one for each."""

    @in_turn
    def __init__(self, model, corrected=False, terms=None):
        self.model, self.terms = model, model.terms if terms is None else terms
        if model.device.is_cuda:
            self._found = [gathered(model, elements, rows=False) for elements in self.terms]
            parts = tuple(part for part, _arrays in self._found)
            self._lanes = lanes(model)
            self._gather = model.kernel(gather_gradient, parts, model.dtype, corrected, self._lanes) if parts else None
            self._chain = chain(parts, [arrays for _part, arrays in self._found], model.dtype)
        else:
            factory = assemble.scatter_gradient
            self._scatters = [model.kernel(factory, elements.term, model.dtype, corrected) for elements in self.terms]

    def add(self, x, out, correction=None):
        """out += ∂U/∂x at x, or at x + correction of operators built ``corrected``."""
        model = self.model
        model.refresh(EVALUATION, Moment(x, correction), self.terms)
        if not model.device.is_cuda:
            for elements, kernel in zip(self.terms, self._scatters, strict=True):
                model.launch(kernel, elements.count, [*elements.arguments, x, correction], [out])
        elif self._gather:
            model.launch(self._gather, model.count * self._lanes, [self._chain, x, correction], [out])


class Energy:
    """U of all terms [J], per copy; or of the ``terms`` given."""

    @in_turn
    def __init__(self, model, sums, corrected=False, terms=None):
        self.model, self.sums, self.terms = model, sums, model.terms if terms is None else terms
        self.kernels = [model.kernel(assemble.energy, elements.term, model.dtype, corrected) for elements in self.terms]
        self.of_elements = [wp.zeros(elements.count, dtype=wp.float64, device=model.device) for elements in self.terms]

    def add(self, x, out, correction=None):
        """out (B,) += U(x), or U(x + correction)."""
        self.model.refresh(EVALUATION, Moment(x, correction), self.terms)
        for elements, kernel, values in zip(self.terms, self.kernels, self.of_elements, strict=True):
            self.model.launch(kernel, elements.count, [*elements.arguments, x, correction], [values])
            self.sums.sum(values, elements.per_copy, out, accumulate=1)


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


def constant_blocks(model, elements):
    """k A GᵀG of each element, G the weights of y, (E, K, K) [N/m]."""
    K = elements.term.vertices
    blocks = wp.zeros((elements.count, K * K), dtype=wp.float64, device=model.device)
    kernel = model.kernel(assemble.constant_blocks, elements.term, model.dtype)
    model.launch(kernel, elements.count, elements.arguments, [blocks])
    return blocks.numpy().reshape(-1, K, K)


def constant_matrices(model, s):
    """s·M + Σ k A GᵀG of each copy, G the weights of y, as scipy matrices (n, n) [N/m]; pins are the identity."""
    from scipy.sparse import coo_matrix

    n, B = model.per_copy, model.copies
    free = model.inverse_mass.numpy() > 0.0
    diagonal = np.where(free, s * model.mass.numpy().astype(np.float64), 1.0).reshape(B, n)
    vertices = np.arange(n)
    rows, columns, values = [vertices], [vertices], [diagonal]
    for elements in model.terms:
        stencil = elements.stencil.numpy()[: elements.per_copy]
        K = stencil.shape[1]
        rows.append(np.repeat(stencil, K, axis=1).ravel())
        columns.append(np.tile(stencil, K).ravel())
        values.append(constant_blocks(model, elements).reshape(B, -1))
    rows, columns, values = np.concatenate(rows), np.concatenate(columns), np.concatenate(values, axis=1)
    free = free[:n]  # pins are those of the scene, in every copy
    keep = (free[rows] & free[columns]) | (np.arange(len(rows)) < n)
    return [coo_matrix((each[keep], (rows[keep], columns[keep])), shape=(n, n)).tocsc() for each in values]
