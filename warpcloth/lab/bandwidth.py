"""The bandwidth of a device by copying: the measure of all that is bound by memory."""

import time

import warp as wp

from ..kernels.copy import copy_rows

# Of an array [bytes]: beyond the caches of either kind of device.
_BYTES = {"cpu": 1 << 28, "cuda": 1 << 30}
_REPEATS = 7


def measure(device="cpu"):
    """Bytes that a copy from array to array moves a second, read and written, by Warp's copy and by a kernel.

    Each is the fastest of seven: what slows a copy down is no property of the device. The first is not counted.

    Args:
        device: A Warp device.

    Returns:
        dict: ``copy`` and ``kernel`` [B/s].
    """
    device = wp.get_device(device)
    size = _BYTES["cuda" if device.is_cuda else "cpu"]
    source, out = (wp.zeros(size // 16, dtype=wp.vec4, device=device) for _ in range(2))
    kernel = copy_rows()
    ways = {
        "copy": lambda: wp.copy(out, source),
        "kernel": lambda: wp.launch(kernel, dim=len(out), inputs=[source], outputs=[out], device=device),
    }
    return {name: 2 * size / _least(way, device) for name, way in ways.items()}


def _least(way, device):
    """The least time of some calls [s]."""
    times = []
    for _ in range(1 + _REPEATS):
        wp.synchronize_device(device)
        began = time.perf_counter()
        way()
        wp.synchronize_device(device)
        times.append(time.perf_counter() - began)
    return min(times[1:])
