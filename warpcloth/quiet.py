"""Warp without its greeting, and without its native line about a missing CUDA driver."""

import os
import sys
import tempfile


def initialise_warp():
    """Initialises Warp so that only warnings are said; that there is no driver is no news where only a CPU is asked for."""
    import warp as wp

    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    sys.stderr.flush()
    with tempfile.TemporaryFile() as said:
        before = os.dup(2)
        try:
            os.dup2(said.fileno(), 2)
            wp.init()
        finally:
            os.dup2(before, 2)
            os.close(before)
            said.seek(0)
            lines = said.read().decode(errors="replace").splitlines(keepends=True)
    sys.stderr.write("".join(line for line in lines if "load the NVIDIA CUDA driver" not in line))
