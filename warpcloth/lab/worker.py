"""The start of a process that measures. This module imports little, because it sets how Warp is loaded."""

import gc
import multiprocessing
import os
import signal
import threading
import warnings

from ..base.collector import collector_paused
from ..base.quiet import initialise_warp


def begin():
    """Starts a process of a campaign: loads Warp. It shows no warnings, because the parent process has them.

    An interrupt ends the process without a message, because the parent process reports it. It also ends if the parent is
    killed, because otherwise it would wait forever.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    warnings.simplefilter("ignore")
    threading.Thread(target=_end_with, args=(multiprocessing.parent_process(),), daemon=True).start()
    with collector_paused():
        initialise_warp()
    gc.freeze()  # Warp's objects are not garbage


def _end_with(parent):
    parent.join()
    os._exit(1)
