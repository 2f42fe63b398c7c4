"""Threads of this process that replay graphs side by side on the CPU: Warp leaves Python alone meanwhile."""

import ctypes
import os
import sys
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor

import warp as wp

from ..base.checks import whole
from ..base.turns import TURN
from ..kernels import barrier as kernels


def _leave():
    """The address of the C function that leaves the core to another thread."""
    function = ctypes.windll.kernel32.SwitchToThread if sys.platform == "win32" else ctypes.CDLL(None).sched_yield
    return ctypes.cast(function, ctypes.c_void_p).value


def _cores():
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Team:
    """Threads that share the work on a model.

    Args:
        threads: How many.
        device: The Warp device.

    Warns:
        UserWarning: If there are fewer cores.

    Raises:
        ValueError: If ``threads`` is below 1, or above on another device than the CPU or in Warp's debug mode.
    """

    def __init__(self, threads, device):
        whole("threads", threads, 1)
        self.threads, self._here = int(threads), threading.local()
        if self.threads == 1:
            return
        if not device.is_cpu:
            raise ValueError(f"threads is {threads} on {device}, which has its own; more than 1 is for device='cpu'")
        if wp.config.mode == "debug" and wp.config.enable_tiles_in_stack_memory:
            raise ValueError(
                f"threads is {threads} in Warp's debug mode, where threads of one kernel share the pointer to its tiles; "
                "wp.config.mode='release' or wp.config.enable_tiles_in_stack_memory=False take more than 1"
            )
        if self.threads > _cores():
            warnings.warn(f"threads is {threads} on {_cores()} cores; more threads than cores are slower", stacklevel=5)
        self._start()
        self._meeting = wp.zeros(kernels.NUMBERS, dtype=wp.int32, device=device)
        self._leave = _leave()

    def _start(self):
        """The threads themselves, which a forked process does not take over."""
        self._pool = ThreadPoolExecutor(self.threads, thread_name_prefix="warpcloth")
        self._busy, self._running, self._process = threading.Lock(), None, os.getpid()

    @property
    def thread(self):
        """Which of the threads what is launched or recorded here is for, from 0."""
        return getattr(self._here, "thread", 0)

    @property
    def leads(self):
        """Whether that is the first, which does what is not shared."""
        return self.thread == 0

    def as_thread(self, thread, launch):
        """``launch`` as a function that launches what is for that thread."""

        def launch_part():
            before, self._here.thread = self.thread, thread
            try:
                launch()
            finally:
                self._here.thread = before

        return launch_part

    def part(self, count):
        """The (first, count) of ``count`` things that are for this thread."""
        first = count * self.thread // self.threads
        return first, count * (self.thread + 1) // self.threads - first

    def launch_meeting(self, model):
        """Goes on when all threads have come here; for one thread nothing."""
        if self.threads > 1:
            model.launch(model.kernel(kernels.wait_at_barrier), 1, [self.threads, self._leave], [self._meeting])

    def launch_alone(self, model, *launches):
        """Calls these in the first thread, and goes on when they are done."""
        if self.leads:
            for launch in launches:
                launch()
        self.launch_meeting(model)

    def run(self, functions):
        """Calls one function in each thread, as many as there are or fewer, and returns when all have ended.

        Calls from several threads, as of several steppers of one model, run one after another.

        Raises:
            Exception: What a function raises, of several the first one. What waits for it is let go.
        """
        if self.threads == 1:
            for function in functions:
                function()
            return
        if self._process != os.getpid():
            self._start()
        with self._busy:
            if self._running is not None:
                self._running.exception()  # has ended, but where a second interrupt left it behind
            # By a thread of the pool: an interrupt, which comes in the main thread alone, finds all of them started or none.
            self._running = self._pool.submit(self._run, functions)
            try:
                self._running.result()
            except KeyboardInterrupt:
                self._running.exception()  # the state is whole again when all have ended
                raise

    def _run(self, functions):
        self._meeting.numpy()[:] = 0
        others = [self._pool.submit(self._guard, function) for function in functions[1:]]
        failures = [self._guard(functions[0]), *(other.result() for other in others)]
        for failure in failures:
            if failure is not None:
                raise failure

    def _guard(self, function):
        """What the function raises, or None."""
        try:
            with TURN.shared():  # the turn of the thread that called run
                function()
        except BaseException as error:
            self._meeting.numpy()[kernels.ABANDONED] = 1
            return error
        return None
