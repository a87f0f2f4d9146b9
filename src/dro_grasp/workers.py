"""Processes: a worker ends with the one that started it, and computes in one thread, as several would compete.

Where candidates are made on a device, few processes feed it, and each simulates on its share of the cores.

This module imports no numerical library at its top: a worker calls it before it loads one.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from multiprocessing import connection

KEPT = 32 * 2**20
"""Largest block that stays with the process when it is freed, and half of what stays in all [bytes]: as much as glibc comes to
by itself at most, where the order of blocks lets it."""
BLOCK = -3  # Parameter of glibc's mallopt for the first of these bounds
IN_ALL = -1  # And for the second


def use_one_thread(simulating: int = 1) -> None:
    """Compute in one thread from now on, in this process, and leave Ctrl-C to the process that started it.

    It ends with that process. Simulations may take more threads.
    """
    end_with_parent()
    keep_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["OMP_NUM_THREADS"] = str(simulating)  # whatever it was: simulations count their threads by it
    import torch

    torch.set_num_threads(1)


def keep_memory() -> None:
    """Let freed memory stay with this process, up to KEPT: to give it back and take it again is a twentieth of a prediction.

    Nothing happens where the C library is none of GNU's.
    """
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):
            adjust = ctypes.CDLL(None).mallopt
            adjust(BLOCK, KEPT)
            adjust(IN_ALL, 2 * KEPT)


def end_with_parent() -> None:
    """End this process at once when the one that started it is gone, however that ended and whatever is computed here."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end() -> None:
        connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()
