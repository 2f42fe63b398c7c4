"""Warp without its greeting, its lines on modules and its native line about a missing CUDA driver, unless asked for."""

import os
import sys
import tempfile
from functools import cache

from .checks import shown
from .kernel_cache import described


def leave_out_news():
    """Leaves Warp at warnings where its log level is still its own default; a level that is set later, or was before, holds."""
    import warp as wp

    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING


def find_device(name):
    """The Warp device of a name, Warp being initialised by :func:`initialise_warp`.

    Raises:
        ValueError: This machine has no such device.
    """
    import warp as wp

    initialise_warp()
    try:
        return wp.get_device(name)
    except (TypeError, ValueError, RuntimeError):  # of what is no name, or the name of none
        there = ", ".join(device.alias for device in wp.get_devices())
        raise ValueError(f"device is {shown(name)}; on this machine there are {there}") from None


@cache
def initialise_warp():
    """Initialises Warp; that there is no driver is no news where only a CPU is asked for.

    Raises:
        OSError: The folder of compiled kernels cannot be made.
    """
    import warp as wp

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
