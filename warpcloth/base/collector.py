"""Pauses Python's garbage collector."""

import contextlib
import gc


@contextlib.contextmanager
def uncollected():
    """Disables the garbage collector inside the block. Yields whether it was enabled."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield enabled
    finally:
        if enabled:
            gc.enable()


@contextlib.contextmanager
def collector_paused():
    """Pauses the garbage collector while modules load.

    The objects of modules are not garbage. Searching them again and again takes a third of the start-up time.
    """
    with uncollected() as enabled:
        try:
            yield
        finally:
            if enabled and not gc.get_freeze_count():  # leave objects that others froze alone
                gc.freeze()
                gc.unfreeze()  # moves all objects to the oldest generation without searching them
