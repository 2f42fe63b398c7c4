"""A time limit for runs, and the mean time of their frames."""

import time

import numpy as np

# What a time limit counts: the time on the wall, or that of all threads of this process, which other processes do not prolong.
CLOCKS = {"wall": time.perf_counter, "process": time.process_time}


class TooSlow(Exception):
    """Raised when the time limit is exceeded."""


class Clock:
    """Ends a run ``limit`` seconds after frame 0 is stored, so that compilation does not count.

    It is passed as ``progress`` to :func:`warpcloth.simulate`. ``clock`` is one of :data:`CLOCKS`.

    Attributes:
        frames: Time of each frame [s].
    """

    def __init__(self, limit, progress=None, clock="wall"):
        self.limit, self.progress, self.frames, self.time = limit, progress, [], CLOCKS[clock]

    def __call__(self, frame, frames):
        now = self.time()
        if frame:
            self.frames.append(now - self.last)
        if self.progress is not None:
            self.progress(frame, frames)
        if frame < frames and sum(self.frames) > self.limit:
            raise TooSlow
        self.last = self.time()


def mean_time(times):
    """Returns the mean of the times of successive frames (F,), where each is the median of its own and its neighbours' times.

    The mean times the number of frames is the time of the motion, also if some frames are more work, as in contact. A median of
    all frames would not show that. An interruption of a single frame does not count.
    """
    if len(times) < 2:
        return float(np.mean(times))
    near = np.lib.stride_tricks.sliding_window_view(np.pad(times, 1, mode="reflect"), 3)
    return float(np.median(near, axis=1).mean())


def time_spread(times):
    """Returns by how much the times of successive frames (F,) differ from those of their neighbours, (low, high).

    The time of each frame is divided by the mean of its neighbours' times. These are the quartiles of the quotients, divided by
    their median.
    """
    if len(times) < 2:
        return 1.0, 1.0
    near = np.pad(times, 1, mode="reflect")
    low, middle, high = np.percentile(np.asarray(times) / (near[:-2] + near[2:]), [25, 50, 75]).tolist()
    return low / middle, high / middle
