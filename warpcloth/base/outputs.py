"""Output files that are written under a temporary name and renamed when complete, and locks against other writers."""

import contextlib
import csv
import errno
import os
import re
import secrets
import socket
import stat
import sys
import tempfile
import warnings

from .interrupts import deferred

# Endings of USD stages.
STAGE_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
TEXT = {"encoding": "utf-8", "newline": ""}


def check_apart(outputs, inputs=()):
    """Checks that no output file is written twice or replaces an input. Entries that are None are skipped.

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


def check_replaceable(*paths):
    """Checks that files can be written, or replaced. It makes no file with a name, so that an interrupt leaves nothing.

    Raises:
        FileNotFoundError: A folder does not exist.
        OSError: A folder cannot be written.
        ValueError: A path is a folder or a device.
    """
    for folder in dict.fromkeys(os.path.dirname(_file_of(path)) for path in paths):
        try:
            with deferred():  # some file systems have only files with names, which are then removed
                tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:
            raise OSError(error.errno, f"the folder cannot be written ({error.strerror})", folder) from None


def keep_mode(file, path):
    """Gives a file the permissions of the older file at a path, which it is to replace, if there is one."""
    with contextlib.suppress(OSError):  # there is none, or the file system has no permissions
        os.chmod(file, stat.S_IMODE(os.stat(path).st_mode))


def _file_of(path):
    """Returns the file to write for a path, behind links; raises as `Output` does."""
    target = os.path.realpath(path)  # replace the file behind a link, not the link
    folder = os.path.dirname(target)
    if not os.path.isdir(folder):
        raise FileNotFoundError(f"{path}: the folder {folder} does not exist")
    if os.path.exists(target) and not os.path.isfile(target):
        raise ValueError(f"{path}: is no regular file; it must be one, or free")
    if os.path.splitext(target)[1] != os.path.splitext(path)[1]:
        raise ValueError(f"{path}: is a link to {target}; it must end as that does")
    return target


class Output:
    """A file that is written under a temporary name and renamed by `close`, so that a failure leaves an older file whole.

    It has the permissions of an older file that it replaces. As a context manager it closes the file at the end of the block.
    An interrupt keeps what is written so far; any other error discards it.

    Attributes:
        path: Path of the finished file.
        file: The open temporary file.
        finished: Whether the file is closed and renamed.
    """

    def __init__(self, path, mode, **options):
        """Opens the temporary file, in the folder of ``path``, with the mode and options of `open`.

        Raises:
            FileNotFoundError: The folder does not exist.
            ValueError: The path is a folder or a device.
        """
        target = _file_of(path)
        self.folder = os.path.dirname(target)
        self.path, self.finished, self._discarded = os.fspath(path), False, False
        self._target, self._unfinished = target, f"{target}.{secrets.token_hex(4)}.unfinished"
        self.file = open(self._unfinished, mode, **options)
        keep_mode(self._unfinished, target)

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        if kind is None or issubclass(kind, KeyboardInterrupt):
            self.close()
        else:
            self.discard()
            if (named := self.named(error)) is not error:
                raise named from error

    def complete(self):
        """Completes the file under its temporary name, so that `close` only renames it. Further calls do nothing."""
        if not self.file.closed:
            self.finish()
            self.file.close()

    def close(self):
        """Completes the file and renames it. Further calls do nothing."""
        if self.finished or self._discarded:
            return
        try:
            with deferred():
                self.complete()
                os.replace(self._unfinished, self._target)
                self.finished = True
        except BaseException as error:
            self.discard()
            raise self.named(error) from None

    def named(self, error):
        """Returns an error with the path in place of one of the system that names no path, such as that of a full disk."""
        if isinstance(error, OSError) and error.errno is not None and error.filename in (None, self._unfinished):
            return OSError(error.errno, error.strerror, self.path)
        return error

    def discard(self):
        """Removes the temporary file; an older file at the path stays."""
        self._discarded = True
        for part in (self.file, *self.parts()):
            with contextlib.suppress(OSError):  # a full disk fails to write the buffer, which is not needed
                part.close()
        with contextlib.suppress(FileNotFoundError):
            os.remove(self._unfinished)

    def finish(self):
        """Writes what is known only at the end; for subclasses."""

    def parts(self):
        """Returns further open files; for subclasses."""
        return ()


class OutputSet:
    """Binary files that replace older files, renamed one after another once all of them are written.

    An error or interrupt before the first is renamed leaves nothing of them. An interrupt among the renames waits until all are
    renamed. If a rename fails, or a second interrupt comes, files renamed before stay, and nothing is left of the others.
    """

    def __init__(self):
        self._outputs = []

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        try:
            if kind is None:
                with deferred():
                    for output in self._outputs:
                        output.close()
        finally:
            with deferred():
                for output in self._outputs:
                    if not output.finished:
                        output.discard()

    @contextlib.contextmanager
    def writing(self, path):
        """Opens the temporary file of a path for the block."""
        with deferred():
            output = Output(path, "xb")
            self._outputs.append(output)
        try:
            yield output.file
            output.complete()
        except OSError as error:
            raise output.named(error) from error


def write_table(path, columns, rows):
    """Writes comma-separated values: a line of column names, then the rows. None gives an empty cell.

    Raises:
        FileNotFoundError: The folder does not exist.
    """
    with Output(path, "x", **TEXT) as output:
        table = csv.writer(output.file, lineterminator="\n")
        table.writerow(columns)
        table.writerows(rows)


class Lock:
    """Locks an output against other writers, by a file `.<name>.lock` beside it.

    The lock ends with its process. A killed process leaves the file, which blocks nobody, and which the next writer removes.
    In network folders the lock holds for all machines if the file system supports that.

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
            except PermissionError:  # another user's file; without a file the folder cannot be written, and this raises again
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
            # The last writer may have removed this file between the two calls. Then try again with a new one.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), os.stat(self._path)):
                    break
            file.close()
        self._file = file
        with contextlib.suppress(OSError):  # the disk may be full, and the text is only for the error message
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
            file.flush()

    def release(self):
        """Releases the lock. Further calls do nothing, nor do calls in a forked process."""
        if self._file is None or self._process != os.getpid():
            return
        with contextlib.suppress(OSError):
            os.remove(self._path)
        self._file.close()
        self._file = None


@contextlib.contextmanager
def writing_alone(paths, numbered=False):
    """Locks files against other such writers for the block, and first removes what killed ones left of the files.

    Args:
        paths: Paths of the files.
        numbered: Whether the last number in the names is that of a frame. All frames together then have one lock, and what is
            left of frames with other numbers is removed too.

    Raises:
        BlockingIOError: Another writer, in this or another process, has a lock.
    """
    folders = {}  # names of files by folder
    for path in paths:
        folder, name = os.path.split(os.path.realpath(path))
        folders.setdefault(folder, set()).add(_of_all_frames(name) if numbered else name)
    with contextlib.ExitStack() as locks:
        for folder, names in folders.items():
            for name in sorted(names):
                _locked(locks, folder, name)
        for folder, names in folders.items():
            for file in filter(re.compile(r".+\.[0-9a-f]{8}\.unfinished").fullmatch, os.listdir(folder)):
                name = file.rsplit(".", 2)[0]
                if (_of_all_frames(name) if numbered else name) in names:
                    # A file may be one of numbered frames for one writer and not for another.
                    with contextlib.suppress(OSError), contextlib.ExitStack() as others:
                        for other in {name, _of_all_frames(name)} - names:
                            _locked(others, folder, other)
                        os.remove(os.path.join(folder, file))
        yield


def _of_all_frames(name):
    """Returns the name of a file with # for its last number."""
    return re.sub(r"\d+(?=\D*$)", "#", name)


def _locked(locks, folder, name):
    """Locks a file until the stack of locks is closed."""
    with deferred():
        locks.callback(Lock(os.path.join(folder, name)).release)


def _open_itself(path, flags):
    """Opens a file but follows no link, because writing would replace the text of the file behind it."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


def _lock(file):
    """Locks a file for this process, or raises an OSError at once."""
    if sys.platform == "win32":
        import msvcrt

        file.seek(2**20)  # beyond the text, because others cannot read locked bytes on Windows
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
