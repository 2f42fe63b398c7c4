"""Threads of this process that step in parallel on the CPU; Warp releases Python's global lock while it replays a graph."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor

from ..base.turns import TURN


class ThreadPool:
    """CPU threads that share out work, such as the copies of a batch.

    Args:
        threads: Number of threads. With 1 no thread is started.
    """

    def __init__(self, threads):
        self.threads = threads
        if threads > 1:
            self._start()

    def _start(self):
        """Starts the threads; a forked process does not inherit them and starts its own."""
        self._pool = ThreadPoolExecutor(self.threads, thread_name_prefix="warpcloth")
        self._busy, self._running, self._process = threading.Lock(), None, os.getpid()

    def run(self, functions):
        """Calls each function in a thread of its own, and returns when all have ended.

        Calls of `run` from several threads run one after another.

        Args:
            functions: At most as many as there are threads.

        Raises:
            Exception: The first that a function raises, after all have ended.
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
        others = [self._pool.submit(_guard, function) for function in functions[1:]]
        failures = [_guard(functions[0]), *(other.result() for other in others)]
        for failure in failures:
            if failure is not None:
                raise failure


def _guard(function):
    """Calls the function; returns the exception that it raises, or None."""
    try:
        with TURN.shared():  # the lock of the thread that called run
            function()
    except BaseException as error:
        return error
    return None
