"""Parts that all commands share: device, outputs, progress and results on a terminal, and where measurements run."""

import contextlib
import errno
import os
import shutil
import sys
import tempfile
import unicodedata
from pathlib import Path

from ..base.checks import whole
from ..base.interrupts import Interrupted
from ..base.outputs import check_apart, check_replaceable
from ..picture.figures import PICTURES, check_path

_STREAMS = {1: "stdout", 2: "stderr"}
# Unicode categories to escape: control, format (which can reverse text), surrogates, line ends.
_STEERING = ("Cc", "Cf", "Cs", "Zl", "Zp")


def frames_folder_of(arguments):
    """Returns the folder of frames of the output, or None if the output is one file."""
    from ..usd.chunks import frames_folder

    output = Path(arguments.output)
    return None if arguments.single_file or output.suffix == ".usdz" else str(frames_folder(output))


def location(facts):
    """Returns the location of the output, in the words of a summary."""
    if not facts["frames_folder"]:
        return facts["file"]
    folder, together = facts["frames_folder"], "(they belong together: move both, or make one file with --single-file)"
    return f"{facts['file']}, with its frames in {folder}\n                {together}"


def own_output(name, ending, replace=False):
    """Returns the default output of a command: a file with a name and an ending in the current folder.

    Raises:
        ValueError: The file exists already and is not to be replaced, or the name cannot be that of a file.
    """
    if name != os.path.basename(name) or not name.isprintable() or name.strip(". ") == "" or {*"*?"} & {*name}:
        raise ValueError(f"the output would be called {name!r}, which cannot be the name of a file; give one with -o")
    output = f"{name}{ending}"
    if os.path.lexists(output) and not replace:
        raise ValueError(f"{output} exists already, and without -o nothing is replaced; give -o {output} to replace it")
    return output


def check_writable(*outputs):
    """Checks, before the first frame, that the folders of outputs can be written; None is skipped."""
    for output in filter(None, outputs):
        folder = os.path.dirname(os.path.realpath(output))  # of a link the folder of the file that it stands for
        try:
            if os.path.isdir(folder):
                tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:
            raise ValueError(f"output = {output}: the folder {folder} cannot be written ({error.strerror})") from None


def check_outputs(arguments, inputs=()):
    """Checks, before measurements start, that results can be written, and the number of processes.

    Raises:
        FileNotFoundError: A folder does not exist.
        ImportError: matplotlib is not installed.
        ValueError: A file cannot be written or is given twice, or the number of processes is not allowed.
    """
    if arguments.workers is not None:
        whole("workers", arguments.workers, least=1)
    check_apart([arguments.output, arguments.csv], inputs)
    if arguments.output:
        check_path(arguments.output, PICTURES)
    if arguments.csv:
        check_replaceable(arguments.csv)
    check_writable(arguments.output, arguments.csv)


class Bar:
    """A progress bar on a terminal; nothing elsewhere, nor if the environment has ``TQDM_DISABLE``."""

    bar = None

    def open(self, total, text, counts):
        """Shows a new bar, followed by ``counts``."""
        self.close()
        if not sys.stderr.isatty():
            return
        from tqdm import tqdm

        # tqdm would hide the bar on a terminal of unknown size.
        size = shutil.get_terminal_size()
        shape = {"ncols": min(size.columns, 120), "nrows": size.lines}
        form = "{desc}{percentage:3.0f}%|{bar}| " + counts
        bar = tqdm(total=total, desc=f"{text}: ", bar_format=form, leave=False, file=sys.stderr, **shape)
        self.bar = None if bar.disable else bar  # then TQDM_DISABLE is set

    def move(self, done, note=None):
        """Moves the bar to ``done``; ``note`` is shown after the counts."""
        if self.bar is not None:
            if note is not None:
                self.bar.set_postfix_str(note, refresh=False)
            self.bar.update(done - self.bar.n)

    def close(self):
        if self.bar is not None:
            self.bar.close()


@contextlib.contextmanager
def measuring(arguments, device):
    """Yields keyword arguments of a sweep: the number of processes, by default one on a GPU, and its progress.

    Raises:
        Interrupted: The user interrupts; the message says what is kept.
    """
    progress = Settings()
    try:
        yield {"workers": arguments.workers or (1 if device.is_cuda else None), "progress": progress}
    except KeyboardInterrupt:
        raise Interrupted(progress.interrupted()) from None
    finally:
        progress.close()


class Counter(Bar):
    """Counts what a command makes, such as frames that it writes, and shows it on a terminal, after its input is read."""

    def __init__(self, text, of):
        self.text, self.of, self.done, self.total = text, of, 0, None
        self.open(None, "reading", "")

    def __call__(self, done, total):
        if self.total is None:
            self.open(total, self.text, f"{{n_fmt}} of {{total_fmt}} {self.of}, {{remaining}} left")
        self.done, self.total = done, total
        self.move(done)


class Settings(Bar):
    """Shows the progress of the reference, and then of the settings of a sweep with the time left, on a terminal."""

    def __init__(self):
        self.done, self.total, self.substeps = 0, None, None

    def watch(self, substeps, frame, frames):
        if substeps != self.substeps:
            self.open(frames, f"reference by {substeps} steps a frame", "{n_fmt} of {total_fmt} frames, {remaining} left")
            self.substeps = substeps
        self.move(frame)

    def __call__(self, done, total, seconds):
        if total != self.total:
            self.open(total, "measuring", "{n_fmt} of {total_fmt} settings{postfix}")
        self.done, self.total = done, total
        self.move(done, None if seconds is None else f"{seconds // 60:.0f}:{seconds % 60:02.0f} left")

    def interrupted(self):
        """Says how many settings are kept."""
        if self.total is None:
            return "interrupted before the first setting; nothing was measured"
        return f"interrupted after {self.done} of {self.total} settings, which are kept; the same command goes on from there"


class Progress(Bar):
    """Counts frames, and shows them on a terminal."""

    def __init__(self, frames=None, hint=None, first="compiling"):
        self.frame, self.frames, self.hint, self.closed = None, frames, hint, False
        self.open(frames, first, "{n_fmt} of {total_fmt} frames{postfix}, {remaining} left")

    def __call__(self, frame, frames):
        begins = frame == 0 or frame > (self.frame or 0) + 1  # later than 0 begins a run that is resumed
        self.frame = frame
        if begins and self.hint:  # now that nothing was refused, and while it can still be followed
            if self.bar is not None:
                self.bar.clear()
            print(self.hint, file=sys.stderr)
        if self.bar is None:
            return
        if begins:
            self.bar.set_description("running", refresh=False)
            self.bar.reset(total=frames)
            self.bar.initial = self.bar.n = frame
        else:
            elapsed = self.bar.format_dict["elapsed"]
            self.move(frame, f"{elapsed / (frame - self.bar.initial):.3g} s each")

    def close(self):
        self.closed = True
        super().close()

    @contextlib.contextmanager
    def of(self, output):
        """Closes the bar, however the block ends; an interrupt after the last frame says where the frames are.

        Raises:
            Interrupted: The user interrupted before the first frame or after the last one; in between, the writer of the frames
                raises it.
        """
        try:
            yield
        except Interrupted:
            raise
        except KeyboardInterrupt:
            if self.frame is None:
                raise Interrupted("interrupted before the first frame; nothing was saved") from None
            if not self.closed:
                raise
            done = f"interrupted after frame {self.frame}, the last one"
            raise Interrupted(f"{done}; frames 0 to {self.frame} are in {output}") from None
        finally:
            self.close()


def aligned(rows, right=()):
    """Rows of texts as lines in columns, of which those with the numbers ``right`` are aligned to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    pads = [str.rjust if column in right else str.ljust for column in range(len(widths))]
    return ["  ".join(pad(text, width) for pad, text, width in zip(pads, row, widths, strict=True)).rstrip() for row in rows]


def warnings_once():
    """Returns a function for `warnings.showwarning` that shows each text once, and no categories that only libraries use."""
    texts = set()

    def show(message, category, filename, lineno, file=None, line=None):
        text = printable(" ".join(str(message).split()))
        if category is UserWarning and text not in texts:
            texts.add(text)
            print("warpcloth: warning:", text, file=sys.stderr)

    return show


def say(message, code):
    print("warpcloth:", printable(" ".join(str(message).split())), file=sys.stderr)
    return code


def printable(text):
    """Escapes characters that control a terminal or cannot be written; a name from a file may contain them."""
    if text.isprintable():
        return text
    return "".join(c if c in "\n\t" or unicodedata.category(c) not in _STEERING else repr(c)[1:-1] for c in text)


class Printable:
    """A stream that escapes its text by :func:`printable`, and drops it once its reader, such as ``head``, has gone."""

    def __init__(self, stream):
        self._stream = stream

    def write(self, text):
        try:
            self._stream.write(printable(text))
            self._stream.flush()  # while an error can still be told
        except BrokenPipeError:  # Python flushes what is left when it exits
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), self._stream.fileno())
        except (OSError, ValueError) as error:
            if isinstance(error, OSError) and error.errno != errno.EBADF:
                error.filename = error.filename or "the standard output"
                raise
            # A module closed it, which :class:`StandardStreams` reports.
        return len(text)

    def __getattr__(self, name):
        return getattr(self._stream, name)


class StandardStreams:
    """Makes the standard output `Printable`, and drops what goes to a stream without which the process started.

    It opens both again if a scene or a module closed one during the block, and says so. A stream by which one
    replaced another stays.

    Attributes:
        code: The exit code; 2 if one was closed.
    """

    code = 2

    def __enter__(self):
        self._copies = {}
        for number, name in _STREAMS.items():
            if getattr(sys, name) is None:  # the process has started without
                setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
            with contextlib.suppress(OSError):
                self._copies[number] = os.dup(number)
        self._before, self._printable = sys.stdout, Printable(sys.stdout)
        sys.stdout = self._printable
        return self

    def __exit__(self, kind, error, trace):
        if sys.stdout is self._printable:
            sys.stdout = self._before
        closed = False
        for number in self._copies:
            stream = getattr(sys, _STREAMS[number])
            try:
                os.fstat(number)
                closed |= getattr(stream, "closed", stream is None)
            except (OSError, ValueError):  # ValueError if it was detached
                closed = True
        if closed:
            for number, copy in self._copies.items():
                os.dup2(copy, number)
                setattr(sys, _STREAMS[number], open(number, "w", closefd=False))
            message = "a scene or a module closed the standard output or error; it must leave them open"
            self.code = say(message, 2)
        for copy in self._copies.values():
            os.close(copy)
        return closed
