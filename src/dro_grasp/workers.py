"""Worker processes: each ends with the process that started it, and computes in one thread, as several would compete.

Where candidates are made on a device, few processes feed it, and each simulates on its share of the cores.

This module imports no numerical library at its top: a worker calls it before it loads one.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from multiprocessing import connection


def use_one_thread(simulating: int = 1) -> None:
    """Compute in one thread from now on, in this process, and leave Ctrl-C to the process that started it.

    It ends with that process. Simulations may take more threads.
    """
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["OMP_NUM_THREADS"] = str(simulating)  # whatever it was: simulations count their threads by it
    import torch

    torch.set_num_threads(1)


def end_with_parent() -> None:
    """End this process at once when the one that started it is gone, however that ended and whatever is computed here."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end() -> None:
        connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()
