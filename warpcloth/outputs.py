"""Files that are there whole or not at all."""

import contextlib
import os
import secrets

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
        self.path = os.fspath(path)
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
            self.finish()
            self.file.close()
            os.replace(self._unfinished, self._target)
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
