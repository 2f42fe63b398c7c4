"""Files that are there whole or not at all."""

import contextlib
import csv
import errno
import os
import secrets
import socket
import sys
import warnings

from .interrupts import deferred

# Of the files that USD writes and reads as stages.
STAGE_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
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
        real = os.path.realpath(path)
        if real in taken:
            raise ValueError(f"{path}: {taken[real]}")
        taken[real] = "is given for two outputs; each must have a file of its own"


class Output:
    """A file that is written under another name, and renamed at `close`, so that a failure leaves an earlier result whole.

    As a context manager it closes the file at the end, and with the rows so far if the user interrupts; other errors discard
    it.

    Attributes:
        path: The file, once it is closed.
        finished: Whether it is closed.
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


def write_table(path, columns, rows):
    """Writes a table of comma-separated values: the names of its columns, and rows of as many values; None is an empty cell.

    Raises:
        FileNotFoundError: The folder does not exist.
    """
    with Output(path, "x", **TEXT) as output:
        table = csv.writer(output.file, lineterminator="\n")
        table.writerow(columns)
        table.writerows(rows)


class Lock:
    """Locks an output against other writers by a file `.<name>.lock` beside it, which is unlocked when its process ends.

    A killed process leaves a file that blocks nobody and that the next writer removes when it is done. In network folders the
    lock holds for all machines if the file system supports that.

    Args:
        output: Path of the output.

    Raises:
        BlockingIOError: Another writer, in this or another process, has the lock.

    Warns:
        UserWarning: The file system of the folder has no locks.
    """

    def __init__(self, output):
        self._path = os.path.join(os.path.dirname(output), f".{os.path.basename(output)}.lock")
        self._file, self._process = None, os.getpid()
        while True:
            try:
                file = open(self._path, "a+", encoding="utf-8", opener=_open_itself)
            except PermissionError:  # the file of another user; if there is no file, the folder cannot be written
                file = open(self._path, encoding="utf-8", opener=_open_itself)
            try:
                _lock(file)
            except OSError as error:
                file.seek(0)
                with contextlib.suppress(OSError):
                    holder = file.read(200).strip()
                file.close()
                if error.errno not in (errno.EAGAIN, errno.EACCES, errno.EDEADLK):
                    warnings.warn(f"{output}: its folder does not support locks; do not start another run to it", stacklevel=5)
                    return
                raise BlockingIOError(
                    f"{output}: is being written by {holder or 'another run'}; wait until it ends, or give another output"
                ) from None
            # Otherwise the last writer has removed this file in the meantime, and the next one would make another.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), os.stat(self._path)):
                    break
            file.close()
        self._file = file
        with contextlib.suppress(OSError):  # a full disk; the text is only for the message
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
            file.flush()

    def release(self):
        """Lets others write. Further calls do nothing, nor do calls in a process that was forked from the writer's."""
        if self._file is None or self._process != os.getpid():
            return
        with contextlib.suppress(OSError):
            os.remove(self._path)
        self._file.close()
        self._file = None


def _open_itself(path, flags):
    """Opens a file that is no link, since what is written would replace the text of the file that a link stands for."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


def _lock(file):
    """Locks a file for this process, or raises an OSError at once."""
    if sys.platform == "win32":
        import msvcrt

        file.seek(2**20)  # beyond the text, because others cannot read locked bytes
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
