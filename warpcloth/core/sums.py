"""Sums and maxima of each copy, in two launches: over chunks, and then over the chunks' results."""

import warp as wp

from ..base.turns import in_turn
from ..kernels import reduce

# Chunks of a sum per copy on a GPU, enough to keep it busy; the CPU, which would run them one after another, has one.
CHUNKS = 256


class Sums:
    """Sums and maxima per copy in double precision and a fixed order."""

    numbers = False  # in place of vectors

    @in_turn
    def __init__(self, model, per_copy=None):
        self.model, self.per_copy = model, model.per_copy if per_copy is None else per_copy
        chunks = CHUNKS if model.device.is_cuda else 1
        self.partial = wp.zeros((model.copies, chunks), dtype=wp.float64, device=model.device)
        self._finish, self._finish_largest = model.kernel(reduce.finish_sum), model.kernel(reduce.finish_largest)
        self._sum, self._dot = model.kernel(reduce.partial_sum), model.kernel(reduce.partial_dot, model.dtype, self.numbers)
        largest = (reduce.partial_largest_number,) if self.numbers else (reduce.partial_largest, model.dtype)
        self._largest = model.kernel(*largest)

    def dot(self, a, b, out, active=None):
        """out (B,) = Σ a·b of each copy; undefined for copies not ``active`` (B,), if that is given."""
        self.model.launch(self._dot, self.partial.shape, [a, b, active, self.per_copy], [self.partial])
        self._add_chunks(0, out)

    def sum(self, values, per_copy, out, accumulate=0):
        """out (B,) = Σ of the ``per_copy`` values of each copy, added to out if ``accumulate`` is 1."""
        self.model.launch(self._sum, self.partial.shape, [values, per_copy], [self.partial])
        self._add_chunks(accumulate, out)

    def largest(self, weights, a, out):
        """out (B,) = max wᵢ‖aᵢ‖ over the vertices of each copy."""
        self._find_largest([weights, a], out)

    def _add_chunks(self, accumulate, out):
        self.model.launch(self._finish, self.model.copies, [self.partial, accumulate], [out])

    def _find_largest(self, given, out):
        self.model.launch(self._largest, self.partial.shape, [*given, self.per_copy], [self.partial])
        self.model.launch(self._finish_largest, self.model.copies, [self.partial], [out])


class RowSums(Sums):
    """Sums and maxima of arrays with ``per_copy`` numbers for each copy, such as the rows of constraints."""

    numbers = True

    def largest(self, values, out):
        """out (B,) = max of each copy of ``values``, which are 0 or more and in double precision."""
        self._find_largest([values], out)
