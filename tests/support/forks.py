"""Processes that are forked from one which has imported what they need."""

import json
import os
import signal
import subprocess
import sys
from contextlib import suppress

SERVER = """
import json, os, sys, traceback

names = {"__name__": "forks"}
exec(compile(json.loads(sys.stdin.readline()), "setup", "exec"), names)
for line in sys.stdin:
    code, said, names["given"] = json.loads(line)
    child = os.fork()
    if child == 0:
        for number, path, flags in ((0, os.devnull, os.O_RDONLY), (1, said, os.O_WRONLY | os.O_CREAT | os.O_APPEND)):
            os.dup2(os.open(path, flags), number)
        os.dup2(1, 2)
        try:
            exec(compile(code, "fork", "exec"), names)
            status = 0
        except BaseException:
            traceback.print_exc()
            status = 1
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    print("started", child, flush=True)
    print("ended", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


class Forks:
    """A process with a setup, such as imports, that forks one child after the other.

    Args:
        setup: Python that runs once, before all children.
        environment: Variables beside those of this process.
    """

    def __init__(self, setup, **environment):
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self._process = subprocess.Popen([sys.executable, "-c", SERVER], env=os.environ | environment, **pipes)
        self._running = None  # the number of the child
        self._tell(setup)

    def __enter__(self):
        return self

    def __exit__(self, *_error):
        if self._running is not None:
            with suppress(ProcessLookupError):
                os.kill(self._running, signal.SIGKILL)
        self._process.communicate()

    def _tell(self, what):
        print(json.dumps(what), file=self._process.stdin, flush=True)

    def _heard(self, word):
        """Returns the number that the process says behind a word."""
        said, number = self._process.stdout.readline().split()
        assert said == word
        return int(number)

    def start(self, code, said, *given):
        """Starts Python, with the names of the setup and the list ``given``, which prints to a file; the number of the process.

        A child before it must end by itself.
        """
        if self._running is not None:
            self.wait()
        self._tell((code, str(said), given))
        self._running = self._heard("started")
        return self._running

    def wait(self):
        """Waits for the child; its exit code, or the negative number of the signal that ended it."""
        ended = self._heard("ended")
        self._running = None
        return ended
