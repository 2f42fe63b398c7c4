"""Graph capture, on the CPU and on CUDA: a segment of launches is captured once and replayed."""

import numpy as np
import warp as wp

from ..base.collector import uncollected
from ..base.turns import TURN


def on_host(device, what):
    """Checks that no graph is being captured, because captured launches have not run, so the host would read old values.

    Raises:
        RuntimeError: A graph is being captured on the device.
    """
    if device.is_capturing:
        raise RuntimeError(f"{what} runs on the host and cannot be part of a captured segment")


class Mirror:
    """A device array with a pinned host array, through which the host reads and writes it between segments.

    Reading and writing allocate nothing. On the CPU both are one array.

    Args:
        array: The device array.
    """

    def __init__(self, array):
        self.array = array
        self.host = array if array.device.is_cpu else wp.empty_like(array, device="cpu", pinned=True)
        self._values = self.host.numpy()
        self._written = False

    def read(self):
        """Returns the values as a NumPy array, valid until the next call or launch.

        Raises:
            RuntimeError: A graph is being captured on the device.
        """
        on_host(self.array.device, "reading an array")
        if self.host is not self.array:
            wp.copy(self.host, self.array)
            wp.synchronize_stream(self.array.device)
        return self._values

    def write(self, values):
        """Sets the values from a NumPy array.

        Raises:
            RuntimeError: A graph is being captured on the device.
        """
        on_host(self.array.device, "writing an array")
        self._values[...], self._written = values, True
        if self.host is not self.array:
            wp.copy(self.array, self.host)
            wp.synchronize_stream(self.array.device)  # before the next write changes the host array

    def update(self, values):
        """Sets the values as :meth:`write`, or does nothing if they were the last that it wrote. No launch may change them."""
        if not (self._written and np.array_equal(self._values, values)):
            self.write(values)


class Segment:
    """Launches that always run together: captured on construction, replayed on each call, on the CPU and on CUDA.

    Args:
        device: The Warp device.
        record: Function that launches.
    """

    def __init__(self, device, record):
        self.device = device
        self.record = record  # keeps the arrays of the function alive, of which the graph has only addresses
        # If the collector freed CUDA memory, such as factors of cholespy, the capture would fail.
        with TURN, uncollected(), wp.ScopedCapture(device=device) as capture:
            record()
        self.graph = capture.graph

    def __call__(self):
        wp.capture_launch(self.graph)
