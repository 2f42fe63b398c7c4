"""Handles interrupts by Ctrl-C, and in the command by SIGTERM too, so that a file that is being finished is finished first."""

import os
import signal
import sys
import threading
from contextlib import contextmanager, suppress

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """The user interrupted; the message says what is saved, and where."""


@contextmanager
def deferred(patience=1):
    """Holds an interrupt back until this block has ended; a second one is raised at once.

    This applies to the main thread, since interrupts arrive nowhere else. A signal without a handler, which ends the process as
    SIGTERM does outside the command, is left alone.

    Args:
        patience: How many interrupts are held back; 0 if this block runs because of an interrupt.
    """
    if not patience or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    before = {number: handler for number, handler in before.items() if callable(handler)}
    came = []

    def note(number, frame):
        came.append(number)
        if len(came) > patience:
            before[number](number, frame)

    for number in before:
        signal.signal(number, note)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if came:
        before[came[0]](came[0], None)


@contextmanager
def recording(recorder, frames):
    """Closes a recorder of frames, however the block ends.

    Args:
        recorder: Object with ``frames``, the number of frames it was given, ``close()``, and ``saved()``, which says where they
            are.
        frames: Number of frames it would be given in all, after the first.

    Raises:
        Interrupted: The user interrupted; the message says which frames are saved.
    """
    try:
        try:
            yield
        finally:
            recorder.close()
    except KeyboardInterrupt:
        when = f"after frame {recorder.frames - 1} of {frames}" if recorder.frames else "before the first frame"
        raise Interrupted(f"interrupted {when}; {recorder.saved()}") from None


class Interrupts:
    """Interrupts of the command: SIGTERM acts like Ctrl-C, and further signals cannot disturb the message about the first.

    Attributes:
        code: Exit code, 128 plus the number of the signal, as in shells: 130 for Ctrl-C, 143 for SIGTERM.
        over: Whether signals are ignored from now on.
    """

    def __init__(self):
        self.code, self.over, self._loading = 128 + signal.SIGINT, False, False

    def __enter__(self):
        self._before = {}
        if threading.current_thread() is threading.main_thread():
            own = {signal.SIGINT: (signal.default_int_handler, leave), signal.SIGTERM: (signal.SIG_DFL, leave)}
            for number, replaced in own.items():  # leave other handlers, and signals that are ignored, alone
                if signal.getsignal(number) in replaced:
                    self._before[number] = signal.signal(number, self._interrupt)
        self._hook, sys.unraisablehook = sys.unraisablehook, self._unraisable
        return self

    def __exit__(self, *error):
        self.over = True  # set first, so that a signal from here on is ignored
        sys.unraisablehook = self._hook
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _unraisable(self, unraisable):
        """Raises an interrupt again that came in a destructor, where Python drops it."""
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            self._hook(unraisable)
        elif not self.over:
            again = threading.Timer(0.01, signal.raise_signal, [self.code - 128])
            again.daemon = True
            again.start()

    @contextmanager
    def loading(self):
        """Makes an interrupt end the process at once, because an import may swallow an exception."""
        self._loading = True
        try:
            yield
        finally:
            self._loading = False

    def _interrupt(self, number, _frame):
        if self._loading and not self.over:
            leave(number, _frame)
        if not self.over:
            self.code = 128 + number
            raise KeyboardInterrupt


def leave(number, _frame):
    """Ends the process at once, without a traceback, because an import may swallow an exception."""
    with suppress(Exception):  # the signal may have come in the middle of another flush
        sys.stdout.flush()
    os.write(2, b"warpcloth: interrupted\n")
    os._exit(128 + number)


def leave_while_loading():
    """Makes interrupts end the command while its modules load, which takes a second, and after its last message.

    The processes that it starts for measurements end silently.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    processes = sys.modules.get("multiprocessing.process")
    end = signal.SIG_DFL if processes and processes.parent_process() else leave
    ran = sys.orig_argv[sys.orig_argv.index("-m") + 1] if sys.argv[:1] == ["-m"] and "-m" in sys.orig_argv else None
    ran = ran or os.path.basename(sys.argv[0] if sys.argv else "")
    if ran.partition(".")[0] == "warpcloth":
        for number, replaced in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
            if signal.getsignal(number) is replaced:
                signal.signal(number, end)


leave_while_loading()
