"""Threads of this process that replay graphs in parallel on the CPU; Warp releases Python's global lock in a replay."""

import ctypes
import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import warp as wp

from ..base.turns import TURN
from ..kernels import barrier as kernels


def _leave():
    """Returns the address of the C function that yields the core to another thread."""
    function = ctypes.windll.kernel32.SwitchToThread if sys.platform == "win32" else ctypes.CDLL(None).sched_yield
    return ctypes.cast(function, ctypes.c_void_p).value


class ThreadPool:
    """CPU threads that share the steps of one stepper. Each replays its own graphs, and they synchronise at barriers.

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
        """Index of the thread of the pool for which the current thread launches or records."""
        return getattr(self._here, "thread", 0)

    @property
    def leads(self):
        """Whether :attr:`thread` is 0, which does the work that is not shared."""
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
        """Launches a barrier, at which threads wait until all have arrived; nothing with one thread."""
        if self.threads > 1:
            model.launch(model.kernel(kernels.wait_at_barrier), 1, [self.threads, self._leave], [self._barrier])

    def launch_alone(self, model, *launches):
        """Calls ``launches`` in the first thread; the other threads wait until they are done."""
        if self.leads:
            for launch in launches:
                launch()
        self.launch_barrier(model)

    def run(self, functions):
        """Calls each function in a thread of its own, and returns when all have ended.

        Calls of `run` from several threads run one after another.

        Args:
            functions: At most as many as there are threads.

        Raises:
            Exception: The first that a function raises. Threads that wait at the barrier are released.
        """
        if self.threads == 1:
            for function in functions:
                function()
            return
        if self._process != os.getpid():
            self._start()
        with self._busy:
            if self._running is not None:
                self._running.exception()  # waits, if a second interrupt left a run behind
            # A thread of the pool starts the others, because interrupts come in the main thread only: so all start, or none.
            self._running = self._pool.submit(self._run, functions)
            try:
                self._running.result()
            except KeyboardInterrupt:
                self._running.exception()  # waits until all have ended, so that the state is consistent
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
            with TURN.shared():  # the lock of the thread that called run
                function()
        except BaseException as error:
            self._barrier.numpy()[kernels.ABANDONED] = 1
            return error
        return None
