"""The folder in which Warp keeps compiled kernels: whether it has room, and errors that name it."""

import errno
import tempfile

_ROOM = 2**23  # bytes that the source and binary of a module and the parsed headers need
HEADERS = "wp_headers"  # first part of the name of the folder of parsed headers in the cache


def refuse_full(cache):
    """Checks that a folder has room for a binary.

    Raises:
        OSError: The disk is full, or the folder cannot be written.
    """
    try:
        with tempfile.TemporaryFile(dir=cache) as file:
            file.write(bytes(_ROOM))
    except OSError as error:
        raise described(error, cache) from None


def described(error, cache):
    """Returns an OSError like ``error`` whose message says that the folder is the kernel cache."""
    where = f"{cache}, where Warp keeps compiled kernels (WARP_CACHE_PATH names another folder)"
    return OSError(error.errno or errno.EIO, error.strerror or str(error), where)
