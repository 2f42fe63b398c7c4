"""Memory bandwidth of a device, measured by copying."""

import time

import warp as wp

from ..kernels.copy import copy_rows

# Size of an array [bytes], larger than the caches.
_BYTES = {"cpu": 1 << 28, "cuda": 1 << 30}
_REPEATS = 7


def measure(device="cpu"):
    """Measures the bandwidth of a copy from array to array, bytes read and written, by Warp's copy and by a kernel.

    Each is the fastest of seven, because delays are no property of the device. The first copy does not count.

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
    times = []
    for _ in range(1 + _REPEATS):
        wp.synchronize_device(device)
        began = time.perf_counter()
        way()
        wp.synchronize_device(device)
        times.append(time.perf_counter() - began)
    return min(times[1:])
