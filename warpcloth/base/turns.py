"""A lock through which the threads of one process take turns with Warp, whose global state is not thread-safe.

Graph capture, loaded modules and kernel overloads belong to the whole process. Threads that bind or step at the same time get
wrong arrays or crash. So calls that use Warp hold the lock from end to end. It is taken where they enter:

- by building a model; by ``bind``, ``step``, ``frame`` and ``reset`` of every solver and stepper, their subclasses included;
- by :func:`warpcloth.simulate` while it binds, for each frame and what is found at its end, and for the verdicts on the run;
- by functions that are complete in themselves, such as :func:`warpcloth.equilibrium`, :func:`warpcloth.svd`, each solve of
  :class:`warpcloth.Arap`, each measure of a frame and each picture;
- by every capture of a graph.

The kernels, arrays, energies and solvers below these entries do not take it again. Several calls of :func:`warpcloth.simulate`
alternate frame by frame. Work between frames, such as writing a file or calling ``progress``, does not hold the lock. It is
re-entrant. Other libraries that use Warp in this process do not take it. Nor does ``numpy()`` of an array on CUDA, which sets
another stream for the device meanwhile, so that a capture in another thread fails.
"""

import os
import threading
from contextlib import contextmanager
from functools import wraps

from .types import Call


class _Turn:
    """A re-entrant lock that its owner can share with threads that work for it."""

    def __init__(self):
        self._lock, self._here = threading.RLock(), threading.local()

    def __enter__(self):
        if not self._shared:
            self._lock.acquire()

    def __exit__(self, *error):
        if not self._shared:
            self._lock.release()

    @property
    def held(self):
        """Whether this thread holds the lock, or works for a thread that does."""
        return self._shared or self._lock._is_owned()

    @property
    def _shared(self):
        return getattr(self._here, "shared", False)

    @contextmanager
    def shared(self):
        """Lets this thread work while another thread holds the lock and waits for it."""
        self._here.shared = True
        try:
            yield
        finally:
            self._here.shared = False


TURN = _Turn()
if hasattr(os, "register_at_fork"):  # a forked child lacks the thread that holds the lock, and would wait forever
    os.register_at_fork(before=TURN.__enter__, after_in_parent=TURN.__exit__, after_in_child=TURN.__exit__)


def in_turn(function: Call) -> Call:
    """Wraps a function so that it holds the lock while it runs."""

    @wraps(function)
    def waiting(*args, **kwargs):
        with TURN:
            return function(*args, **kwargs)

    return waiting  # type: ignore[return-value]  # it has the parameters of the function


def methods_in_turn(kind, *names):
    """Wraps the named methods by `in_turn`, those that the class itself defines."""
    for name in names:
        if name in vars(kind):
            setattr(kind, name, in_turn(vars(kind)[name]))
