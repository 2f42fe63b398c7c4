"""A time limit for runs, and the mean time of their frames."""

import time

import numpy as np

# What a time limit counts: the time on the wall, or that of all threads of this process, which other processes do not prolong.
CLOCKS = {"wall": time.perf_counter, "process": time.process_time}

# A frame counts for at most so many times the time of the longer of its neighbours. Newton's method may take 5 times as long in
# a frame as before and after it.
MAX_RATIO = 10.0


class TooSlow(Exception):
    """Raised when the time limit is exceeded."""


class Clock:
    """A ``progress`` that ends a run ``limit`` seconds after frame 0 is stored, so that compilation does not count.

    ``clock`` is one of :data:`CLOCKS`; ``frames`` has the time of each frame [s].
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
    """Returns the mean of the times of successive frames (F,).

    A frame counts for at most ``MAX_RATIO`` times the longer of its neighbours, so that an interruption counts little.
    """
    times = np.asarray(times, dtype=np.float64)
    if len(times) > 1:
        near = np.pad(times, 1, mode="reflect")
        times = np.minimum(times, MAX_RATIO * np.maximum(near[:-2], near[2:]))
    return float(times.mean())


def time_spread(times):
    """Returns by how much the times of successive frames (F,) differ from those of their neighbours, (low, high).

    These are the quartiles, over the median, of the time of each inner frame divided by the mean of its neighbours' times; (1,
    1) for less than three frames.
    """
    if len(times) < 3 or not np.min(times) > 0.0:
        return 1.0, 1.0
    times = np.asarray(times, dtype=np.float64)
    low, middle, high = np.percentile(times[1:-1] / (times[:-2] + times[2:]), [25, 50, 75]).tolist()
    return low / middle, high / middle
