"""An interrupt waits once for work that is being finished; handlers of the user, and ignored signals, stay as they are."""

import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import warp as wp
from scipy.sparse import eye_array

from warpcloth.base.interrupts import Interrupted, Interrupts, deferred, recording
from warpcloth.numerics.linear import CholeskyFactor


def test_the_first_interrupt_waits_and_a_second_one_does_not():
    done = []
    with pytest.raises(KeyboardInterrupt), deferred():
        signal.raise_signal(signal.SIGINT)
        done.append("first")
    with pytest.raises(KeyboardInterrupt), deferred():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        done.append("second")
    with pytest.raises(KeyboardInterrupt), deferred(patience=0):
        signal.raise_signal(signal.SIGINT)
        done.append("second")
    with pytest.raises(KeyboardInterrupt), deferred():
        with deferred():
            signal.raise_signal(signal.SIGINT)
            done.append("inner")
        done.append("outer")
    assert done == ["first", "inner", "outer"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_error_comes_before_the_interrupt_that_waits():
    with pytest.raises(OSError, match="full"), deferred():
        signal.raise_signal(signal.SIGINT)
        raise OSError("full")


def test_other_threads_and_handlers_are_left_alone():
    def run():
        with deferred(), Interrupts() as interrupts:
            return interrupts.code, signal.getsignal(signal.SIGINT)

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(run).result() == (130, signal.default_int_handler)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with deferred(), Interrupts():
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_command_has_the_code_of_its_signal_and_says_it_undisturbed(number, code):
    with Interrupts() as interrupts:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
        interrupts.over = True
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
        assert interrupts.code == code
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_an_interrupt_in_a_destructor_is_not_lost(capfd):
    class Freed:
        def __del__(self):
            signal.raise_signal(signal.SIGTERM)

    hook, end = sys.unraisablehook, time.monotonic() + 600.0
    with Interrupts() as interrupts:
        with pytest.raises(KeyboardInterrupt):
            Freed()
            while time.monotonic() < end:
                pass
        assert interrupts.code == 143
    assert sys.unraisablehook is hook and capfd.readouterr().err == ""


def test_an_interrupt_says_what_was_recorded():
    class Recorder:
        frames, closed = 0, False

        def close(self):
            self.closed = True

        def saved(self):
            return "they are here"

    recorder = Recorder()
    for frames, when in ((0, "before the first frame"), (3, "after frame 2 of 9")):
        recorder.frames = frames
        with pytest.raises(Interrupted, match=f"^interrupted {when}; they are here$"), recording(recorder, 9):
            raise KeyboardInterrupt
        assert recorder.closed


class Checked:
    """A solver of cholespy that counts the Python functions that run while it solves, and interrupts the first of them."""

    def __init__(self, solver):
        self.solver, self.calls = solver, 0

    def note(self, _frame, event, _argument):
        if event == "call":
            self.calls += 1
            sys.setprofile(None)
            signal.raise_signal(signal.SIGINT)

    def solve(self, b, x):
        sys.setprofile(self.note)
        try:
            self.solver.solve(b, x)
        finally:
            sys.setprofile(None)


def test_an_interrupt_in_a_solve_is_one(device, monkeypatch):
    """Where cholespy asked Warp for the memory of an array, an interrupt became "incompatible function arguments"."""
    factor = CholeskyFactor(2.0 * eye_array(2, format="csr"), wp.get_device(device), wp.float64)
    b, x = wp.array([2.0, 4.0], dtype=wp.float64, device=device), wp.zeros(2, dtype=wp.float64, device=device)
    checked = Checked(factor.solver)
    monkeypatch.setattr(factor, "solver", checked)
    if wp.get_device(device).is_cpu:
        factor.solve(b, x)
        assert checked.calls == 0 and x.numpy() == pytest.approx([1.0, 2.0], rel=1e-14)
    else:
        with pytest.raises(KeyboardInterrupt):
            factor.solve(b, x)
