"""Sizes that no machine takes, refused before anything runs: what memory or a disk has no room for, and counts without end."""

import os
import shutil

# Steps of a frame, iterations of a step, copies: at a microsecond each, the least that any takes, more are minutes or hours.
MOST = 10_000_000
# Frames: their numbers are time codes of a stage, see `usd.values.MOST_TIME_CODE`.
MOST_FRAMES = 1_000_000_000


def available_memory():
    """Bytes that this process can still be given, as the kernel of Linux and its control group say; None where nobody says."""
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
        except (OSError, StopIteration, ValueError):  # not Linux, or no limit, which is the word "max"
            found.append(None)
    free, limit, used = found
    rooms = [free] if limit is None or used is None else [free, limit - used]
    return min((room for room in rooms if room is not None), default=None)


def refuse_memory(what, size):
    """Refuses what takes more memory than there is.

    Args:
        what: What it is, as the start of a sentence: "frames is 1000000000".
        size: Bytes.

    Raises:
        ValueError: There are fewer.
    """
    room = available_memory()
    if room is not None and size > room:
        raise ValueError(
            f"{what}, which takes {shown_bytes(size)} of memory; it must fit in the {shown_bytes(room)} that are free"
        )


def refuse_disk(what, size, folder):
    """Refuses what takes more room than the disk of a folder has, which must exist.

    Raises:
        ValueError: There is less.
    """
    room = shutil.disk_usage(folder).free
    if size > room:
        raise ValueError(
            f"{what}, which takes {shown_bytes(size)} of the disk of {os.path.abspath(folder)}; "
            f"it must fit in the {shown_bytes(room)} that are free there"
        )


def shown_bytes(size):
    """A size in a unit of its own: 1.5 GB."""
    size, units = float(size), ["bytes", "kB", "MB", "GB", "TB"]
    while size >= 1000.0 and len(units) > 1:
        size /= 1000.0
        units.pop(0)
    return f"{size:.3g} {units[0]}"
