"""Handles Ctrl-C, and in the command SIGTERM too, so that a file is completed before the process ends."""

import os
import signal
import sys
import threading
from contextlib import contextmanager, suppress

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """Raised when the user interrupts. The message says what is saved, and where."""


@contextmanager
def deferred(patience=1):
    """Delays an interrupt until the end of the block; a second interrupt is raised at once.

    Only the main thread receives interrupts, so in other threads this does nothing. A signal without a handler, such as
    SIGTERM outside the command, ends the process as before.

    Args:
        patience: Number of interrupts to delay; 0 if the block runs because of an interrupt.
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
    """Closes a recorder when the block ends, also after an error.

    Args:
        recorder: Object with ``frames``, the number of frames recorded so far, ``close()``, and ``saved()``, which returns a
            text that says where they are.
        frames: Number of frames of the whole run, without frame 0.

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
    """Handles the interrupts of a command: SIGTERM acts like Ctrl-C. The command sets ``over`` before its last message.

    Attributes:
        code: Exit code: 128 plus the signal number, as in shells, so 130 for Ctrl-C and 143 for SIGTERM.
        over: Whether to ignore further signals.
    """

    def __init__(self):
        self.code, self.over, self._loading = 128 + signal.SIGINT, False, False

    def __enter__(self):
        self._before = {}
        if threading.current_thread() is threading.main_thread():
            own = {signal.SIGINT: (signal.default_int_handler, leave), signal.SIGTERM: (signal.SIG_DFL, leave)}
            for number, replaced in own.items():  # keep foreign handlers and ignored signals
                if signal.getsignal(number) in replaced:
                    self._before[number] = signal.signal(number, self._interrupt)
        self._hook, sys.unraisablehook = sys.unraisablehook, self._unraisable
        return self

    def __exit__(self, *error):
        self.over = True  # first, so that signals are ignored from here on
        sys.unraisablehook = self._hook
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _unraisable(self, unraisable):
        """Repeats an interrupt that came during a destructor, where Python drops exceptions."""
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            self._hook(unraisable)
        elif not self.over:
            again = threading.Timer(0.01, signal.raise_signal, [self.code - 128])
            again.daemon = True
            again.start()

    @contextmanager
    def loading(self):
        """Makes an interrupt end the process at once inside the block, because an import may swallow exceptions."""
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
    """Ends the process at once, without a traceback, with the exit code of a signal."""
    with suppress(Exception):  # the signal may have interrupted another flush
        sys.stdout.flush()
    os.write(2, b"warpcloth: interrupted\n")
    os._exit(128 + number)


def leave_while_loading():
    """Makes an interrupt end the command at once while its modules load, which takes a second, and after its last message.

    The worker processes that it starts for measurements end without a message.
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
