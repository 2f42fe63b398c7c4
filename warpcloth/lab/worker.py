"""How a process that measures starts. It imports little, so that it decides how Warp is loaded."""

import gc
import multiprocessing
import os
import signal
import threading

from ..base.collector import collector_paused
from ..base.extensions import load_extension
from ..base.quiet import initialise_warp


def begin(modules):
    """Begins in a process of a campaign: loads Warp and extensions.

    An interruption ends the process without a word, as the first process says what there is. It also ends when that was killed,
    which would leave it waiting for ever.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_end_with, args=(multiprocessing.parent_process(),), daemon=True).start()
    with collector_paused():
        initialise_warp()
    gc.freeze()  # Warp's objects stay, as this process is ours
    for module in modules:
        load_extension(module)


def _end_with(parent):
    parent.join()
    os._exit(1)
