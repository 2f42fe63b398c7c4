"""Sums from the first element on, of counts, in launches that a branch of a graph can hold, as it cannot those of Warp."""

import math

import warp as wp

from ..kernels import scan


class Scan:
    """Exclusive sums of integers.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        count: How many, n.
    """

    def __init__(self, model, count):
        self._size = math.isqrt(count - 1) + 1 if model.device.is_cuda else count
        self._sums = wp.zeros(-(-count // self._size), dtype=wp.int32, device=model.device)
        self._launch = model.launcher(((scan.sum_chunks, scan.add_chunks, scan.write_sums),))

    def launch(self, values, out):
        """out (n+1,) = the sum of the values (n,) before each, and of all."""
        chunks = len(self._sums)
        self._launch(scan.sum_chunks, chunks, [values, self._size], [self._sums])
        self._launch(scan.add_chunks, 1, [], [self._sums])
        self._launch(scan.write_sums, chunks, [values, self._sums, self._size], [out])
