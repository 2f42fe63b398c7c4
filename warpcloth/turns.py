"""Threads of one process take turns with Warp, which guards little of what all of them share.

The graph that is being recorded, the modules that are loaded and the overloads of kernels are of the whole process: threads
that bind or step side by side get wrong arrays, or end the process. So all that records, launches or allocates here waits for
its turn: building a model, binding, each step or frame, each solve of :class:`warpcloth.Arap`, each measure of a frame,
:func:`warpcloth.equilibrium`, :func:`warpcloth.svd` and the like. Of several calls of :func:`warpcloth.simulate` the frames
alternate; nobody waits for what is done between frames, such as writing a file or ``progress``. A thread that has its turn may
take it again. What another library of the same process does with Warp does not wait.
"""

import os
import threading
from contextlib import contextmanager
from functools import wraps


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
        """Lets this thread work within the turn of another one, which waits for it."""
        self._here.shared = True
        try:
            yield
        finally:
            self._here.shared = False


TURN = _Turn()
if hasattr(os, "register_at_fork"):  # a child has this thread alone, and would wait for ever for the turn of another
    os.register_at_fork(before=TURN.__enter__, after_in_parent=TURN.__exit__, after_in_child=TURN.__exit__)


def in_turn(function):
    """The function, called when it is its thread's turn."""

    @wraps(function)
    def waiting(*args, **kwargs):
        with TURN:
            return function(*args, **kwargs)

    return waiting


def methods_in_turn(kind, *names):
    """Makes the methods of these names that a class has of its own wait for their turn."""
    for name in names:
        if name in vars(kind):
            setattr(kind, name, in_turn(vars(kind)[name]))
