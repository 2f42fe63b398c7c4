"""Threads of this process that replay graphs in parallel on the CPU: Warp releases Python's lock meanwhile."""

import ctypes
import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import warp as wp

from ..base.turns import TURN
from ..kernels import barrier as kernels


def _leave():
    """The address of the C function that yields the core to another thread."""
    function = ctypes.windll.kernel32.SwitchToThread if sys.platform == "win32" else ctypes.CDLL(None).sched_yield
    return ctypes.cast(function, ctypes.c_void_p).value


class ThreadPool:
    """Threads of the CPU that share the steps of one stepper: each replays graphs of its own, and they meet at a barrier.

    Args:
        threads: Number of threads. With 1 no thread is started, and there is no barrier.
    """

    def __init__(self, threads):
        self.threads, self._here = threads, threading.local()
        if threads > 1:
            self._start()
            self._barrier = wp.zeros(kernels.NUMBERS, dtype=wp.int32, device="cpu")
            self._leave = _leave()

    def _start(self):
        """Starts the threads; a forked process does not inherit them and starts its own."""
        self._pool = ThreadPoolExecutor(self.threads, thread_name_prefix="warpcloth")
        self._busy, self._running, self._process = threading.Lock(), None, os.getpid()

    @property
    def thread(self):
        """Number of the thread, from 0, for which this thread launches or records."""
        return getattr(self._here, "thread", 0)

    @property
    def leads(self):
        """Whether :attr:`thread` is the first, which does the work that is not shared."""
        return self.thread == 0

    def as_thread(self, thread, launch):
        """Returns a function that calls ``launch`` with :attr:`thread` set to this one."""

        def launch_part():
            before, self._here.thread = self.thread, thread
            try:
                launch()
            finally:
                self._here.thread = before

        return launch_part

    def part(self, count):
        """Returns (first, count) of the share of this thread in ``count`` items."""
        first = count * self.thread // self.threads
        return first, count * (self.thread + 1) // self.threads - first

    def launch_barrier(self, model):
        """Launches a barrier: a thread continues when all have arrived. With one thread it launches nothing."""
        if self.threads > 1:
            model.launch(model.kernel(kernels.wait_at_barrier), 1, [self.threads, self._leave], [self._barrier])

    def launch_alone(self, model, *launches):
        """Calls ``launches`` in the first thread; the other threads wait until they are done."""
        if self.leads:
            for launch in launches:
                launch()
        self.launch_barrier(model)

    def run(self, functions):
        """Calls each function in a thread of its own, and returns when all have ended; there are at most as many as threads.

        Calls from several threads run one after another.

        Raises:
            Exception: The first one that a function raises. Threads that wait for that function at the barrier are released.
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
        self._barrier.numpy()[:] = 0
        others = [self._pool.submit(self._guard, function) for function in functions[1:]]
        failures = [self._guard(functions[0]), *(other.result() for other in others)]
        for failure in failures:
            if failure is not None:
                raise failure

    def _guard(self, function):
        """Calls the function; returns the exception that it raises, or None."""
        try:
            with TURN.shared():  # the turn of the thread that called run
                function()
        except BaseException as error:
            self._barrier.numpy()[kernels.ABANDONED] = 1
            return error
        return None
