"""Refuses, before anything runs, sizes that exceed the free memory or disk, and counts that would never end."""

import os
import shutil

# Most steps of a frame, iterations of a step, and copies. Each takes a microsecond at least, so more take minutes or hours.
MOST = 10_000_000
# Most frames, since their numbers are time codes of a stage, see `usd.values.MOST_TIME_CODE`.
MOST_FRAMES = 1_000_000_000


def available_memory():
    """Returns the bytes that this process can still allocate, from the Linux kernel and the control group; None if unknown."""
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
        except (OSError, StopIteration, ValueError):  # not Linux, or the word "max", which means no limit
            found.append(None)
    free, limit, used = found
    rooms = [free] if limit is None or used is None else [free, limit - used]
    return min((room for room in rooms if room is not None), default=None)


def refuse_memory(what, size):
    """Refuses an option that takes more memory than is free.

    Args:
        what: The option and its value, as the start of a sentence: "frames is 1000000000".
        size: Bytes that it takes.

    Raises:
        ValueError: Fewer bytes are free.
    """
    room = available_memory()
    if room is not None and size > room:
        raise ValueError(
            f"{what}, which takes {shown_bytes(size)} of memory; it must fit in the {shown_bytes(room)} that are free"
        )


def refuse_disk(what, size, folder):
    """Refuses an option that takes more space than is free on the disk of a folder, which must exist.

    Raises:
        ValueError: Less space is free.
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
