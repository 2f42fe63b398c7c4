"""Initialises Warp without its greeting, its messages about modules and its message about a missing CUDA driver."""

import os
import sys
import tempfile
from functools import cache

from .checks import shown
from .kernel_cache import described
from .warp_internals import change_warp


@cache
def prepare_warp():
    """Sets Warp's log level to warnings, and changes Warp as :mod:`warpcloth.base.warp_internals` says.

    A log level that the user sets, before or later, is kept.
    """
    import warp as wp

    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING
    change_warp()


def find_device(name):
    """Initialises Warp and returns the device of a name, such as "cpu" or "cuda:0".

    Raises:
        ValueError: This machine has no such device.
    """
    import warp as wp

    initialise_warp()
    try:
        if str(name).startswith("cuda") and not wp.is_cuda_available():  # Warp would print an error of its own
            raise ValueError
        return wp.get_device(name)
    except (TypeError, ValueError, RuntimeError):
        there = ", ".join(device.alias for device in wp.get_devices())
        raise ValueError(f"device is {shown(name)}; on this machine there are {there}") from None


@cache
def initialise_warp():
    """Initialises Warp after :func:`prepare_warp`, and hides its message about a missing CUDA driver.

    Raises:
        OSError: The folder of compiled kernels cannot be made.
    """
    import warp as wp

    prepare_warp()
    try:
        sys.stderr.flush()
        before = os.dup(2)
    except (AttributeError, OSError):  # a process without a standard error
        wp.init()
        return
    with tempfile.TemporaryFile() as said:
        try:
            os.dup2(said.fileno(), 2)
            wp.init()
        except OSError as error:
            raise described(error, error.filename) from None
        finally:
            os.dup2(before, 2)
            os.close(before)
            said.seek(0)
            lines = said.read().decode(errors="replace").splitlines(keepends=True)
    sys.stderr.write("".join(line for line in lines if "load the NVIDIA CUDA driver" not in line))
