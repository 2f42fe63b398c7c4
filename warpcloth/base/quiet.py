"""Silences Warp's greeting, its lines on modules and its native line about a missing CUDA driver, unless they are asked for."""

import os
import sys
import tempfile
from functools import cache

from .checks import shown
from .kernel_cache import described, mend, parse_headers_once


@cache
def prepare_warp():
    """Makes Warp leave out its news, repair its cache of kernels and keep parsed headers there: once, before it is initialised.

    Its log level is set to warnings if it is still the default; a level that the user sets, before or later, is kept.
    """
    import warp as wp

    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING
    mend()
    parse_headers_once()


def find_device(name):
    """Returns the Warp device of a name, after :func:`initialise_warp`.

    Raises:
        ValueError: This machine has no such device.
    """
    import warp as wp

    initialise_warp()
    try:
        return wp.get_device(name)
    except (TypeError, ValueError, RuntimeError):  # not a name, or the name of no device
        there = ", ".join(device.alias for device in wp.get_devices())
        raise ValueError(f"device is {shown(name)}; on this machine there are {there}") from None


@cache
def initialise_warp():
    """Initialises Warp after :func:`prepare_warp`, without its line about a missing driver if only the CPU is asked for.

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
