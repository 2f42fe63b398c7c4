"""Makes the threads of one process take turns with Warp, which does not protect its shared state.

The graph that is being recorded, the loaded modules and the overloads of kernels belong to the whole process. Threads that bind
or step at the same time get wrong arrays, or end the process. So every call that records, launches or allocates waits for its
turn: building a model, binding, each step or frame, each solve of :class:`warpcloth.Arap`, each measure of a frame,
:func:`warpcloth.equilibrium`, :func:`warpcloth.svd` and the like. Several calls of :func:`warpcloth.simulate` alternate frame
by frame; work between frames, such as writing a file or ``progress``, does not wait. A thread that has the turn may take it
again. Other libraries that use Warp in the same process do not take turns.
"""

import os
import threading
from contextlib import contextmanager
from functools import wraps

from .types import Call


class _Turn:
    """The turn of one thread, and of those that work for it."""

    def __init__(self):
        self._lock, self._here = threading.RLock(), threading.local()

    def __enter__(self):
        if not self._shared:
            self._lock.acquire()

    def __exit__(self, *error):
        if not self._shared:
            self._lock.release()

    @property
    def _shared(self):
        return getattr(self._here, "shared", False)

    @contextmanager
    def shared(self):
        """Lets this thread work within the turn of another thread, which waits for it."""
        self._here.shared = True
        try:
            yield
        finally:
            self._here.shared = False


TURN = _Turn()
if hasattr(os, "register_at_fork"):  # a child process has only this thread, and would wait forever for another
    os.register_at_fork(before=TURN.__enter__, after_in_parent=TURN.__exit__, after_in_child=TURN.__exit__)


def in_turn(function: Call) -> Call:
    """Wraps a function so that it waits for its thread's turn."""

    @wraps(function)
    def waiting(*args, **kwargs):
        with TURN:
            return function(*args, **kwargs)

    return waiting  # type: ignore[return-value]  # which has the parameters of the function


def methods_in_turn(kind, *names):
    """Makes those of the named methods that a class itself defines wait for their turn."""
    for name in names:
        if name in vars(kind):
            setattr(kind, name, in_turn(vars(kind)[name]))
