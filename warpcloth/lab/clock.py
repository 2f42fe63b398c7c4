"""A time limit for runs."""

import time

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
