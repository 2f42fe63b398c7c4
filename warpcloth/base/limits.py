"""Upper limits of counts, and checks that arrays and files fit in the free memory and disk before a run starts."""

import os
import shutil

# Largest number of steps a frame, iterations a step, and copies. Each takes at least a microsecond.
MAX_COUNT = 10_000_000
# Largest number of frames, because their numbers are time codes of a stage, see `usd.values.MAX_TIME_CODE`.
MAX_FRAMES = 1_000_000_000


def available_memory():
    """Returns the bytes that this process can still allocate, as Linux and its control group say; None if unknown."""
    found = []
    for path, key in (
        ("/proc/meminfo", "MemAvailable:"),
        ("/sys/fs/cgroup/memory.max", ""),
        ("/sys/fs/cgroup/memory.current", ""),
    ):
        try:
            with open(path) as file:
                words = next(line.removeprefix(key).split() for line in file if line.startswith(key))
            found.append(int(words[0]) * (1024 if key else 1))
        except (OSError, StopIteration, ValueError):  # not Linux; or the word "max", no limit
            found.append(None)
    free, limit, used = found
    rooms = [free] if limit is None or used is None else [free, limit - used]
    return min((room for room in rooms if room is not None), default=None)


def refuse_memory(what, size, device=None):
    """Checks that the arrays of an option fit in the free memory.

    Args:
        what: Option and value, which begin the error message: "frames is 1000000000".
        size: Bytes needed.
        device: Warp device on which the arrays are allocated; None for the host.

    Raises:
        ValueError: Fewer bytes are free.
    """
    room = device.free_memory if device is not None and device.is_cuda else available_memory()
    if room is not None and size > room:
        raise ValueError(
            f"{what}, which takes {shown_bytes(size)} of memory; it must fit in the {shown_bytes(room)} that are free"
        )


def refuse_disk(what, size, folder):
    """Checks that the files of an option fit on the disk of a folder, which must exist.

    Args:
        what: As for `refuse_memory`.
        size: Bytes needed.
        folder: Folder of the files.

    Raises:
        ValueError: Fewer bytes are free.
    """
    room = shutil.disk_usage(folder).free
    if size > room:
        raise ValueError(
            f"{what}, which takes {shown_bytes(size)} of the disk of {os.path.abspath(folder)}; "
            f"it must fit in the {shown_bytes(room)} that are free there"
        )


def shown_bytes(size):
    """Formats a size with a suitable unit, such as 1.5 GB."""
    size, units = float(size), ["bytes", "kB", "MB", "GB", "TB"]
    while size >= 1000.0 and len(units) > 1:
        size /= 1000.0
        units.pop(0)
    return f"{size:.3g} {units[0]}"
