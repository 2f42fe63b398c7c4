"""Graph capture, on the CPU too: a segment of launches is recorded once and replayed."""

import warp as wp

from ..base.collector import uncollected
from ..base.turns import TURN


def on_host(device, what):
    """Refuses a call on the host while ``device`` is recording, when arrays do not yet have the values of the recorded
    launches.

    Raises:
        RuntimeError: If a graph is being captured on the device.
    """
    if device.is_capturing:
        raise RuntimeError(f"{what} runs on the host and cannot be part of a captured segment")


class Mirror:
    """A device array and its counterpart on the host, by which the host reads and writes between segments.

    Both are allocated when it is built, so reading and writing allocate nothing; on the CPU they are one array.

    Args:
        array: The device array.
    """

    def __init__(self, array):
        self.array = array
        self.host = array if array.device.is_cpu else wp.empty_like(array, device="cpu", pinned=True)

    def read(self):
        """The values as NumPy, valid until the next call or launch.

        Raises:
            RuntimeError: If a graph is being captured on the device.
        """
        on_host(self.array.device, "reading an array")
        if self.host is not self.array:
            wp.copy(self.host, self.array)
            wp.synchronize_stream(self.array.device)
        return self.host.numpy()

    def write(self, values):
        """Sets the values from NumPy.

        Raises:
            RuntimeError: If a graph is being captured on the device.
        """
        on_host(self.array.device, "writing an array")
        self.host.numpy()[...] = values
        if self.host is not self.array:
            wp.copy(self.array, self.host)
            wp.synchronize_stream(self.array.device)  # or the next write would change what is still being copied


class Segment:
    """Launches that always run together: recorded when it is built, replayed when it is called, on the CPU and on CUDA.

    Args:
        device: The Warp device.
        record: Function that does the launches.
    """

    def __init__(self, device, record):
        self.device = device
        self.record = record  # the graph has only addresses of the arrays that the function refers to, which must not be freed
        # Memory that the collector frees on CUDA, such as the factors of cholespy, would break a capture.
        with TURN, uncollected(), wp.ScopedCapture(device=device) as capture:
            record()
        self.graph = capture.graph

    def __call__(self):
        wp.capture_launch(self.graph)
