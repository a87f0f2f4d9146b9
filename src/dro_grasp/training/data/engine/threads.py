"""One thread for each worker process, as threads of one process would compete with the other processes.

This module imports nothing else at its top: a worker calls it before it loads a numerical library.
"""

from __future__ import annotations

import os
import signal


def use_one_thread() -> None:
    """Compute in one thread from now on, in this process, and leave Ctrl-C to the process that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["OMP_NUM_THREADS"] = "1"  # whatever it was: simulations count their threads by it
    import torch

    torch.set_num_threads(1)
