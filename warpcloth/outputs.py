"""Files that are there whole or not at all."""

import contextlib
import errno
import os
import secrets
import socket
import sys
import warnings

from .interrupts import deferred

TEXT = {"encoding": "utf-8", "newline": ""}


def check_apart(outputs, inputs=()):
    """Refuses files that would be written over one another or over an input; None is no file.

    Raises:
        ValueError: Two outputs are one file, or one is an input.
    """
    taken = {os.path.realpath(path): "is a file of the input, which must not be changed" for path in inputs if path is not None}
    for path in outputs:
        if path is None:
            continue
        place = os.path.realpath(path)
        if place in taken:
            raise ValueError(f"{path}: {taken[place]}")
        taken[place] = "is given for two outputs; each must have a file of its own"


class Output:
    """A file that is written under another name, and renamed at `close`, so that a failure leaves an earlier result whole.

    As a context it closes, also where the user interrupts, with what there is; other errors leave nothing of it.

    Attributes:
        path: The file, once it is closed.
        finished: Whether it is.
    """

    def __init__(self, path, mode, **options):
        """Opens ``file``, what is written until then, as ``open`` does.

        Raises:
            FileNotFoundError: The folder does not exist.
            ValueError: The path is a folder or a device.
        """
        target = os.path.realpath(path)  # of a link the file that it stands for
        self.folder = os.path.dirname(target)
        if not os.path.isdir(self.folder):
            raise FileNotFoundError(f"{path}: the folder {self.folder} does not exist")
        if os.path.exists(target) and not os.path.isfile(target):
            raise ValueError(f"{path}: is no regular file; it must be one, or free")
        self.path, self.finished = os.fspath(path), False
        self._target, self._unfinished = target, f"{target}.{secrets.token_hex(4)}.unfinished"
        self.file = open(self._unfinished, mode, **options)

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        if kind is None or issubclass(kind, KeyboardInterrupt):
            self.close()
        else:
            self.discard()

    def close(self):
        """Finishes the file; once is enough."""
        if self.file.closed:
            return
        try:
            with deferred():
                self.finish()
                self.file.close()
                os.replace(self._unfinished, self._target)
                self.finished = True
        except BaseException:
            self.discard()
            raise

    def discard(self):
        """Leaves what was there before, unless the file is finished."""
        for part in (self.file, *self.parts()):
            with contextlib.suppress(OSError):  # what a full disk does not take is not wanted
                part.close()
        with contextlib.suppress(FileNotFoundError):
            os.remove(self._unfinished)

    def finish(self):
        """Writes what is known at the end only."""

    def parts(self):
        """Further files that are open."""
        return ()


class Lock:
    """Keeps other writers away from an output: a file beside it, `.<name>.lock`, which the system frees when its process ends.

    So a process that was killed leaves a file that holds nobody up, and that the next writer removes when it is done. Folders
    of a network are locked for all their machines where the file system does that.

    Args:
        output: Path of the output.

    Raises:
        BlockingIOError: Another writer has it, of this process or of another one.

    Warns:
        UserWarning: The file system of the folder has no locks.
    """

    def __init__(self, output):
        self._path = os.path.join(os.path.dirname(output), f".{os.path.basename(output)}.lock")
        self._file, self._process = None, os.getpid()
        while True:
            try:
                file = open(self._path, "a+", encoding="utf-8")
            except PermissionError:  # that of another user, who may have left it; if there is none the folder is another's
                file = open(self._path, encoding="utf-8")
            try:
                _lock(file)
            except OSError as error:
                file.seek(0)
                with contextlib.suppress(OSError):
                    holder = file.read(200).strip()
                file.close()
                if error.errno not in (errno.EAGAIN, errno.EACCES, errno.EDEADLK):
                    warnings.warn(f"{output}: its folder takes no locks; keep other runs away from it", stacklevel=5)
                    return
                raise BlockingIOError(
                    f"{output}: is being written by {holder or 'another run'}; wait until it ends, or give another output"
                ) from None
            # Or the writer before has removed the file between, and the next one would make another.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), os.stat(self._path)):
                    break
            file.close()
        self._file = file
        with contextlib.suppress(OSError):  # of a full disk; it is for the message alone
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
            file.flush()

    def release(self):
        """Lets others write; once is enough. In a process that was forked from the writer's it does nothing."""
        if self._file is None or self._process != os.getpid():
            return
        with contextlib.suppress(OSError):
            os.remove(self._path)
        self._file.close()
        self._file = None


def _lock(file):
    """Locks a file for this process, or raises an OSError at once."""
    if sys.platform == "win32":
        import msvcrt

        file.seek(2**20)  # beyond what is read, for nobody else could read what is locked
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
