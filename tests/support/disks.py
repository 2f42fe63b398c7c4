"""A disk with little room, for which a limit on the size of files stands in."""

import resource
from contextlib import contextmanager


@contextmanager
def room_for(size):
    """Lets this process write no file beyond a number of bytes."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limit[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
