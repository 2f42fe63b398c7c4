"""Processes that are forked from one which has imported what they need."""

import json
import os
import subprocess
import sys

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
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
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
        self._tell(setup)

    def __enter__(self):
        return self

    def __exit__(self, *_error):
        self._process.communicate()

    def _tell(self, what):
        print(json.dumps(what), file=self._process.stdin, flush=True)

    def start(self, code, said, *given):
        """Starts Python, with the names of the setup and the list ``given``, which prints to a file; the number of the process.

        The child before must have been waited for.
        """
        self._tell((code, str(said), given))
        return int(self._process.stdout.readline())

    def wait(self):
        """Waits for the child; its exit code, or the negative number of the signal that ended it."""
        return int(self._process.stdout.readline())
