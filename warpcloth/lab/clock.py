"""An end to runs that take too long."""

import time


class TooSlow(Exception):
    """The time is up."""


class Clock:
    """Ends a run once ``limit`` seconds have passed since its start was kept: what is compiled before does not count.

    To be called as ``progress`` of :func:`warpcloth.simulate`.

    Attributes:
        frames: What each frame took [s].
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
