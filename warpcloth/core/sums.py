"""Sums and maxima of each copy, in two launches: parts of blocks of lanes, then the sum or the largest of the parts."""

import warp as wp

from ..kernels import reduce

# Threads of a block that share a sum, and the most blocks of a copy, on a GPU; on the CPU one thread takes a copy.
BLOCKS, MAX_BLOCKS = {"cuda": 256, "cpu": 0}, 1024


class Lanes:
    """How threads share the sums of a kernel over (copies, lanes), see :func:`warpcloth.kernels.reduce.block_sums`.

    Args:
        model: The :class:`warpcloth.model.model.Model`, or another object with ``device`` and ``copies``.
        per_copy: Number of summands of a copy.

    Attributes:
        block: Threads of a block on CUDA, 0 on the CPU.
        count: Lanes of a copy.
        dim, of_block: Threads of a kernel over (copies, lanes), and over (copies, lanes of one block).
    """

    def __init__(self, model, per_copy):
        self.model, self.block = model, BLOCKS["cuda" if model.device.is_cuda else "cpu"]
        self._blocks = min(max(-(-per_copy // self.block), 1), MAX_BLOCKS) if self.block else 1
        self.count = self._blocks * max(self.block, 1)
        self.dim, self.of_block = (model.copies, self.count), (model.copies, max(self.block, 1))

    def parts(self, *sums):
        """Returns an array (…, B, blocks) for the parts of sums."""
        return wp.zeros((*sums, self.model.copies, self._blocks), dtype=wp.float64, device=self.model.device)


class Sums:
    """Sums and maxima per copy in double precision and a fixed order."""

    numbers = False  # whether arrays hold numbers, not vectors

    def __init__(self, model, per_copy=None):
        self.model, self.per_copy = model, model.per_copy if per_copy is None else per_copy
        self._lanes = lanes = Lanes(model, self.per_copy)
        self._parts, block = lanes.parts(), lanes.block
        self._finish, self._finish_largest = (model.kernel(make, block) for make in (reduce.finish_sum, reduce.finish_largest))
        self._sum, self._dot = (
            model.kernel(reduce.partial_sum, block),
            model.kernel(reduce.partial_dot, model.dtype, self.numbers, block),
        )
        largest = (reduce.partial_largest_number,) if self.numbers else (reduce.partial_largest, model.dtype)
        self._largest = model.kernel(*largest, block)

    def dot(self, a, b, out, active=None):
        """Launches out (B,) = Σ a·b of each copy, 0 for copies that are not ``active`` (B,), if that is given."""
        self._launch_parts(self._dot, [a, b, active], self.per_copy)
        self._add_parts(0, out)

    def sum(self, values, per_copy, out, accumulate=0):
        """Launches out (B,) = Σ of the ``per_copy`` values of each copy, or out += that if ``accumulate`` is 1."""
        self._launch_parts(self._sum, [values], per_copy)
        self._add_parts(accumulate, out)

    def largest(self, weights, a, out):
        """Launches out (B,) = max wᵢ‖aᵢ‖ over the vertices of each copy."""
        self._find_largest([weights, a], out)

    def _launch_parts(self, kernel, given, per_copy):
        self.model.launch(kernel, self._lanes.dim, [*given, per_copy, self._lanes.count], [self._parts])

    def _add_parts(self, accumulate, out):
        self.model.launch(self._finish, self._lanes.of_block, [self._parts, accumulate], [out])

    def _find_largest(self, given, out):
        self._launch_parts(self._largest, given, self.per_copy)
        self.model.launch(self._finish_largest, self._lanes.of_block, [self._parts], [out])


class RowSums(Sums):
    """Sums and maxima of arrays with ``per_copy`` numbers for each copy, such as the rows of constraints."""

    numbers = True

    def largest(self, values, out):
        """Launches out (B,) = the maximum of each copy of ``values``, float64, 0 or more."""
        self._find_largest([values], out)
