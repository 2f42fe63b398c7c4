"""A time limit for runs."""

import time


class TooSlow(Exception):
    """Raised when the time limit is exceeded."""


class Clock:
    """Ends a run ``limit`` seconds after frame 0 is stored, so that compilation does not count.

    It is passed as ``progress`` to :func:`warpcloth.simulate`.

    Attributes:
        frames: Time of each frame [s].
    """

    def __init__(self, limit, progress=None):
        self.limit, self.progress, self.frames = limit, progress, []

    def __call__(self, frame, frames):
        now = time.perf_counter()
        if frame:
            self.frames.append(now - self.last)
        if self.progress is not None:
            self.progress(frame, frames)
        if frame < frames and sum(self.frames) > self.limit:
            raise TooSlow
        self.last = time.perf_counter()
