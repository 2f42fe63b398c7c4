"""Exclusive prefix sums, by kernels that a conditional branch of a graph may contain; Warp's own scan may not be in one."""

import math

import warp as wp

from ..kernels import scan
from .sums import BLOCKS


class Scan:
    """Exclusive prefix sums of integers.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        count: Number of integers, n.
    """

    def __init__(self, model, count):
        block = self._threads = BLOCKS["cuda" if model.device.is_cuda else "cpu"]
        self._size = math.isqrt((count - 1) // block) + 1 if block else count  # a thread adds as many sums as numbers
        self._sums = wp.zeros(-(-count // self._size), dtype=wp.int32, device=model.device)
        self._launch = model.launcher(((scan.sum_chunks, scan.write_sums),), ((scan.add_chunks,), block))

    def launch(self, values, out):
        """Launches out (n+1,) = the sum of the values (n,) before each, and the sum of all."""
        chunks = len(self._sums)
        if chunks > 1:  # else 0 comes before the only one
            self._launch(scan.sum_chunks, chunks, [values, self._size], [self._sums])
            self._launch(scan.add_chunks, max(self._threads, 1), [], [self._sums])
        self._launch(scan.write_sums, chunks, [values, self._sums, self._size], [out])
