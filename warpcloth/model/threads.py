"""The number of CPU threads that share out the copies of a model."""

import os
import warnings

import warp as wp

from ..base.checks import whole


def cores(device):
    """Returns the number of CPU cores that this process may use; 1 for another device."""
    if not device.is_cpu:
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def refuse_one_copy(threads, copies):
    """Checks that a number of threads has copies to share out.

    Raises:
        ValueError: It is not 1 or more, or is above 1 with one copy.
    """
    whole("threads", threads, 1)
    if threads > 1 and copies == 1:
        raise ValueError(
            f"threads is {threads} with one copy; it must be 1, because threads share out the copies of a batch, not one cloth"
        )


def threads_on(device, threads):
    """Checks a number of threads and returns it.

    Raises:
        ValueError: It is not 1 or more, or the device or Warp's mode allows no more than 1.

    Warns:
        UserWarning: There are more threads than cores.
    """
    whole("threads", threads, 1)
    if threads > 1 and not device.is_cpu:
        raise ValueError(f"threads is {threads} on {device}, which has its own; more than 1 is for device='cpu'")
    if threads > 1 and wp.config.mode == "debug" and wp.config.enable_tiles_in_stack_memory:
        raise ValueError(
            f"threads is {threads} in Warp's debug mode, where threads of one kernel share the pointer to its tiles; "
            "wp.config.mode='release' or wp.config.enable_tiles_in_stack_memory=False take more than 1"
        )
    if threads > cores(device):
        warnings.warn(f"threads is {threads} on {cores(device)} cores; more threads than cores are slower", stacklevel=5)
    return int(threads)
