"""Graph capture, on the CPU too: a segment of launches is recorded once and replayed."""

import warp as wp


def on_host(device, what):
    """Raises if ``device`` is recording: a host call inside a captured segment would see data that nothing has computed.

    Raises:
        RuntimeError: If a graph is being captured on the device.
    """
    if device.is_capturing:
        raise RuntimeError(f"{what} runs on the host and cannot be part of a captured segment")


class Segment:
    """Launches that always run together: recorded when built, replayed by a call, on the CPU and on CUDA.

    Args:
        device: The Warp device.
        record: Function that launches.
    """

    def __init__(self, device, record):
        self.device = device
        with wp.ScopedCapture(device=device) as capture:
            record()
        self.graph = capture.graph

    def __call__(self):
        wp.capture_launch(self.graph)
